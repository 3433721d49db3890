"""Publishers of one playback pass, with new writer identities."""

from __future__ import annotations

import secrets
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeAlias

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.clock import SIMULATED, ManualClock
from zstate.errors import InvalidInput, MessageError, ModelError
from zstate.ingest.joint_parts import JointNames, joint_order
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.edge_monitor import EdgeMonitor
from zstate.net.edge_ownership import Edge, claim_edges, named_edges
from zstate.net.ownership import WriterClaim
from zstate.net.presence import local_writer
from zstate.net.session import Session
from zstate.net.writer import LatchedWriter, SampleWriter, WireWriter, write_all
from zstate.nodes.publisher import StatePublisher
from zstate.recording.decode import DecodedMessage, LatchedState, RecordedWriter, edges_with_more, static_key
from zstate.recording.model_edges import ModelEdgeFilter, select_edges
from zstate.stream_registry import edge_streams, is_bulk, is_latched, is_measured, is_named, measured_streams
from zstate.streams import StreamName
from zstate.wire.identity import Announcement
from zstate.wire.joint_order import JointOrder
from zstate.wire.keys import MODEL_WRITER, full_name
from zstate.wire.measurements import renumbered, with_field
from zstate.wire.messages import (
    Edges,
    JointState,
    Message,
    RobotDescription,
    StampedMessage,
    StaticTransforms,
    TransformSample,
)
from zstate.wire.protocol import carrier
from zstate.wire.registry import get_wire
from zstate.wire.ros2.streams import ros_streams

EdgeWriter: TypeAlias = tuple[str, str]
"""The robot and the name of a writer of transforms."""

_Named: TypeAlias = tuple[str, StreamName, str]
"""The robot, the stream and the name of a writer."""

_SAMPLES: tuple[StreamName, ...] = ("joint_states", "tf")


class PlaybackPublishers(Closeable):
    """Publishes recorded messages as new writers.

    Robots with one of ``models`` get a StatePublisher, which recomputes their transforms if their own
    publisher wrote them; all other messages are published unchanged. The joint states of robots ``in_parts``
    are those of several drivers, each with some of the joints. ``latched`` is in effect from the start.
    Messages that cannot be published are counted in ``refusals``. Raises SecondWriter if another writer
    publishes the same, unless ``takeover``.
    """

    def __init__(
        self,
        session: Session,
        wires: Sequence[str],
        writers: Collection[RecordedWriter],
        *,
        models: Mapping[str, RobotModel],
        in_parts: Collection[str] = (),
        latched: LatchedState,
        refusals: Refusals,
        takeover: bool = False,
    ) -> None:
        self._session = session
        self._wires = wires
        self._takeover = takeover
        self._refusals = refusals
        self._latched = latched
        self._in_parts = in_parts
        self._modelled, self._computed = ModelEdgeFilter(), ModelEdgeFilter()
        self._sessions: set[int] = set()
        self._robots: dict[str, _RobotPublisher] = {}
        self._others: dict[str, PassthroughPublisher] = {}
        self._parts: dict[str, JointPartPlayback] = {}
        self._named: dict[_Named, PassthroughPublisher] = {}
        """Publishers of sensors and of odometry."""
        self._copied = {_edge_of_odometry(one) for one in writers} & set(writers)
        """The writers of edges that odometry has as well."""
        self._open_passthrough = partial(
            PassthroughPublisher, session, wires=wires, sessions=self._sessions, takeover=takeover
        )
        with ExitStack() as opening:
            opening.callback(lambda: [robot.publisher.close() for robot in self._robots.values()])
            opening.callback(lambda: [parts.close() for parts in self._parts.values()])
            for robot, model in models.items():
                self._open(robot, model, robot not in in_parts and _is_computed(robot, writers))
            recorded = {(writer.robot, writer.stream) for writer in writers}
            moving = {
                (one.robot, one.edge_writer)
                for one in writers
                if one.stream == "transforms" and one not in self._copied
            }
            self._transforms = opening.enter_context(
                TransformPlayback(
                    self._open_passthrough, sorted((robot, name or "") for robot, name in moving)
                )
            )
            for robot in {robot for robot, _ in recorded if robot}:
                own = set(self._robots[robot].streams) if robot in self._robots else set[StreamName]()
                if robot in in_parts:
                    own.add("joint_states")
                streams: list[StreamName] = [
                    one for one in _SAMPLES if (robot, one) in recorded and one not in own
                ]
                self._others[robot] = self._open_passthrough(robot, streams)
                opening.enter_context(self._others[robot])
            for named, on_wires in sorted(self._named_writers(writers).items()):
                robot, stream, name = named
                publisher = self._open_passthrough(robot, (stream,), name, wires=on_wires)
                self._named[named] = opening.enter_context(publisher)
            for decoded in (*latched.descriptions.values(), *latched.statics, *latched.values.values()):
                self._publish_counted(decoded)
            self._opened = opening.pop_all()

    def _named_writers(self, writers: Collection[RecordedWriter]) -> dict[_Named, Sequence[str]]:
        """The wires on which each sensor, each writer of odometry, and its edge, is published.

        ROS does not carry the streams of other packages.

        On the native wire odometry is its edge, which is recorded once more for ROS. The edge of a ROS node's
        odometry is that of another program on /tf, if it is one at all.
        """
        ros = [wire for wire in self._wires if get_wire(wire).shared]
        found: dict[_Named, Sequence[str]] = {}
        for writer in writers:
            if is_measured(writer.stream):
                wires = [wire for wire in self._wires if get_wire(wire).carries(writer.stream)]
                if wires:
                    found[_named(writer)] = wires
            elif _edge_of_odometry(writer) in self._copied:
                found[_named(writer)] = self._wires
            elif ros and (writer.stream in edges_with_more() or writer in self._copied):
                found.setdefault(_named(writer), ros)
        return found

    def _open(self, robot: str, model: RobotModel, is_computed: bool) -> None:
        """Open the publisher of a robot with a known model."""
        joints: tuple[StreamName, ...] = () if robot in self._in_parts else ("joint_states",)
        streams: tuple[StreamName, ...] = (*joints, "tf_static", "robot_description")
        self._modelled.set_model(robot, model)
        if is_computed:
            self._computed.set_model(robot, model)
            streams += ("tf",)
        publisher = StatePublisher(
            self._session,
            model,
            robot,
            self._wires,
            streams=streams,
            # Every sample has its own stamp; the clock only marks them as simulated time.
            clock=ManualClock(domain=SIMULATED),
            takeover=self._takeover,
        )
        self._robots[robot] = _RobotPublisher(publisher, joint_order(model), streams)
        self._sessions.add(publisher.description().session)
        if robot in self._parts:
            self._parts.pop(robot).close()

    def publish(self, decoded: DecodedMessage) -> bool:
        """Publish it; False for a repetition and for what cannot be published."""
        if is_latched(decoded.writer.stream):
            changed = self._latched.update(decoded)
            return changed is not None and self._publish_counted(changed)
        return self._publish_counted(decoded)

    def _publish_counted(self, decoded: DecodedMessage) -> bool:
        try:
            if is_latched(decoded.writer.stream):
                return self._publish_latched(decoded.writer, decoded.message)
            return self._publish_sample(decoded.writer, decoded.message)
        except MessageError as error:
            self._refusals.count(error.reason, f"{decoded.writer.robot!r}: {error}")
        except InvalidInput as error:
            self._refusals.count("not representable", f"{decoded.writer.robot!r}: {error}")
        except ModelError as error:
            self._refusals.count("robot description", f"{decoded.writer.robot!r}: {error}")
        return False

    def _publish_latched(self, writer: RecordedWriter, message: Message) -> bool:
        robot = self._robots.get(writer.robot)
        if isinstance(message, StaticTransforms):
            if writer.edge_writer == MODEL_WRITER and robot is not None:
                return False
            edges = self._modelled.filter_statics(writer.robot, message)
            self._others[writer.robot].set_statics(edges, static_key(writer)[1])
        elif not isinstance(message, RobotDescription):
            self._others[writer.robot].set_value(writer.stream, message, writer.edge_writer or "")
        elif robot is None:
            self._others[writer.robot].describe(message)
        elif robot.publisher.model.urdf != message.urdf:
            model = parse_urdf(message.urdf, f"the URDF of {writer.robot!r}")
            robot.publisher.close()
            self._open(writer.robot, model, "tf" in robot.streams)
        return True

    def _publish_sample(self, writer: RecordedWriter, message: Message) -> bool:
        robot = self._robots.get(writer.robot)
        # By the stream first: messages of other packages are of any type.
        if writer.stream in (*measured_streams(), *edges_with_more()) or writer in self._copied:
            publisher = self._named.get(_named(writer))
            if publisher is None:
                return False
            publisher.publish(message)
        elif isinstance(message, JointState) and (
            writer.stream == "partial_joint_states" or writer.robot in self._in_parts
        ):
            self._parts_of(writer.robot).publish(writer, message)
        elif isinstance(message, JointState) and robot is not None:
            positions, velocities, efforts = robot.order.read(message)
            robot.publisher.publish(positions, velocities, efforts, message.stamp)
        elif isinstance(message, TransformSample) and writer.stream == "transforms":
            self._transforms.publish((writer.robot, writer.edge_writer or ""), message)
        elif isinstance(message, TransformSample):
            rest = self._computed.filter_sample(writer.robot, message)
            if rest is None or (robot is not None and "tf" in robot.streams):
                return False
            self._others[writer.robot].publish(rest)
        elif isinstance(message, JointState):
            self._others[writer.robot].publish(message)
        return True

    def _parts_of(self, robot: str) -> JointPartPlayback:
        if robot not in self._parts:
            model = self._robots[robot].publisher.model if robot in self._robots else None
            self._parts[robot] = JointPartPlayback(self._open_passthrough, robot, model)
        return self._parts[robot]

    def close(self) -> None:
        """Close all publishers. A second call does nothing."""
        self._opened.close()


def _named(writer: RecordedWriter) -> _Named:
    return writer.robot, writer.stream, writer.edge_writer or ""


def _edge_of_odometry(writer: RecordedWriter) -> RecordedWriter | None:
    """The writer under which the edge of ``writer`` is recorded, if that writes odometry."""
    return replace(writer, stream="transforms") if writer.stream in edges_with_more() else None


class _RobotPublisher(NamedTuple):
    """The publisher of a robot with a known model, and the reader of its recorded joint states."""

    publisher: StatePublisher
    order: JointOrder
    streams: tuple[StreamName, ...]


class TransformPlayback(Closeable):
    """Publishes the recorded transforms of ``writers``, given by robot and name, under their names.

    A writer that was restarted under another name, as by default, places the frames of its predecessor. Two
    writers of one frame exclude each other, and readers would refuse the second: the publisher of the
    predecessor publishes its edges on. If one has another parent now, that publisher is closed instead, as
    the predecessor was. ``open_publisher(robot, streams, name)`` opens one, and may raise SecondWriter.
    """

    def __init__(
        self, open_publisher: Callable[..., PassthroughPublisher], writers: Sequence[EdgeWriter]
    ) -> None:
        self._open_publisher = open_publisher
        self._publishers: dict[EdgeWriter, PassthroughPublisher] = {}
        self._parents: dict[Edge, tuple[str, EdgeWriter]] = {}
        """The parent and the writer of each frame, by robot and frame."""
        self._routes: dict[tuple[EdgeWriter, Edges], dict[EdgeWriter, list[int]]] = {}
        try:
            for writer in writers:
                self._publisher(writer)
        except BaseException:
            self.close()
            raise

    def publish(self, writer: EdgeWriter, sample: TransformSample) -> None:
        """Publish one sample."""
        edges = sample.edges or ()
        route = self._routes.get((writer, edges))
        if route is None:
            by_writer: defaultdict[EdgeWriter, list[int]] = defaultdict(list)
            for row, edge in enumerate(edges):
                by_writer[self._writer_of(writer, edge)].append(row)
            route = self._routes[writer, edges] = dict(by_writer)
        for publishing, rows in route.items():
            part = sample if len(rows) == len(edges) else select_edges(sample, edges, rows)
            self._publisher(publishing).publish(part)

    def _writer_of(self, writer: EdgeWriter, edge: Edge) -> EdgeWriter:
        """The writer by which an edge of ``writer`` is published."""
        robot = writer[0]
        with suppress(InvalidInput):  # readers refuse it
            edge = full_name(robot, edge[0]), full_name(robot, edge[1])
        parent, child = edge
        placed = self._parents.get((robot, child))
        if placed is not None and placed[0] == parent:
            return placed[1]
        if placed is not None:
            if (publisher := self._publishers.pop(placed[1], None)) is not None:
                publisher.close()
            self._routes.clear()
        self._parents[robot, child] = parent, writer
        return writer

    def _publisher(self, writer: EdgeWriter) -> PassthroughPublisher:
        if writer not in self._publishers:
            robot, name = writer
            self._publishers[writer] = self._open_publisher(robot, ("transforms",), name)
        return self._publishers[writer]

    def close(self) -> None:
        """Close all publishers. A second call does nothing."""
        for publisher in self._publishers.values():
            publisher.close()


class JointPartPlayback(Closeable):
    """Publishes the recorded joint states of drivers of ``robot``, each set of joints by a writer of its own.

    A driver that was restarted under another name, as by default, continues as the writer of its
    predecessor. If two sets have joints in common, one counts, as in ``RecordedJoints``: the writer
    of the other set is closed. Nodes of ROS, whose joint states have no names, are named "recorded-1" and so
    on. ``open_publisher(robot, streams, name)`` opens a writer; it may raise SecondWriter. Without a
    ``model`` the joints are not owned.
    """

    def __init__(
        self, open_publisher: Callable[..., PassthroughPublisher], robot: str, model: RobotModel | None
    ) -> None:
        self._open_publisher = open_publisher
        self._robot = robot
        self._model = model
        self._names = None if model is None else JointNames(model)
        self._publishers: dict[frozenset[str], PassthroughPublisher] = {}
        self._orders: dict[frozenset[str], tuple[int, int]] = {}
        self._joints: dict[tuple[int, bytes], frozenset[str]] = {}
        self._writers: dict[int, int] = {}

    def publish(self, writer: RecordedWriter, state: JointState) -> None:
        """Publish one sample. Raises MessageError if its joints cannot be used, or are those of another."""
        key = state.session, state.order
        joints = self._joints.get(key)
        if joints is None:
            joints = self._joints[key] = self._joints_of(writer, state)
            self._open(writer, state.session, joints)
        publisher = self._publishers.get(joints)
        if publisher is None:
            text = f"{', '.join(map(repr, sorted(joints)))}: another writer publishes some of these joints"
            raise MessageError(text, reason="second writer")
        publisher.publish(state)

    def _joints_of(self, writer: RecordedWriter, state: JointState) -> frozenset[str]:
        names = state.names or ()
        if self._names is None:
            return frozenset(names)
        return frozenset(self._names.joints(names, others=writer.edge_writer is None))

    def _open(self, writer: RecordedWriter, session: int, joints: frozenset[str]) -> None:
        """Open the writer of a set of joints, unless another set counts."""
        position = self._writers.setdefault(session, len(self._writers))
        order = self._orders[joints] = position, len(joints)
        if joints in self._publishers:
            return
        name = writer.edge_writer or f"recorded-{len(self._orders)}"
        rivals = [
            other
            for other, publisher in self._publishers.items()
            if other & joints or publisher.edge_writer == name
        ]
        if any(self._orders[rival] > order for rival in rivals):
            return
        for rival in rivals:
            self._publishers.pop(rival).close()
        publisher = self._open_publisher(self._robot, ("partial_joint_states",), name)
        self._publishers[joints] = publisher
        if self._model is not None:
            moved = self._model.part(tuple(joints)).joints
            publisher.own_joints(
                [(f"{self._robot}/{joint.parent}", f"{self._robot}/{joint.child}") for joint in moved]
            )

    def close(self) -> None:
        """Close all publishers. A second call does nothing."""
        for publisher in self._publishers.values():
            publisher.close()


class PassthroughPublisher(Closeable):
    """Publishes messages of ``robot`` unchanged on all ``wires``, with its own session and sequence numbers.

    ``streams`` are announced at once, latched values with the first of their name; ``transforms``,
    ``partial_joint_states``, sensors and odometry under the name ``edge_writer``. A message that one of the
    wires cannot encode raises InvalidInput, and is published on none. Raises SecondWriter if another live
    writer publishes the same on the native wire, unless ``takeover``. Edges of the ``sessions`` of this
    playback, its own included, may place the same frame, as in the recording.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        streams: Sequence[StreamName],
        edge_writer: str = "",
        *,
        wires: Sequence[str],
        sessions: set[int],
        takeover: bool = False,
    ) -> None:
        self._session = session
        self._session_id = secrets.randbits(32)
        self._robot = robot
        self.edge_writer = edge_writer
        self._moving: StreamName = next((one for one in streams if one in edges_with_more()), "transforms")
        self._sessions = sessions
        self._is_alone = "native" in wires and not takeover
        self._seqs: Counter[StreamName] = Counter()
        self._recorded: dict[StreamName, tuple[int, int]] = {}
        """The recorded session and number of the last sample."""
        self._latched: dict[tuple[StreamName, str], list[LatchedWriter]] = {}
        self._placed: dict[str, set[Edge]] = {}
        self._values: set[tuple[StreamName, str]] = set()
        """Streams, with the names of writers, that have a latched value of a sensor."""
        self._writer = writer = local_writer(self._session_id)
        sessions.add(self._session_id)
        with ExitStack() as opening:
            announced = [self._announced(stream, edge_writer) for stream in streams]
            self._claim = self._claimed(opening, announced)
            moving = self._announced(self._moving, edge_writer)
            self._edge_monitor = opening.enter_context(EdgeMonitor(session, moving, allowed=sessions))
            self._wire_writers = [
                opening.enter_context(WireWriter(session, get_wire(wire), robot, writer)) for wire in wires
            ]
            self._streams: dict[StreamName, list[SampleWriter]] = {
                stream: [
                    one.open_stream(carrier(get_wire(wire), stream), edge_writer)
                    for wire, one in zip(wires, self._wire_writers, strict=True)
                ]
                for stream in streams
            }
            self._opened = opening.pop_all()

    def publish(self, message: Message) -> None:
        """Publish one sample."""
        assert isinstance(message, StampedMessage)
        if self._claim is not None:
            self._claim.check()
            self._edge_monitor.check()
        stream: StreamName = next(one for one in _carrying(message) if one in self._streams)
        if isinstance(message, TransformSample) and stream in edge_streams():
            self._own(message.edges or ())
        self._seqs[stream] += self._missing_before(stream, message)
        write_all(self._streams[stream], renumbered(message, self._seqs[stream], self._session_id))
        self._seqs[stream] += 1

    def _missing_before(self, stream: StreamName, message: StampedMessage) -> int:
        """How many samples of bulk data the recording has lost: the packets of a video need each other."""
        before = self._recorded.get(stream)
        self._recorded[stream] = message.session, message.seq
        if not is_bulk(stream) or before is None or before[0] != message.session:
            return 0
        return max(message.seq - before[1] - 1, 0)

    def own_joints(self, edges: Sequence[Edge]) -> None:
        """Own joints, given by their edges, until the end. Raises SecondWriter if one has another writer."""
        if self._is_alone:
            announced = self._announced("partial_joint_states", self.edge_writer)
            claim = claim_edges(self._session, announced, edges, allowed=self._sessions)
            self._opened.enter_context(claim)

    def _own(self, edges: Edges) -> None:
        """Own moving edges until the end of the pass. Raises SecondWriter if another writer places one."""
        placed = self._placed.setdefault(self.edge_writer, set())
        new = [edge for edge in named_edges(self._robot, edges) if edge not in placed]
        if new and self._is_alone:
            announced = self._announced(self._moving, self.edge_writer)
            claim = claim_edges(self._session, announced, new, allowed=self._sessions)
            self._opened.enter_context(claim)
            self._edge_monitor.add(new)
        placed.update(new)

    def describe(self, description: RobotDescription) -> None:
        """Publish the robot's description (latched)."""
        orders = (description.joint_names, description.moving_edges)
        message = RobotDescription(self._session_id, description.urdf, description.digest, *orders, SIMULATED)
        write_all(self._latch("robot_description", MODEL_WRITER), message)

    def set_statics(self, statics: StaticTransforms, writer: str) -> None:
        """Publish all static edges of one ``writer``; an empty set withdraws the previous ones."""
        if not statics.edges:
            for latched in self._latched.get(("tf_static", writer), ()):
                latched.withdraw()
            self._placed.pop(writer, None)
            return
        writers = self._latch("tf_static", writer)
        edges = set(named_edges(self._robot, statics.edges))
        new = sorted(edges - self._placed.get(writer, set())) if self._is_alone else []
        with ExitStack() as placing:
            if new:  # owned during their publication
                announced = self._announced("tf_static", writer)
                placing.enter_context(claim_edges(self._session, announced, new, allowed=self._sessions))
            write_all(writers, StaticTransforms(self._session_id, statics.edges, statics.poses))
        self._placed[writer] = edges

    def set_value(self, stream: StreamName, message: Message, writer: str) -> None:
        """Publish the latched value of ``writer``; one that was withdrawn withdraws the previous one."""
        carried = ros_streams().get(stream)
        is_withdrawn = None if carried is None else carried.is_withdrawn
        if is_withdrawn is not None and is_withdrawn(message):
            self._withdraw(stream, writer)
            return
        write_all(self._latch(stream, writer), with_field(message, "session", self._session_id))
        self._values.add((stream, writer))

    def _withdraw(self, stream: StreamName, writer: str) -> None:
        if (stream, writer) in self._values:
            self._values.discard((stream, writer))
            for latched in self._latched[stream, writer]:
                latched.withdraw()

    def _latch(self, stream: StreamName, writer: str) -> list[LatchedWriter]:
        if (stream, writer) not in self._latched:
            announced = self._announced(stream, writer)
            with ExitStack() as opening:
                claim = self._claimed(opening, [announced])
                opened = [
                    one.open_latched(stream, writer) for one in self._wire_writers if one.wire.carries(stream)
                ]
                if claim is not None:
                    claim.confirm()
                self._opened.push(opening.pop_all())
            self._latched[stream, writer] = opened
        return self._latched[stream, writer]

    def _announced(self, stream: StreamName, writer: str) -> Announcement:
        return Announcement(self._robot, stream, self._writer, writer if is_named(stream) else "")

    def _claimed(self, opening: ExitStack, streams: Sequence[Announcement]) -> WriterClaim | None:
        if not self._is_alone or not streams:
            return None
        return opening.enter_context(WriterClaim(self._session, streams))

    def close(self) -> None:
        """Stop, and withdraw maps; readers keep the other latched values. A second call does nothing."""
        for stream, name in tuple(self._values):
            self._withdraw(stream, name)
        self._opened.close()


def _carrying(message: Message) -> tuple[StreamName, ...]:
    """The streams that may carry ``message``."""
    if isinstance(message, JointState):
        return ("partial_joint_states", "joint_states")
    return (*edge_streams(), "tf") if isinstance(message, TransformSample) else measured_streams()


def _is_computed(robot: str, writers: Collection[RecordedWriter]) -> bool:
    """Whether the transforms of a robot with a model follow from its joint states.

    That is the case without recorded transforms, or if the writer of the joint states wrote them too.
    """

    def sessions(stream: StreamName) -> set[int]:
        return {writer.session for writer in writers if (writer.robot, writer.stream) == (robot, stream)}

    return sessions("tf") <= sessions("joint_states")
