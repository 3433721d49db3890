"""Bidirectional bridge of robots between the native and the ROS 2 wire, without feedback loops.

``RobotBridge`` carries a whole robot: joint states and static edges in one direction (``StaticBridge``), and
moving edges other than the model's in both (``TransformBridge``). ``Bridge`` opens one for each robot that
is published on one side only.
"""

from __future__ import annotations

import logging
import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from itertools import compress
from typing import Literal, NamedTuple

from zstate._util.closeable import Closeable
from zstate.bridges.transforms import TransformRelay, edge_writer_of_node
from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.errors import Closed, InvalidInput, MessageError, ZStateError
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.transforms import StaticTransformIngest
from zstate.model.robot import RobotModel
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import WriterWatch, announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import OdometryPublisher
from zstate.odometry.messages import Odometry
from zstate.odometry.plugin import ODOMETRY
from zstate.sources.joint_state_listener import DescriptionSubscriber, JointStateListener
from zstate.streams import StreamName
from zstate.transform import Transform
from zstate.wire.identity import Announcement
from zstate.wire.keys import ANY, MODEL_WRITER, check_robot
from zstate.wire.messages import Edges, StaticTransforms, TransformSample, poses_from_block, to_block
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire
from zstate.wire.ros2.wire import Ros2Wire


class StaticBridge(Closeable):
    """Publishes with ``publisher`` the static edges of its robot that are not part of ``model``.

    If keys name the writer, the edges of a key are withdrawn with it. If all robots share one key, the
    edges whose child is a frame of this robot are published.
    """

    def __init__(
        self, session: Session, model: RobotModel, publisher: StaticPublisher, counters: Counters, wire: str
    ) -> None:
        self._robot = publisher.robot
        self._publisher = publisher
        self._published: dict[str, Transform] = {}
        self._counters = counters
        self._buffer = TransformBuffer()
        self._buffer.add_robot(model, self._robot)
        self._ownership = FrameOwnership(self._buffer, counters, is_shared=True)
        self._ingests: dict[str, StaticTransformIngest] = {}
        self._wire = get_wire(wire)
        key = self._wire.expression(self._robot, "tf_static")
        self._subscriber = LatchedSubscriber(session, key, self._on_static)

    def close(self) -> None:
        """Unsubscribe; published edges stay. A second call does nothing."""
        self._subscriber.close()

    def _on_static(self, arrival: SerializedSample) -> None:
        try:
            writer = self._wire.edge_writer_name(arrival.key)
        except InvalidInput as error:
            self._counters.count_refusal("foreign", str(error))
            return
        if writer == MODEL_WRITER:
            return
        make = StaticTransformIngest(self._robot, writer or self._wire.name, self._ownership)
        ingest = self._ingests.setdefault(arrival.key, make)
        try:
            messages = self._wire.decode("tf_static", arrival, self._robot) if arrival.payload else ()
        except MessageError as error:
            self._counters.count_refusal(error.reason, f"{arrival.key}: {error}")
            return
        # The session of the publisher may be closed already.
        with suppress(Closed):
            if not arrival.payload:
                ingest.withdraw()
            for message in messages:
                assert isinstance(message, StaticTransforms)
                if writer is not None:
                    ingest.replace(message)
                    continue
                # One key for all robots: the edges of this one.
                kept = [is_of_robot(self._robot, child) for _, child in message.edges]
                edges = tuple(compress(message.edges, kept))
                poses = to_block(poses_from_block(message.poses)[kept])
                ingest.add(StaticTransforms(message.session, edges, poses))
            self._publish_changes()

    def _publish_changes(self) -> None:
        """Publish the accepted edges that are new or changed, and withdraw those that are no longer there."""
        accepted = {
            child: Transform.from_pose7(edge.parent, child, edge.pose)
            for child, edge in feed_of(self._buffer).tree_snapshot().edges.items()
            if edge is not None and edge.kind == "static" and edge.robot is None
        }
        for child, before in list(self._published.items()):
            if child not in accepted or accepted[child].target != before.target:
                self._publisher.withdraw(child)
                del self._published[child]
        for child, edge in accepted.items():
            if self._published.get(child) != edge:
                self._publisher.set(edge)
                self._published[child] = edge


PROGRAM = "zstate_bridge"
"""The program name of a bridge on both wires; bridges do not carry what has this name."""

Way = Literal["native to ROS", "ROS to native"]


class BridgeSide(NamedTuple):
    """One side of a bridge: session, wire format, and the direction from there."""

    session: Session
    wire: str
    direction: Way


class TransformBridge(Closeable):
    """Publishes on ``target`` the moving edges of programs on ``source``, except those of ``model``.

    On the native side they keep the names of their writers; for a ROS node it is its own. Odometry is carried
    with its velocity and covariances: in ROS it is a nav_msgs/Odometry on a topic of its writer's name, and
    an edge on /tf. From ROS it is carried if its node also publishes that edge on /tf; poses of others are
    measurements. Other covariances are dropped, because /tf has none. Samples of bridges are skipped, and
    samples of writers that are not announced, which may be bridges. If all robots share /tf, the edges whose
    child is a frame of this robot are published. Subscribes only while there is a writer: on the ROS side the
    bridge itself would be a reader for which it computes /tf.
    """

    def __init__(
        self, robot: str, model: RobotModel, source: BridgeSide, target: BridgeSide, counters: Counters
    ) -> None:
        self._robot = robot
        self._source = source
        self._wire = get_wire(source.wire)
        self._counters = counters
        self._streams: tuple[StreamName, ...] = tuple(dict.fromkeys((*self._wire.edges, ODOMETRY.name)))
        self._writers: dict[int, str] = {}
        self._placed: defaultdict[str, set[Edges]] = defaultdict(set)
        """Single edges on /tf, by writer: those that its odometry may have."""
        self._as_odometry: dict[Edges, str] = {}
        """The edges of /tf that are carried as odometry, with their writers."""
        self._lock = threading.Lock()
        self._subscription: ExitStack | None = None

        def open_publisher(writer: str) -> TransformPublisher:
            return TransformPublisher(target.session, robot, writer, target.wire, program=PROGRAM)

        def open_odometry(writer: str) -> OdometryPublisher:
            return OdometryPublisher(target.session, robot, writer, target.wire, program=PROGRAM)

        with ExitStack() as opening:
            relay = TransformRelay(robot, model, open_publisher, counters.count_refusal, open_odometry)
            self._relay = opening.enter_context(relay)
            opening.callback(self._unsubscribe)
            opening.enter_context(WriterWatch(source.session, robot, self._on_writer, source.wire))
            self._opened = opening.pop_all()

    def close(self) -> None:
        """Unsubscribe, and close the publishers. A second call does nothing."""
        self._opened.close()

    def _on_writer(self, announced: Announcement, alive: bool) -> None:
        if announced.stream not in self._streams or is_bridge(announced):
            return
        session = announced.writer.session
        name = edge_writer_of_node(announced.writer.program) if self._wire.shared else announced.name
        if alive:
            self._writers[session] = name
            self._subscribe()
            return
        self._writers.pop(session, None)
        with self._lock:
            if announced.stream == ODOMETRY.name:  # its edge may go on
                self._as_odometry = {edge: one for edge, one in self._as_odometry.items() if one != name}
        if name not in self._writers.values():  # a ROS node may have several publishers
            self._placed.pop(name, None)
            self._relay.remove(name)
        if not self._writers:
            self._unsubscribe()

    def _subscribe(self) -> None:
        if self._subscription is not None:
            return
        session, robot, streams = self._source.session, self._robot, self._streams
        on_error = self._counters.count_refusal
        with ExitStack() as opening:
            for stream in streams:
                opening.enter_context(
                    subscribe(session, self._wire, robot, stream, self._on_messages, on_error=on_error)
                )
            for announcement in announce_reader(session, self._wire, robot, streams):
                opening.enter_context(announcement)
            self._subscription = opening.pop_all()

    def _unsubscribe(self) -> None:
        subscription, self._subscription = self._subscription, None
        if subscription is not None:
            subscription.close()

    def _on_messages(self, received: list[Received]) -> None:
        with suppress(Closed):
            for _, _, sample in received:
                assert isinstance(sample, TransformSample)
                writer = self._writers.get(sample.session)
                if writer is not None and isinstance(sample, Odometry):
                    self._publish_odometry(writer, sample)
                elif writer is not None and sample.edges is not None:
                    self._publish(writer, sample.edges, sample)

    def _publish_odometry(self, writer: str, sample: Odometry) -> None:
        edges = sample.edges
        assert edges is not None
        if self._wire.shared:
            with self._lock:
                if edges not in self._placed[writer]:
                    return
                if edges not in self._as_odometry:
                    self._relay.remove(writer)  # which owns the edge
                    self._as_odometry[edges] = writer
        self._relay.publish_odometry(writer, sample)

    def _publish(self, writer: str, edges: Edges, sample: TransformSample) -> None:
        poses = poses_from_block(sample.poses)
        with self._lock:
            if self._wire.shared:
                self._placed[writer].update((edge,) for edge in edges if is_of_robot(self._robot, edge[1]))
                kept = [
                    (edge,) in self._placed[writer] and (edge,) not in self._as_odometry for edge in edges
                ]
                edges, poses = tuple(compress(edges, kept)), poses[kept]
            if edges:
                self._relay.publish(writer, edges, poses, sample.stamp)


def is_of_robot(robot: str, frame: str) -> bool:
    """Whether a frame in messages of ``robot`` is one of its own."""
    return frame.partition("/")[0] in (robot, frame)


def is_bridge(announced: Announcement) -> bool:
    """Whether it is a writer of a bridge, on either side."""
    # The name of a ROS node includes its namespace.
    return announced.writer.program.rpartition("/")[2] == PROGRAM


class RobotBridge(Closeable):
    """Publishes on ``target`` the messages of ``robot`` from ``source``, from its first model on.

    Joint states keep their stamps and numbers; model and static edges are latched for late joiners. Moving
    edges that are not the model's are carried in both directions: odometry may come from either side.
    ``on_model()`` is called with each model. ``refused`` counts messages that ``target`` cannot express; the
    first of each kind is logged.
    """

    def __init__(
        self, robot: str, source: BridgeSide, target: BridgeSide, on_model: Callable[[], object]
    ) -> None:
        self.robot = robot
        self.source = source
        self.target = target
        self.has_model = False
        self._on_model = on_model
        self._counters = Counters()
        self._lock = threading.Lock()
        self._closed = False
        self._carrying = ExitStack()
        self._descriptions = DescriptionSubscriber(source.session, robot, self._carry, source.wire)

    @property
    def refused(self) -> dict[str, int]:
        """Counts of joint states, transforms, static edges and models that could not be carried."""
        return self._counters.stats().refused

    def _carry(self, robot: str, model: RobotModel) -> None:
        with self._lock:
            self._carrying.close()
            if self._closed:
                return
            try:
                self._open_publisher(model)
            except ZStateError as error:
                self._counters.count_refusal("model", f"{robot!r} is not carried: {error}")
                return
        self.has_model = True
        self._on_model()

    def _open_publisher(self, model: RobotModel) -> None:
        robot, source, target = self.robot, self.source, self.target
        with ExitStack() as opening:
            publisher = opening.enter_context(
                # takeover: other bridges may publish it as well; the direction is already chosen.
                StatePublisher(target.session, model, robot, (target.wire,), program=PROGRAM, takeover=True)
            )
            statics = opening.enter_context(
                StaticPublisher(target.session, robot, wires=(target.wire,), program=PROGRAM, takeover=True)
            )
            opening.enter_context(StaticBridge(source.session, model, statics, self._counters, source.wire))
            for one, other in ((source, target), (target, source)):
                opening.enter_context(TransformBridge(robot, model, one, other, self._counters))
            readings = opening.enter_context(
                JointStateListener(source.session, robot, model, wire=source.wire)
            )
            self._carrying = opening.pop_all()
        threading.Thread(
            target=self._publish, args=(readings, publisher), name=f"zstate bridge {robot}", daemon=True
        ).start()

    def _publish(self, readings: JointStateListener, publisher: StatePublisher) -> None:
        with suppress(Closed):
            for reading in readings:
                try:
                    publisher.publish(reading.positions, reading.velocities, reading.efforts, reading.stamp)
                except InvalidInput as error:
                    self._counters.count_refusal("joint state", f"{self.robot!r}: {error}")

    def close(self) -> None:
        """Stop, and withdraw what was published. A second call does nothing."""
        self._descriptions.close()
        with self._lock:
            self._closed = True
            self._carrying.close()


_LOG = logging.getLogger("zstate")

# Streams that identify the publisher of a robot; one /tf may contain all robots.
_ROBOT_STREAMS: tuple[StreamName, ...] = ("joint_states", "robot_description")

_ADVICE = (
    "name one, as `zstate bridge panda` does, or give each its own namespace with the wire 'ros2:namespace=*'"
)


class Bridge(Closeable):
    """Carries each robot that is published on one side to the other: joint states, model, static edges.

    The transforms of the model are recomputed on the other side; other moving edges are carried from either
    side to the other: those of each native ``TransformPublisher``, and those of ROS nodes on /tf.
    ``robots`` names the robots; None is all, which needs a namespace for each: the ``ros_wire``
    "ros2:namespace=*". Messages of bridges are never carried back. A robot with other publishers on both
    sides is not carried, which is logged.

    ``on_change(robot, way)`` is called with each first or new model of a carried robot, and with None when
    carrying stops; from threads of the bridge. Raises InvalidInput for robots that would share a namespace,
    and for a wire format without the names of writers.
    """

    def __init__(
        self,
        native: Session,
        ros: Session,
        ros_wire: str = "ros2",
        robots: Sequence[str] | None = None,
        *,
        on_change: Callable[[str, Way | None], object] | None = None,
    ) -> None:
        _check(ros_wire, robots)
        self._sides = (
            BridgeSide(native, "native", "native to ROS"),
            BridgeSide(ros, ros_wire, "ROS to native"),
        )
        self._on_change: Callable[[str, Way | None], object] = on_change or (lambda _robot, _way: None)
        self._writers: defaultdict[str, tuple[set[Announcement], ...]] = defaultdict(lambda: (set(), set()))
        self._carriers: dict[str, RobotBridge] = {}
        self._conflicts: set[str] = set()
        self._lock = threading.RLock()  # on_change may read ``carriers``
        with ExitStack() as opening:
            opening.callback(self._close_robots)
            for number, side in enumerate(self._sides):
                for robot in robots or (ANY,):
                    on_writer = partial(self._on_writer, number)
                    opening.enter_context(WriterWatch(side.session, robot, on_writer, side.wire))
            self._opened = opening.pop_all()

    @property
    def carriers(self) -> tuple[RobotBridge, ...]:
        """The open robot bridges, including robots without a description so far."""
        with self._lock:
            return tuple(self._carriers.values())

    def close(self) -> None:
        """Stop carrying. A second call does nothing."""
        self._opened.close()

    def _on_writer(self, side: int, announced: Announcement, alive: bool) -> None:
        if announced.stream in _ROBOT_STREAMS and not is_bridge(announced):
            with self._lock:
                writers = self._writers[announced.robot]
                (writers[side].add if alive else writers[side].discard)(announced)
                self._decide(announced.robot, *writers)

    def _decide(self, robot: str, native: set[Announcement], ros: set[Announcement]) -> None:
        source, target = self._sides if native else reversed(self._sides)
        is_one_sided = bool(native) != bool(ros)
        carrier = self._carriers.get(robot)
        if carrier is not None and not (is_one_sided and carrier.source is source):
            self._close_robot(robot)
        if is_one_sided and robot not in self._carriers:
            on_model = partial(self._on_change, robot, source.direction)
            self._carriers[robot] = RobotBridge(robot, source, target, on_model)
        if not (native and ros):
            self._conflicts.discard(robot)
        elif robot not in self._conflicts:
            self._conflicts.add(robot)
            _LOG.warning(
                "%r is published natively by %s and in ROS by %s, so it is not carried; stop one of them, "
                "or give them different names",
                robot,
                _named(native),
                _named(ros),
                extra={"event": "conflict", "robot": robot},
            )

    def _close_robot(self, robot: str) -> None:
        carrier = self._carriers.pop(robot)
        carrier.close()
        if carrier.has_model:
            self._on_change(robot, None)

    def _close_robots(self) -> None:
        with self._lock:
            for robot in list(self._carriers):
                self._close_robot(robot)


def _named(writers: set[Announcement]) -> str:
    return " and ".join(sorted({repr(str(announced.writer)) for announced in writers}))


def _check(ros_wire: str, robots: Sequence[str] | None) -> None:
    wire = get_wire(ros_wire)
    if not isinstance(wire, Ros2Wire) or wire.name != "ros2":
        raise InvalidInput(
            f"a bridge connects the native wire to 'ros2', not to {wire.name!r}, where it cannot identify "
            "its own messages"
        )
    options = wire.options
    if options.node:
        raise InvalidInput(
            f"the ros2 option node is {options.node!r}, but the nodes of a bridge are called {PROGRAM!r}, "
            "by which bridges recognise each other; leave it out"
        )
    names = [check_robot(robot) for robot in robots or ()]
    if len(names) == 1:
        return
    if options.namespace != ANY:
        raise InvalidInput(
            f"the namespace '/{options.namespace}' of ROS has room for one robot, "
            f"not for {' and '.join(map(repr, names)) or 'all'}; {_ADVICE}"
        )
    if ANY not in (options.frame_prefix or ANY) and options.tf == "global":
        raise InvalidInput(f"the frames of several robots would be mixed up in /tf of ROS; {_ADVICE}")
