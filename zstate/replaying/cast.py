"""Publishers of one playback pass."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack

from zstate._util.refusals import Refusals
from zstate.clock import SIMULATED, ManualClock
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError, ModelError
from zstate.ingest.model_filter import ModelEdgeFilter
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.nodes.publisher import StatePublisher
from zstate.record.models import joint_order
from zstate.record.transcript import Said, Speaker
from zstate.replaying.standing import Standing, static_key
from zstate.replaying.verbatim import Verbatim
from zstate.wire.keys import MODEL_WRITER, Stream
from zstate.wire.messages import (
    JointState,
    Message,
    RobotDescription,
    StaticTransforms,
    TransformSample,
)


class Cast(Closing):
    """Publishers for one playback pass, with new writer identities.

    Robots with one of ``models`` get a StatePublisher, which recomputes their transforms if their own
    publisher wrote them; everything else is republished unchanged. ``standing`` are the latched messages
    at the start of the pass. Messages that cannot be published are counted in ``refusals``.
    Raises SecondWriter if another writer of the same is active now; not with ``takeover``.
    """

    def __init__(
        self,
        session: Session,
        wires: Sequence[str],
        speakers: Collection[Speaker],
        *,
        models: Mapping[str, RobotModel],
        standing: Standing,
        refusals: Refusals,
        takeover: bool = False,
    ) -> None:
        self._session = session
        self._wires = wires
        self._takeover = takeover
        self._refusals = refusals
        self._standing = standing
        self._modelled, self._computed = ModelEdgeFilter(), ModelEdgeFilter()
        self._sessions: set[int] = set()
        self._robots: dict[str, _Robot] = {}
        self._others: dict[str, Verbatim] = {}
        with ExitStack() as opening:
            opening.callback(self._close_robots)
            for robot, model in models.items():
                self._robots[robot] = self._open(robot, model, _is_computed(robot, speakers))
            for robot, streams in self._verbatim_streams(speakers).items():
                self._others[robot] = Verbatim(
                    session, wires, robot, streams, cast=self._sessions, takeover=takeover
                )
                opening.enter_context(self._others[robot])
            for said in (*standing.descriptions.values(), *standing.statics):
                self._say_counted(said)
            self._opened = opening.pop_all()

    def _open(self, robot: str, model: RobotModel, is_computed: bool) -> _Robot:
        self._modelled.set_model(robot, model)
        if is_computed:
            self._computed.set_model(robot, model)
        opened = _Robot(self._session, self._wires, robot, model, is_computed, self._takeover)
        self._sessions.add(opened.session_id)
        return opened

    def _verbatim_streams(self, speakers: Iterable[Speaker]) -> dict[str, list[Stream]]:
        streams: dict[str, list[Stream]] = {}
        for speaker in speakers:
            if speaker.robot:
                found = streams.setdefault(speaker.robot, [])
                robot = self._robots.get(speaker.robot)
                own: Collection[Stream] = () if robot is None else robot.streams
                if speaker.stream in ("joint_states", "tf") and speaker.stream not in (*own, *found):
                    found.append(speaker.stream)
        return streams

    def take(self, said: Said) -> bool:
        """Publish it. Returns whether anything was published."""
        if isinstance(said.message, RobotDescription | StaticTransforms):
            changed = self._standing.take(said)
            return changed is not None and self._say_counted(changed)
        return self._say_counted(said)

    def _say_counted(self, said: Said) -> bool:
        try:
            return self._say(said.speaker, said.message)
        except MessageError as error:
            self._refusals.count(error.reason, f"{said.speaker.robot!r}: {error}")
        except InvalidInput as error:
            self._refusals.count("not sayable", f"{said.speaker.robot!r}: {error}")
        except ModelError as error:
            self._refusals.count("robot description", f"{said.speaker.robot!r}: {error}")
        return False

    def _say(self, speaker: Speaker, message: Message) -> bool:
        robot = self._robots.get(speaker.robot)
        if isinstance(message, StaticTransforms):
            return self._fix(speaker, message)
        if isinstance(message, RobotDescription):
            return self._describe(speaker, message)
        if isinstance(message, JointState) and robot is not None:
            robot.publish(message)
        elif isinstance(message, TransformSample):
            rest = self._computed.filter_sample(speaker.robot, message)
            if rest is None or (robot is not None and "tf" in robot.streams):
                return False
            self._others[speaker.robot].say(rest)
        elif isinstance(message, JointState):
            self._others[speaker.robot].say(message)
        return True

    def _describe(self, speaker: Speaker, description: RobotDescription) -> bool:
        robot = self._robots.get(speaker.robot)
        if robot is None:
            self._others[speaker.robot].describe(description, MODEL_WRITER)
        elif robot.model.urdf != description.urdf:
            model = parse_urdf(description.urdf, f"the URDF of {speaker.robot!r}")
            robot.close()
            self._robots[speaker.robot] = self._open(speaker.robot, model, "tf" in robot.streams)
        return True

    def _fix(self, speaker: Speaker, statics: StaticTransforms) -> bool:
        if speaker.static_writer == MODEL_WRITER and speaker.robot in self._robots:
            return False
        rest = self._modelled.filter_statics(speaker.robot, statics)
        self._others[speaker.robot].fix(rest, static_key(speaker)[1])
        return True

    def close(self) -> None:
        """Close all publishers. A second call does nothing."""
        self._opened.close()

    def _close_robots(self) -> None:
        for robot in self._robots.values():
            robot.close()


class _Robot(Closing):
    """The StatePublisher of a robot whose model is known."""

    def __init__(  # noqa: PLR0917 - one use, just above
        self,
        session: Session,
        wires: Sequence[str],
        robot: str,
        model: RobotModel,
        is_computed: bool,
        takeover: bool,
    ) -> None:
        self.model = model
        self.streams: tuple[Stream, ...] = ("joint_states", "tf_static", "robot_description")
        if is_computed:
            self.streams += ("tf",)
        self._order = joint_order(model)
        self._publisher = StatePublisher(
            session,
            model,
            robot,
            wires,
            streams=self.streams,
            # Samples have stamps of their own; this clock only announces simulated time.
            clock=ManualClock(domain=SIMULATED),
            takeover=takeover,
        )

    @property
    def session_id(self) -> int:
        """The session in its messages."""
        return self._publisher.description().session

    def publish(self, state: JointState) -> None:
        """Publish ``state``. Raises MessageError and InvalidInput."""
        positions, velocities, efforts = self._order.read(state)
        self._publisher.publish(positions, velocities, efforts, state.stamp)

    def close(self) -> None:
        self._publisher.close()


def _is_computed(robot: str, speakers: Collection[Speaker]) -> bool:
    """Whether the transforms of a robot with a model follow from its joint states.

    They do if there are none, or if the writers of the joint states wrote them too.
    """
    sessions: dict[Stream, set[int]] = {"tf": set(), "joint_states": set()}
    for speaker in speakers:
        if speaker.robot == robot and speaker.stream in sessions:
            sessions[speaker.stream].add(speaker.session)
    return sessions["tf"] <= sessions["joint_states"]
