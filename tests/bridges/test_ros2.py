"""Whole robots between two networks: native sessions that meet on this host, ROS's behind a router."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np
import pytest
from helpers.processes import find_free_port, until
from helpers.robots import RRBOT, STAMP, UPRIGHT

from zstate.bridges.ros2 import Bridge
from zstate.errors import InvalidInput
from zstate.model.load import load_model
from zstate.net.discovery import discover
from zstate.net.session import Session, connect
from zstate.net.streams import StreamSubscriber
from zstate.net.subscription import Received, subscribe
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import OdometryPublisher
from zstate.odometry.messages import Odometry
from zstate.sources import JointStateListener, SineSource
from zstate.transform import Transform
from zstate.wire.measurements import covariance_matrix
from zstate.wire.messages import from_block
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire

GRIPPER = load_model("gripper")
EACH = "ros2:namespace=*"
STAMPS = [STAMP + number * 10_000_000 for number in range(20)]
SINE = SineSource(RRBOT)
EFFORTS = [0.25, -3.5]
TO_ROS, TO_NATIVE = "native to ROS", "ROS to native"


@dataclass
class World:
    """Two networks and the bridges between them; ``changes`` has their ``on_change`` calls."""

    endpoint: str
    join: Callable[[str], Session]
    open: Callable[..., Bridge]
    changes: list[tuple[str, str | None]] = field(default_factory=list)

    def bridge(self, *robots: str, wire: str = "ros2") -> Bridge:
        on_change = lambda robot, way: self.changes.append((robot, way))  # noqa: E731
        return self.open(self.join("native"), self.join("ros2"), wire, robots or None, on_change=on_change)


@pytest.fixture
def world() -> Iterator[World]:
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    with ExitStack() as opened:
        opened.enter_context(connect(mode="router", listen=endpoint))

        def join(wire: str) -> Session:
            where = {} if wire == "native" else {"mode": "client", "endpoints": endpoint}
            return opened.enter_context(connect(**where))

        yield World(endpoint, join, lambda *args, **options: opened.enter_context(Bridge(*args, **options)))


@pytest.fixture(params=["native", "ros2"])
def here(request: pytest.FixtureRequest) -> str:
    """The wire on which the robot is published."""
    return request.param


@pytest.fixture
def there(here: str) -> str:
    return "ros2" if here == "native" else "native"


def way_of(here: str) -> str:
    return TO_ROS if here == "native" else TO_NATIVE


def publish(publisher: StatePublisher, stamps: list[int] = STAMPS) -> None:
    for stamp in stamps:
        reading = SINE.read(stamp)
        publisher.publish(reading.positions, reading.velocities, EFFORTS, stamp)


def publish_until(publisher: StatePublisher, arrived: Callable[[], object]) -> None:
    """Samples at ever new stamps, until one of them got through."""
    stamps = iter(range(1, 1_000_000))
    until(lambda: publish(publisher, [next(stamps)]) or arrived())


class Ear:
    """Counts received samples of a stream of a robot by stamp."""

    def __init__(self, session: Session, robot: str, wire: str, stream: str = "joint_states") -> None:
        self.stamps: Counter[int] = Counter()
        self._robot, self._wire = robot, get_wire(wire)
        self._stream = self._wire.transforms if stream == "transforms" else stream
        self._subscriber = StreamSubscriber(session, self._wire.expression(robot, self._stream), self._take)

    def _take(self, arrivals: list[SerializedSample]) -> None:
        for arrival in arrivals:
            self.stamps.update(s.stamp for s in self._wire.decode(self._stream, arrival, self._robot))

    def __enter__(self) -> Ear:
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriber.close()


def receives(listener: TransformListener, stamp: int | None = None) -> bool:
    return listener.buffer.can_lookup("world", "tool", stamp)


def frames(listener: TransformListener) -> set[str]:
    return {frame.name.partition("/")[2] for frame in listener.buffer.frames()}


def programs(session: Session, wire: str, robot: str = "") -> set[str]:
    """Which programs write for ``robot``, or for all."""
    infos = [info for info in discover(session, wire=wire) if robot in ("", info.name)]
    return {writer.program for info in infos for _, writer in info.writers}


def test_a_robot_is_carried_bit_for_bit_with_its_stamps(world, here, there):
    world.bridge("r1")
    with (
        StatePublisher(world.join(here), RRBOT, "r1", (here,)) as publisher,
        TransformListener(world.join(here), "r1", wire=here) as original,
        TransformListener(world.join(there), "r1", wire=there) as carried,
    ):
        publish_until(publisher, lambda: receives(original) and receives(carried))
        publish(publisher)
        until(lambda: receives(original, STAMPS[-1]) and receives(carried, STAMPS[-1]))
        for stamp in [*STAMPS, STAMP + 5_000_001]:
            one, other = (side.buffer.lookup("world", "tool", stamp) for side in (original, carried))
            assert one.pose7.tobytes() == other.pose7.tobytes()
            assert (one.stamp, one.kind) == (other.stamp, other.kind)
        assert carried.stats.refused == {}
    assert world.changes[0] == ("r1", way_of(here))


def test_every_number_of_a_joint_state_is_carried(world, here, there):
    world.bridge("r1")
    with (
        StatePublisher(world.join(here), RRBOT, "r1", (here,)) as publisher,
        JointStateListener(world.join(there), "r1", RRBOT, wire=there) as source,
    ):
        publish_until(publisher, lambda: source.read(0))
        publish(publisher)
        carried = next(reading for reading in source if reading.stamp == STAMPS[0])
        expected = SINE.read(STAMPS[0])
        assert carried.positions.tobytes() == expected.positions.tobytes()
        assert carried.velocities.tobytes() == expected.velocities.tobytes()
        assert carried.efforts.tolist() == EFFORTS


def test_late_joiners_receive_the_model_and_the_fixed_edges(world, here, there):
    with StatePublisher(world.join(here), RRBOT, "r1", (here,)):
        world.bridge("r1")
        until(lambda: world.changes)
        with TransformListener(world.join(there), "r1", wire=there, follow="tf") as listener:
            until(lambda: listener.buffer.can_lookup("tool", "camera_link"))


def test_other_static_edges_are_carried_and_edges_of_the_model_are_not_repeated(world, here, there):
    world.bridge("r1")
    hook = Transform("tool", "hook", (0.0, 0.125, 0.25), UPRIGHT)
    session = world.join(here)
    with (
        StaticPublisher(session, "r1", "mount", here) as statics,
        StatePublisher(session, RRBOT, "r1", (here,)),
        TransformListener(world.join(there), "r1", wire=there) as listener,
    ):
        statics.set(hook)
        camera_from_hook = listener.buffer.wait("camera_link", "hook", timeout_s=10.0)
        with TransformListener(session, "r1", wire=here) as near:
            expected = near.buffer.wait("camera_link", "hook", timeout_s=10.0)
        assert np.allclose(camera_from_hook.matrix, expected.matrix, rtol=0, atol=1e-15)
        moved = Transform("tool", "hook", (0.5, 0.0, 0.0), UPRIGHT)
        statics.set(moved)
        until(lambda: listener.buffer.lookup("tool", "hook").translation.tolist() == [0.5, 0.0, 0.0])
        assert listener.stats.refused == {}


def test_a_native_withdrawal_reaches_late_joiners_in_ros(world):
    world.bridge("r1")
    session = world.join("native")
    with (
        StatePublisher(session, RRBOT, "r1"),
        StaticPublisher(session, "r1", "mount") as statics,
        TransformListener(world.join("ros2"), "r1", wire="ros2") as early,
    ):
        statics.set(Transform("tool", "hook", (0.0, 0.0, 0.25), UPRIGHT))
        statics.set(Transform("tool", "lamp", (0.0, 0.0, 0.5), UPRIGHT))
        until(lambda: {"hook", "lamp"} <= frames(early))
        statics.withdraw("hook")
        statics.set(Transform("tool", "bolt", (0.0, 0.0, 0.75), UPRIGHT))
        until(lambda: "bolt" in frames(early))
        with TransformListener(world.join("ros2"), "r1", wire="ros2") as late:
            until(lambda: {"lamp", "bolt", "tool"} <= frames(late))
            assert "hook" not in frames(late)


def test_another_model_replaces_the_first(world, here, there):
    world.bridge("r1")
    session = world.join(here)
    still = [0.0] * GRIPPER.position_count
    with (
        TransformListener(world.join(there), "r1", wire=there) as listener,
        StatePublisher(session, RRBOT, "r1", (here,)),
    ):
        until(lambda: "tool" in frames(listener))
        with StatePublisher(session, GRIPPER, "r1", (here,), takeover=True) as publisher:
            until(lambda: len(world.changes) == 2)
            pair = GRIPPER.root, GRIPPER.links[-1]
            until(lambda: publisher.publish(still) or listener.buffer.can_lookup(*pair))
    assert world.changes[:2] == [("r1", way_of(here))] * 2


def test_carrying_stops_with_the_robot_and_restarts_with_its_return(world, here, there):
    world.bridge("r1")
    session, other = world.join(here), world.join(there)
    with TransformListener(other, "r1", wire=there) as listener:
        for time in (1, 2):
            with StatePublisher(session, RRBOT, "r1", (here,)) as publisher:
                until(lambda: programs(other, there) == {bridge_on(there)})
                # The second run begins at earlier stamps, as after a reset of simulated time.
                stamp = STAMP - time * 3600 * 10**9
                until(lambda s=stamp, p=publisher: publish(p, [s]) or receives(listener, s))
            until(lambda n=time: len(world.changes) == 2 * n)
            until(lambda: not programs(other, there))
        assert listener.buffer.latest("world", "tool") == STAMP - 2 * 3600 * 10**9
    assert world.changes == [("r1", way_of(here)), ("r1", None)] * 2


def bridge_on(wire: str) -> str:
    return "zstate_bridge" if wire == "native" else "/zstate_bridge"


WRITER = """
    import sys
    from zstate import StatePublisher, connect, load_model
    options = {"mode": "client", "endpoints": sys.argv[2]} if sys.argv[2] else {}
    with connect(**options) as session, StatePublisher(session, load_model("rrbot"), "r1", (sys.argv[1],)):
        print("there")
        sys.stdin.readline()
"""


@pytest.mark.processes
def test_carrying_stops_when_the_writer_is_killed(world, here, there, spawn):
    world.bridge("r1")
    other = world.join(there)
    child = spawn(WRITER, here, world.endpoint if here == "ros2" else "")
    assert child.line() == "there"
    until(lambda: programs(other, there))
    child.kill()
    until(lambda: world.changes == [("r1", way_of(here)), ("r1", None)])
    until(lambda: not programs(other, there))


@pytest.mark.parametrize("count", [1, 2])
def test_parallel_bridges_do_not_carry_messages_back(world, count):
    bridges = [world.bridge(wire=EACH) for _ in range(count)]
    with ExitStack() as opened:
        for robot, here, there in (("r1", "native", EACH), ("r2", EACH, "native")):
            session = world.join(here)
            publisher = opened.enter_context(StatePublisher(session, RRBOT, robot, (here,)))
            source = opened.enter_context(Ear(world.join(here), robot, here))
            carried = opened.enter_context(Ear(world.join(there), robot, there))
            publish_until(publisher, lambda e=carried, s=source: s.stamps and count in e.stamps.values())
            # An echo of the first would be there before all of the last were carried.
            publish(publisher)
            for stamp in (STAMPS[-1] + 1, STAMPS[-1] + 2):
                publish(publisher, [stamp])
                until(lambda e=carried, s=stamp: e.stamps[s] == count)
                until(lambda e=source, s=stamp: e.stamps[s])
            assert {source.stamps[stamp] for stamp in STAMPS} == {1}
            assert {carried.stamps[stamp] for stamp in STAMPS} == {count}
            assert not any("zstate_bridge" in name for name in programs(session, here, robot))
    until(lambda: len(world.changes) == 4 * count)
    assert sorted(world.changes[: 2 * count]) == sorted([("r1", TO_ROS), ("r2", TO_NATIVE)] * count)
    assert [bridge.carriers for bridge in bridges] == [()] * count


def test_every_robot_has_its_own_namespace(world):
    world.bridge(wire=EACH)
    session = world.join("native")
    with (
        StatePublisher(session, RRBOT, "r1") as first,
        StatePublisher(session, RRBOT, "r2") as second,
        TransformListener(world.join("ros2"), wire=EACH) as listener,
    ):
        tools = [("r1/world", "r1/tool"), ("r2/world", "r2/tool")]
        until(
            lambda: (
                first.publish([0.5, 0.0], stamp=STAMP)
                or second.publish([1.0, 0.0], stamp=STAMP)
                or all(listener.buffer.can_lookup(*pair) for pair in tools)
            )
        )
        one, other = (listener.buffer.lookup(*pair, STAMP) for pair in tools)
        assert not np.allclose(one.matrix, other.matrix)
        assert {"r1", "r2"} <= set(listener.robots())


def test_static_edges_of_another_robot_are_not_carried(world):
    world.bridge(wire=EACH)
    ros = world.join("ros2")
    with (
        StatePublisher(ros, RRBOT, "r1", (EACH,)),
        StaticPublisher(ros, "r1", wires=EACH) as own,
        StaticPublisher(ros, "r2", wires=EACH) as foreign,
        TransformListener(world.join("native")) as listener,
    ):
        foreign.set(Transform("base", "plate", (0.0, 0.0, 1.0), UPRIGHT))
        own.set(Transform("fleet/map", "world", (1.0, 0.0, 0.0), UPRIGHT))
        until(lambda: listener.buffer.can_lookup("fleet/map", "r1/world"))
        # Each of ROS's late joiners' values has come by then, or comes with the next.
        own.set(Transform("tool", "hook", (0.0, 0.0, 1.0), UPRIGHT))
        until(lambda: "r1/hook" in {frame.name for frame in listener.buffer.frames()})
        assert not any("plate" in frame.name for frame in listener.buffer.frames())


def odometry_on(session: Session, side: str) -> TransformPublisher:
    """A writer of odometry: "odometry" in zstate, the node ``/ekf`` in ROS."""
    wire = "native" if side == "native" else "ros2:node=ekf"
    return TransformPublisher(session, "r1", "odometry", wire)


def edge(child: str, x: float, parent: str = "odom") -> Transform:
    return Transform(parent, child, (x, 0.0, 0.0), UPRIGHT)


def test_odometry_is_carried_with_its_velocity_and_covariances_beside_its_edge(world, here, there):
    """From ROS as well, where its node publishes both."""
    bridge = world.bridge("r1")
    received: list[Odometry] = []

    def on_messages(messages: list[Received]) -> None:
        received.extend(one.message for one in messages if isinstance(one.message, Odometry))

    far = world.join(there)
    wire = "native" if here == "native" else "ros2:node=ekf"
    with (
        StatePublisher(world.join(here), RRBOT, "r1", (here,)) as publisher,
        OdometryPublisher(world.join(here), "r1", wires=wire) as odometry,
        TransformListener(far, "r1", wire=there) as carried,
        subscribe(far, get_wire(there), "r1", "odometry", on_messages),
    ):
        pose_covariance, twist_covariance = np.diag(np.arange(1.0, 7.0)), np.diag(np.arange(7.0, 13.0))
        pose = edge("world", 2.0).with_covariance(pose_covariance)

        def move(stamp: int) -> bool:
            publish(publisher, [stamp])
            odometry.publish(pose, [1, 2, 3], [4, 5, 6], stamp, twist_covariance=twist_covariance)
            return carried.buffer.can_lookup("odom", "tool") and bool(received)

        stamps = iter(range(1, 1_000_000))
        until(lambda: move(next(stamps)))
        assert carried.buffer.lookup("odom", "world").translation[0] == 2.0
        assert bridge.carriers[0].refused == {}
    message = received[-1]
    assert message.edges == (("odom", "world"),)
    assert from_block(message.twist).tolist() == [1, 2, 3, 4, 5, 6]
    assert message.covariances is not None
    assert message.twist_covariance is not None
    assert covariance_matrix(message.covariances).tolist() == pose_covariance.tolist()
    assert covariance_matrix(message.twist_covariance).tolist() == twist_covariance.tolist()


@pytest.mark.parametrize("side", ["native", "ros2"])
def test_other_moving_edges_are_carried_from_either_side(world, here, there, side):
    world.bridge("r1")
    with (
        StatePublisher(world.join(here), RRBOT, "r1", (here,)) as publisher,
        odometry_on(world.join(side), side) as odometry,
        TransformListener(world.join(here), "r1", wire=here) as original,
        TransformListener(world.join(there), "r1", wire=there) as carried,
    ):
        covariance = np.diag([0.25] * 6)

        def move(stamp: int) -> None:
            publish(publisher, [stamp])
            odometry.publish([edge("world", stamp * 1e-9).with_covariance(covariance)], stamp)

        stamps = iter(range(1, 1_000_000))
        sides = original.buffer, carried.buffer
        until(lambda: move(next(stamps)) or all(buffer.can_lookup("odom", "tool") for buffer in sides))
        for stamp in STAMPS:
            move(stamp)
        for at in (STAMPS[3], STAMPS[3] + 2_500_000, STAMPS[-1]):
            one, other = (buffer.lookup("odom", "tool", at, timeout_s=10.0) for buffer in sides)
            assert one.pose7.tobytes() == other.pose7.tobytes()
        assert original.stats.refused == carried.stats.refused == {}


def test_edges_of_a_ros_node_have_its_name_in_zstate_until_it_leaves(world):
    bridge = world.bridge("r1")
    ros, native = world.join("ros2"), world.join("native")

    def names() -> set[str]:
        return {name for info in discover(native) for name, _ in info.named("transforms")}

    with StatePublisher(ros, RRBOT, "r1", ("ros2",)), TransformListener(native, "r1") as listener:
        stamps = iter(range(STAMP, STAMP + 1_000_000))
        for _ in range(2):  # a node that leaves, and its successor
            stamp = next(stamps)
            with (
                odometry_on(ros, "ros2") as odometry,
                TransformPublisher(ros, "r1", wires="ros2:node=robot_state_publisher") as state_publisher,
            ):

                def is_carried() -> bool:
                    nonlocal stamp
                    stamp = next(stamps)
                    state_publisher.publish([edge("upper", 9.0, "base")], stamp)
                    odometry.publish([edge("world", 1.0), edge("upper", 9.0, "base")], stamp)
                    return listener.buffer.can_lookup("odom", "world", stamp)

                until(is_carried)
                assert names() == {"ekf"}
            until(lambda: names() == set())
        assert bridge.carriers[0].refused == {}


@pytest.mark.parametrize("side", ["native", "ros2"])
def test_carried_edges_do_not_come_back(world, here, side):
    for _ in range(2):
        world.bridge("r1")
    far = "ros2" if side == "native" else "native"
    with (
        StatePublisher(world.join(here), RRBOT, "r1", (here,), streams=("joint_states", "robot_description")),
        odometry_on(world.join(side), side) as odometry,
        Ear(world.join(side), "r1", side, "transforms") as source,
        Ear(world.join(far), "r1", far, "transforms") as carried,
    ):
        # In ROS both bridges publish what is native; in zstate one of them owns the edge.
        count = 2 if far == "ros2" else 1
        stamps = iter(range(1, 1_000_000))

        def goes_through() -> bool:
            stamp = next(stamps)
            odometry.publish([edge("world", 1.0)], stamp)
            return count in carried.stamps.values() and bool(source.stamps)

        until(goes_through)
        for stamp in STAMPS:
            odometry.publish([edge("world", 1.0)], stamp)
            until(lambda s=stamp: carried.stamps[s] == count and source.stamps[s])
        assert {source.stamps[stamp] for stamp in STAMPS} == {1}
        assert {carried.stamps[stamp] for stamp in STAMPS} == {count}


def test_an_edge_with_a_native_owner_is_refused_and_others_are_carried(world, caplog):
    bridge = world.bridge("r1")
    ros, native = world.join("ros2"), world.join("native")
    with (
        StatePublisher(ros, RRBOT, "r1", ("ros2",)),
        TransformPublisher(native, "r1", "slam") as slam,
        TransformListener(native, "r1") as listener,
        odometry_on(ros, "ros2") as odometry,
    ):
        slam.publish([edge("world", 5.0)], STAMP)
        stamps = iter(range(STAMP, STAMP + 1_000_000))

        def is_refused() -> bool:
            odometry.publish([edge("world", 1.0)], next(stamps))
            odometry.publish([edge("ball", 2.0)], next(stamps))
            refused = bridge.carriers[0].refused if bridge.carriers else {}
            return refused.get("second writer", 0) > 10 and listener.buffer.can_lookup("odom", "ball")

        until(is_refused)
        assert listener.buffer.lookup("odom", "world", STAMP).translation[0] == 5.0
    texts = [record.message for record in caplog.records if "transforms of 'ekf'" in record.message]
    assert len(texts) == 1
    assert "as 'slam' of 'r1'" in texts[0]


def test_a_robot_published_on_both_sides_is_not_carried_and_logged_once(world, caplog):
    bridge = world.bridge("r1")
    native, ros = world.join("native"), world.join("ros2")
    with caplog.at_level(logging.WARNING, "zstate"), StatePublisher(native, RRBOT, "r1"):
        until(lambda: bridge.carriers)
        with StatePublisher(ros, RRBOT, "r1", ("ros2:node=driver",)):
            until(lambda: programs(ros, "ros2") == {"/driver"} and bridge.carriers == ())
        # With one of them gone the other one is carried again.
        until(lambda: world.changes[-1:] == [("r1", TO_ROS)])
    warnings = [record.message for record in caplog.records if "not carried" in record.message]
    assert len(warnings) == 1
    assert "in ROS by '/driver'" in warnings[0]
    assert {way for _, way in world.changes} <= {TO_ROS, None}


def test_messages_without_a_ros_form_are_counted_and_carrying_continues(world, caplog):
    bridge = world.bridge("r1")
    with (
        StatePublisher(world.join("native"), RRBOT, "r1") as publisher,
        TransformListener(world.join("ros2"), "r1", wire="ros2") as listener,
    ):
        publish_until(publisher, lambda: receives(listener))
        publish(publisher, [0, 0, STAMP])
        until(lambda: receives(listener, STAMP))
        (carrier,) = bridge.carriers
        assert carrier.refused == {"joint state": 2}
    assert sum("the stamp is 0" in record.message for record in caplog.records) == 1


def test_invalid_ros_namespace_is_logged(world, caplog):
    bridge = world.bridge(wire=EACH)
    with StatePublisher(world.join("native"), RRBOT, "arm-1"):
        until(lambda: bridge.carriers and bridge.carriers[0].refused)
        until(lambda: "'arm_1'" in caplog.text)
    assert world.changes == []


@pytest.mark.parametrize(
    ("wire", "robots", "words"),
    [
        ("ros2", None, ["room for one robot, not for all", "zstate bridge panda", EACH]),
        ("ros2", ["r1", "r2"], ["not for 'r1' and 'r2'", EACH]),
        ("ros2:namespace=cell", None, ["namespace '/cell'"]),
        ("ros2:namespace=*,frame_prefix=x/", None, ["mixed up in /tf", EACH]),
        ("ros2:node=mine", ["r1"], ["node is 'mine'", "zstate_bridge"]),
        ("ros2dds", ["r1"], ["'ros2dds'", "its own messages"]),
        ("native", ["r1"], ["'native'"]),
        ("ros2", ["a/b"], ["'a/b'"]),
    ],
)
def test_ambiguous_arguments_are_refused(sessions, wire, robots, words):
    with pytest.raises(InvalidInput) as caught:
        Bridge(*sessions, wire, robots)
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize("wire", ["ros2:namespace=*,tf=namespace", "ros2:namespace=cell", "ros2:domain=7"])
def test_one_robot_may_use_any_namespace(sessions, wire):
    with Bridge(*sessions, wire, ["r1"]) as bridge:
        assert bridge.carriers == ()
    bridge.close()
