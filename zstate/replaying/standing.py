"""Standing: what has been said last of what holds until it is said anew."""

from __future__ import annotations

from zstate.record.gathered import Gathered
from zstate.record.transcript import Said, Speaker
from zstate.wire.messages import RobotDescription, StaticTransforms


class Standing:
    """The descriptions and static edges that hold, as far as they were taken in."""

    def __init__(self) -> None:
        self._descriptions: dict[str, Said] = {}
        self._statics: dict[tuple[str, str], Said] = {}
        self._gathered: dict[Speaker, Gathered] = {}

    @property
    def descriptions(self) -> dict[str, Said]:
        """By robot."""
        return dict(self._descriptions)

    @property
    def statics(self) -> tuple[Said, ...]:
        """One of each writer, with all of its edges."""
        return tuple(self._statics.values())

    def take(self, said: Said) -> Said | None:
        """What this says anew; None when it repeats what holds, or is a sample.

        Static edges that add up, as in the bags of ROS, come back all together.
        """
        message = said.message
        if isinstance(message, RobotDescription):
            return self._describe(said, message)
        if isinstance(message, StaticTransforms):
            return self._fix(said, message)
        return None

    def _describe(self, said: Said, description: RobotDescription) -> Said | None:
        before = self._descriptions.get(said.speaker.robot)
        self._descriptions[said.speaker.robot] = said
        if before is not None and isinstance(before.message, RobotDescription):
            return None if before.message.urdf == description.urdf else said
        return said

    def _fix(self, said: Said, statics: StaticTransforms) -> Said | None:
        speaker = said.speaker
        if speaker.static_writer is None:
            gathered = self._gathered.setdefault(speaker, Gathered(speaker.session))
            said = said._replace(message=gathered.with_edges(statics))
        key = static_key(speaker)
        before = self._statics.get(key)
        self._statics[key] = said
        return None if before is not None and _same(before, said) else said


def static_key(speaker: Speaker) -> tuple[str, str]:
    """The robot of static edges, and the name under which they are written, in a bag "recorded"."""
    return speaker.robot, speaker.static_writer or "recorded"


def _same(one: Said, other: Said) -> bool:
    a, b = one.message, other.message
    assert isinstance(a, StaticTransforms)
    assert isinstance(b, StaticTransforms)
    return (a.edges, a.poses) == (b.edges, b.poses)
