"""Several drivers of one robot: which of them moves which joint, and the ingest of their joint states.

A driver of some joints publishes a *part* of the robot's joint states. Each joint has one writer: of those
that contradict each other the first ``JointPrecedence`` (``zstate.ingest.precedence``).

A part in which such a joint is missing would be half a robot at an instant, so it is refused as a whole, and
accepted once the other writer has left. A writer of all joints keeps those that no part moves.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import count

from numpy.typing import ArrayLike

from zstate._util.bounded import BoundedDict
from zstate._util.fork_safe import fork_safe
from zstate.buffer.tracks import JointTrack
from zstate.errors import InsertRefused, MessageError
from zstate.ingest.base import ClockSetBack, StreamIngest
from zstate.ingest.frame_ownership import EdgeSource, FrameOwnership
from zstate.ingest.precedence import JointPrecedence, Presence
from zstate.model.robot import RobotModel, coordinate_names, velocity_columns_by_position
from zstate.streams import StreamName
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, RobotDescription, Sample

_MAX_SETS = 16
"""Sets of joints that one writer may publish; a driver publishes one."""


@lru_cache(maxsize=16)
def joint_order(model: RobotModel) -> JointOrder:
    """Reader of the joint states of robots with this model, or of the drivers of this part of one."""
    return JointOrder(model.joint_names, coordinate_names(model), velocity_columns_by_position(model))


class JointNames:
    """The driven joints of a model by the names of their coordinates in messages."""

    def __init__(self, model: RobotModel) -> None:
        self._robot = model.name
        self._coordinates = {joint: coordinate_names(model.part([joint])) for joint in model.joint_names}
        self._joints = {name: joint for joint, names in self._coordinates.items() for name in names}

    def joints(self, names: Sequence[str], *, others: bool = False) -> tuple[str, ...]:
        """The joints whose coordinates a message ``names``, in its order.

        With ``others`` it may name further ones, as in ROS. Raises MessageError for unknown joints, for none,
        and for a joint of which a coordinate is missing.
        """
        found = tuple(dict.fromkeys(self._joints[name] for name in names if name in self._joints))
        unknown = [name for name in names if name not in self._joints]
        if unknown and not others:
            text = f"{', '.join(map(repr, unknown))}, no driven joint of {self._robot!r}"
            raise MessageError(f"a partial joint state of {text}", reason="unknown joints")
        missing = [name for joint in found for name in self._coordinates[joint] if name not in names]
        if missing or not found:
            text = ", ".join(map(repr, missing)) or f"any joint of {self._robot!r}"
            raise MessageError(f"a partial joint state without {text}", reason="missing joints")
        return found


@lru_cache(maxsize=16)
def shared_joint_names(model: RobotModel) -> JointNames:
    """The names of ``model``; the robots of a fleet that have one model share them."""
    return JointNames(model)


@dataclass(eq=False, slots=True)
class JointPart:
    """The joints that the writer of a ``session`` publishes together; ``track`` has their samples.

    The session is None if there is no writer yet. ``appeared`` numbers writers and departures in their order.
    """

    session: int | None
    joints: tuple[str, ...]
    track: JointTrack
    order: JointOrder
    appeared: int = 0
    refusal: InsertRefused | None = None


class RobotParts:
    """The writers of the joints of ``robot``, and which of them moves which joint in the buffer.

    The writer of all joints is one of them. Any thread may call it.
    """

    def __init__(self, robot: str, ownership: FrameOwnership) -> None:
        self._robot = robot
        self._ownership = ownership
        self._feed = ownership.feed
        self._counters = ownership.counters.for_robot(robot)
        self._names = ownership.live
        self._whole: JointPart | None = None
        self._whole_session: int | None = None
        self._joint_names: JointNames | None = None
        self._parts: dict[tuple[int, frozenset[str]], JointPart] = {}
        # The same by the order of the names in samples; a writer may change it.
        self._by_order: BoundedDict[tuple[int, bytes], JointPart] = BoundedDict()
        self._since: dict[int, int] = {}
        self._departed: BoundedDict[int, int] = BoundedDict()
        self._moments = count(1)
        self._lock = fork_safe(threading.RLock())

    def set_model(self, track: JointTrack) -> JointPart:
        """Set the track of the whole robot. The parts of an earlier model have ended with it."""
        with self._lock:
            order = joint_order(track.model)
            self._whole = JointPart(self._whole_session, track.model.joint_names, track, order)
            self._joint_names = shared_joint_names(track.model)
            self._parts.clear()
            self._by_order.clear()
            return self._whole

    def set_whole_writer(self, session: int | None) -> None:
        """Set the writer of all joints, None if there is none."""
        with self._lock:
            if session != self._whole_session:
                self._whole_session = session
                if self._whole is not None:
                    self._whole.session, self._whole.appeared = session, next(self._moments)
                    self._resolve()

    def add_writer(self, session: int, since: int) -> None:
        """Add an announced writer that started at ``since`` [ns]."""
        with self._lock:
            self._since[session] = since
            self._departed.pop(session, None)
            for part in self._parts_of(session):
                part.track.writer = self._names.get((self._robot, session))
            self._resolve()

    def remove_writer(self, session: int) -> None:
        """Remove a writer that has left. Its samples stay until another writer moves the joints."""
        with self._lock:
            if self._since.pop(session, None) is not None:
                self._departed[session] = next(self._moments)
                self._resolve()

    def drop(self, session: int) -> None:
        """Remove the parts of a writer, with their samples."""
        with self._lock:
            for key in [key for key in self._parts if key[0] == session]:
                del self._parts[key]
            for order in [key for key in self._by_order if key[0] == session]:
                del self._by_order[order]
            self._resolve()

    def restart(self, session: int) -> None:
        """Remove the samples of a writer: its clock was set back."""
        with self._lock:
            for part in self._parts_of(session):
                self._feed.restart(part.track)

    def part_of(self, state: JointState, *, others: bool) -> JointPart | None:
        """The part that a sample belongs to; None while the model is not known.

        With ``others`` it may name joints that are not of the model. Raises MessageError for a sample whose
        joints cannot be used, InsertRefused for one with a joint of another part.
        """
        part = self._by_order.get((state.session, state.order))
        if part is None:
            with self._lock:
                part = self._add_part(state, others=others)
        if part is not None and part.refusal is not None:
            raise part.refusal.with_traceback(None)  # it is raised for each sample
        return part

    def _add_part(self, state: JointState, *, others: bool) -> JointPart | None:
        if self._whole is None or self._joint_names is None:
            return None
        if state.names is None:
            raise MessageError("a partial joint state without the names of its joints", reason="no names")
        whole, session = self._whole.track, state.session
        joints = self._joint_names.joints(state.names, others=others)
        part = self._parts.get((session, frozenset(joints)))
        if part is None:
            own = self._parts_of(session)
            if len(own) >= _MAX_SETS:
                text = f"a writer of more than {_MAX_SETS} sets of joints; now {', '.join(map(repr, joints))}"
                raise MessageError(text, reason="too many sets of joints")
            track = self._feed.add_part(whole, joints, self._names.get((self._robot, session)))
            appeared = own[0].appeared if own else next(self._moments)
            part = JointPart(session, joints, track, joint_order(track.model), appeared)
            track.check_positions(part.order.read(state).positions)  # unusable ones take no joint
            self._parts[session, frozenset(joints)] = part
            self._resolve()
        self._by_order[session, state.order] = part
        return part

    def _parts_of(self, session: int) -> list[JointPart]:
        return [part for part in self._parts.values() if part.session == session]

    def _resolve(self) -> None:
        """Assign each joint to one part, and refuse the parts that contradict it."""
        whole = self._whole
        if whole is None or not (self._parts or whole.track.parts):
            return
        movers: dict[str, JointPart] = {}
        for part in sorted((whole, *self._parts.values()), key=self._precedence):
            taken = [joint for joint in part.joints if joint in movers]
            has_left = part.session is None or part.session in self._departed
            if taken and not has_left:
                self._refuse(part, taken[0], movers[taken[0]])
            else:
                part.refusal = None
                movers.update({joint: part for joint in part.joints if joint not in movers})
        tracks = {joint: part.track for joint, part in movers.items() if part is not whole}
        self._feed.assign_joints(whole.track, tracks)

    def _precedence(self, part: JointPart) -> JointPrecedence:
        session = part.session or 0
        presence, moment = Presence.DEPARTED, self._departed.get(session, part.appeared)
        if part.session is None:
            presence = Presence.NONE
        elif session in self._since:
            presence, moment = Presence.ANNOUNCED, self._since[session]
        return JointPrecedence(presence, -moment, session, -len(part.joints), part.joints)

    def _refuse(self, part: JointPart, joint: str, first: JointPart) -> None:
        text, reason = f"joint {joint!r} is published by {self._writer(first)}", "second writer"
        if first.session == part.session:
            missing = ", ".join(repr(name) for name in first.joints if name not in part.joints)
            text, reason = f"{text} together with {missing}, refused: without", "missing joints"
        else:
            text = f"{text}; refused: {self._writer(part)}; one joint has one writer"
        track = part.track
        forms = dict(zip([one.name for one in track.model.joints], track.forms, strict=True))
        error = InsertRefused(text, reason=reason, edge=track.edge(forms[joint]))
        if part.refusal is None:
            if part is self._whole:  # the samples of others are counted one by one
                self._counters.count_refusal(error.reason, f"{self._robot!r}: {text}")
            stream: StreamName = "joint_states" if part is self._whole else "partial_joint_states"
            source = EdgeSource(self._robot, self._writer(part), part.session or 0)
            self._ownership.report_conflict(stream, source, error)
        part.refusal = error

    def _writer(self, part: JointPart) -> str:
        return self._names.get((self._robot, part.session or 0)) or f"a writer of session {part.session}"


class JointIngest(StreamIngest):
    """Inserts joint states into the track of the part of the robot that they belong to."""

    @abstractmethod
    def _part(self, sample: Sample) -> JointPart | None:
        """The part that a sample belongs to; None while the model is not known. Raises as ``_insert``."""

    def _insert(self, sample: Sample) -> bool | None:
        part = self._part(sample)
        if part is None:
            return None
        assert isinstance(sample, JointState)
        if sample.order == part.order.digest and sample.velocities is None:
            return self._buffer.insert_joints(part.track, sample.stamp, sample.positions)
        numbers = part.order.read(sample)
        return self._buffer.insert_joints(part.track, sample.stamp, numbers.positions, numbers.velocities)

    def _insert_past(self, samples: Sequence[Sample]) -> int:
        part = self._part(samples[0])
        if part is None:
            return 0
        past: list[tuple[int, ArrayLike, ArrayLike | None]] = []
        for sample in samples:
            assert isinstance(sample, JointState)
            if sample.order != samples[0].order:
                break
            numbers = part.order.read(sample)
            past.append((sample.stamp, numbers.positions, numbers.velocities))
        return self._feed.insert_past_joints(part.track, past)

    def _fast_place(self, sample: Sample) -> JointTrack | None:
        part = self._part(sample)
        return part.track if part is not None and sample.order == part.order.digest else None


class PartialJointStateIngest(JointIngest):
    """Inserts the joint states of one driver, which publishes a part of the robot.

    ``others`` means that its messages may name joints that are not of the model, as in ROS.
    """

    def __init__(
        self,
        robot: str,
        ownership: FrameOwnership,
        parts: RobotParts,
        on_set_back: ClockSetBack | None = None,
        *,
        others: bool = False,
    ) -> None:
        super().__init__(robot, ownership, on_set_back)
        self._parts = parts
        self._others = others

    def describe(self, description: RobotDescription) -> None:
        """Insert the samples that arrived before the model, which ``parts`` has now."""
        with self._lock:
            self._insert_early()

    def _part(self, sample: Sample) -> JointPart | None:
        assert isinstance(sample, JointState)
        return self._parts.part_of(sample, others=self._others)

    def _drop_history(self) -> None:
        self._parts.restart(self.session or 0)

    def _remove(self) -> None:
        self._parts.drop(self.session or 0)
