"""zstate and a real ROS 1, joined by the bridge."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from xmlrpc.client import ServerProxy

import numpy as np
import pytest
from helpers.processes import Child, until
from helpers.ros1_processes import (
    BRIDGE,
    DEBIAN_PACKAGES,
    JOINTS,
    RRBOT,
    STATE_PUBLISHER,
    Roscore,
    RosPeer,
    Spawn,
    ros_environment,
)

from zstate import (
    PartialStatePublisher,
    StatePublisher,
    StaticPublisher,
    Transform,
    TransformListener,
    TransformPublisher,
    connect,
    discover,
    load_model,
)
from zstate.bridges.ros1.node import Master
from zstate.sources import JointStateListener

pytestmark = pytest.mark.ros1

Bridge = Callable[..., Child]
MODEL = load_model(RRBOT)
S = 1_000_000_000
# Noetic's Python carries time as float seconds, which resolve 238 ns today: 0.3 um at 1.5 rad/s and 0.8 m.
NOETIC = 1e-6


def swing(stamp: int) -> list[float]:
    """Positions of rrbot at a stamp."""
    t = (stamp % (1000 * S)) / S
    return [0.5 * math.sin(1.5 * t), -0.3 + 0.4 * math.cos(t)]


def publish_joints(talker: RosPeer, stamp: int) -> None:
    talker.query("joints", stamp, JOINTS, swing(stamp))


def answer(listener: TransformListener, target: str, source: str) -> Transform | None:
    buffer = listener.buffer
    return buffer.lookup(target, source) if buffer.can_lookup(target, source) else None


def assert_same_pose(a: Sequence[float], b: Sequence[float], tolerance: float) -> None:
    sign = math.copysign(1.0, float(np.dot(a[3:], b[3:])))
    np.testing.assert_allclose((*a[:3], *(sign * np.array(a[3:]))), b, atol=tolerance)


def interrupted(child: Child) -> None:
    child.process.send_signal(signal.SIGINT)
    assert child.wait() == 130, child.stderr
    assert "Traceback" not in child.stderr


def test_ros_looks_up_a_robot_of_zstate_as_zstate_does(bridge: Bridge, tf2_listener: Callable[[], RosPeer]):
    listening = tf2_listener()
    with (
        connect() as session,
        StatePublisher(session, MODEL, "rrbot") as publisher,
        StaticPublisher(session, "rrbot", "mount") as statics,
        TransformListener(session) as listener,
    ):
        statics.set(Transform.from_rpy("tool", "probe", (0.1, 0.0, 0.05), (0.2, -0.3, 0.4)))
        carrying = bridge("--to-ros")
        stamp = time.time_ns()

        def goes_on() -> int:
            nonlocal stamp
            stamp += 10_000_000
            publisher.publish(swing(stamp), stamp=stamp)
            return stamp

        # Only after the first sample the connection is complete.
        until(lambda: isinstance(listening.query("base", "probe", goes_on(), 0.02), list))
        begin = stamp
        end = [goes_on() for _ in range(50)][-1]
        for at in range(begin, end, 17_000_003):
            theirs, at_theirs = listening.query("world", "probe", at, 5.0)
            ours = listener.buffer.lookup("world", "probe", at, timeout_s=5.0)
            assert_same_pose(theirs, ours.pose7.tolist(), NOETIC)
            # Noetic's Python asks at float seconds.
            assert abs(at_theirs - at) < 1_000
        # Whoever comes late has the edges that never move, of the model and of others.
        theirs, _ = tf2_listener().query("lower", "probe", 0, 5.0)
        assert_same_pose(theirs, listener.buffer.lookup("lower", "probe").pose7.tolist(), 1e-12)
        interrupted(carrying)
        assert carrying.line().endswith(" samples to ROS, 0 from ROS")


def test_zstate_looks_up_a_robot_of_ros_as_ros_does(
    bridge: Bridge, peer: Callable[..., RosPeer], program: Bridge, namespace: str
):
    Master().set_parameter(f"{namespace}/robot_description", RRBOT.read_text())
    program(str(STATE_PUBLISHER), "_publish_frequency:=1000", "_ignore_timestamp:=true")
    talker, listening = peer(), peer("subscribe")
    carrying = bridge("--from-ros")
    probe = Transform.from_rpy("tool", "probe", (0.1, 0.0, 0.05), (0.2, -0.3, 0.4))
    identity = [0.0] * 6 + [1.0]
    with connect() as session, TransformListener(session, "rrbot") as listener:
        lookup = listener.buffer.lookup
        # In ROS the newest parent of a child counts, and its newest pose.
        for parent, pose in (("lower", identity), ("tool", identity), ("tool", probe.pose7.tolist())):
            talker.query("edge", "/tf_static", parent, "probe", pose)
            placed = Transform.from_pose7(parent, "probe", pose)
            until(lambda placed=placed: answer(listener, placed.target, "probe") == placed)
        talker.query("edge", "/tf", "odom", "world", identity)
        until(lambda: talker.query("readers") == 3)  # the state publisher, the other node, and the bridge
        stamps: list[int] = []

        def compared() -> list[tuple[str, str, int]]:
            """The moving edges that the state publisher computed, and zstate can, too."""
            listening.collect()
            computed = [key for key in listening.edges if key[0] != "odom"]
            return [key for key in computed if listener.buffer.can_lookup(*key)]

        def have_met() -> bool:
            stamps.append(time.time_ns())
            publish_joints(talker, stamps[-1])
            return listener.buffer.can_lookup("world", "probe") and len(compared()) >= 20

        until(have_met)
        listener.buffer.wait("world", "tool", stamps[-1], 5.0)
        for parent, child, stamp in compared():
            writer, theirs = listening.edges[parent, child, stamp]
            assert "state_publisher" in writer
            ours = lookup(parent, child, stamp)
            assert ours.kind == "exact"  # the very sample of that stamp
            assert_same_pose(ours.pose7.tolist(), theirs, 1e-12)
        # The static writer does not repeat the fixed edges of the model.
        kinds = {frame.name: (frame.kind, frame.writer) for frame in listener.buffer.frames()}
        assert [name for name, (_, writer) in kinds.items() if writer == kinds["rrbot/probe"][1]] == [
            "rrbot/probe"
        ]
        # Of /tf the state publisher's edges are computed here, and the other node's one is carried.
        until(lambda: answer(listener, "odom", "world") is not None)
        assert kinds["rrbot/upper"][0] == "joint"
        assert listener.stats.refused == {}
    interrupted(carrying)
    assert "refused" not in carrying.stderr


def test_other_moving_edges_are_carried_in_both_directions_and_not_back(
    bridge: Bridge, peer: Callable[..., RosPeer]
):
    listening, odometry = peer("subscribe"), peer()
    carrying = bridge("--to-ros", "--from-ros")
    with (
        connect() as session,
        StatePublisher(session, MODEL, "rrbot") as publisher,
        TransformPublisher(session, "rrbot", "slam") as slam,
        TransformListener(session, "rrbot") as listener,
    ):
        placed = Transform.from_rpy("map", "odom", (1.0, 2.0, 0.0), (0.0, 0.0, 0.5)).with_covariance(
            np.eye(6)
        )
        stamps = iter(range(2 * S, 3 * S))

        def have_met() -> bool:
            stamp = next(stamps)
            publisher.publish(swing(stamp), stamp=stamp)
            slam.publish([placed], stamp)
            odometry.query("edge", "/tf", "odom", "world", [3.0] + [0.0] * 5 + [1.0])
            listening.collect()
            return ("map", "odom", stamp - 1) in listening.edges and listener.buffer.can_lookup(
                "odom", "world"
            )

        until(have_met)
        # What the other node publishes has the stamp of one second.
        found = listener.buffer.lookup("odom", "world", S)
        assert_same_pose(found.pose7.tolist(), [3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], 0.0)
        names = {name for info in discover(session) for name, _ in info.named("transforms")}
        writer, _ = listening.edges["odom", "world", S]
        assert names == {"slam", writer.strip("/").replace("/", ".")}
        writer, theirs = next(edge for key, edge in listening.edges.items() if key[:2] == ("map", "odom"))
        assert "zstate" in writer
        assert_same_pose(theirs, placed.pose7.tolist(), 1e-15)
        last = next(stamps)
        slam.publish([placed], last)
        until(lambda: listening.collect() or ("map", "odom", last) in listening.edges)
        assert "zstate" not in listening.edges["odom", "world", S][0]
        assert listener.stats.refused == {}
    interrupted(carrying)
    assert "refused" not in carrying.stderr


def test_drivers_of_some_joints_are_merged_in_either_direction(bridge: Bridge, peer: Callable[..., RosPeer]):
    arm, gripper = peer("subscribe"), peer()
    with connect() as session:
        carrying = bridge("--from-ros", "--model", str(RRBOT))
        with JointStateListener(session, "rrbot", MODEL) as joints:
            stamps = iter(range(2 * S, 3 * S, 1000))

            def are_merged() -> bool:
                arm.query("joints", next(stamps), ["shoulder"], [0.25])
                gripper.query("joints", next(stamps), ["lid", "elbow"], [7.0, 0.5])
                reading = joints.read(0)
                return reading is not None and reading.positions.tolist() == [0.25, 0.5]

            until(are_merged)
        interrupted(carrying)
        arm.collect()
        arm.joints.clear()
        carrying = bridge("--to-ros")
        with (
            StatePublisher(session, MODEL, "rrbot", streams=("robot_description", "tf_static", "tf")),
            PartialStatePublisher(session, MODEL, ["shoulder"], "rrbot") as upper,
            PartialStatePublisher(session, MODEL, ["elbow"], "rrbot") as lower,
        ):

            def have_met() -> bool:
                upper.publish([0.5], stamp=next(stamps))
                lower.publish([0.75], stamp=next(stamps))
                arm.collect()
                return bool(arm.joints)

            until(have_met)
        assert {tuple(names) for _, names, _ in arm.joints} == {JOINTS}
        assert all(numbers[0] == [0.5, 0.75] for *_, numbers in arm.joints)
        interrupted(carrying)


def test_carried_messages_are_not_carried_back(bridge: Bridge, peer: Callable[..., RosPeer]):
    listening, talker = peer("subscribe"), peer()
    carrying = bridge("--to-ros", "--from-ros")
    in_zstate: Counter[int] = Counter()

    def count() -> None:
        for reading in source:
            assert reading.stamp is not None
            in_zstate[reading.stamp] += 1

    with (
        connect() as session,
        StatePublisher(session, MODEL, "rrbot") as publisher,
        JointStateListener(session, "rrbot", MODEL) as source,
    ):
        counting = threading.Thread(target=count)
        counting.start()

        def publish_pair(ours: int, theirs: int) -> None:
            publisher.publish(swing(ours), stamp=ours)
            publish_joints(talker, theirs)

        def have_been_everywhere(*stamps: int) -> bool:
            in_ros = listening.counts()
            return all(in_ros[stamp] and in_zstate[stamp] for stamp in stamps)

        first = iter(range(S, 2 * S, 2))

        def have_met() -> bool:
            stamp = next(first)
            publish_pair(stamp, stamp + 1)
            return have_been_everywhere(stamp - 2, stamp - 1)

        until(have_met)
        ours, theirs = range(2 * S, 2 * S + 100), range(3 * S, 3 * S + 100)
        for pair in zip(ours, theirs, strict=True):
            publish_pair(*pair)
        # Once the last of each has been everywhere, what goes round in circles has come by again.
        until(lambda: have_been_everywhere(ours[-1], theirs[-1]))
        for counts in (listening.counts(), in_zstate):
            assert [counts[stamp] for stamp in (*ours, *theirs)] == [1] * 200
        source.close()
        counting.join(1.0)
    interrupted(carrying)
    assert "refused" not in carrying.stderr


def test_two_bridges_of_one_robot_make_no_loop(bridge: Bridge, peer: Callable[..., RosPeer]):
    listening = peer("subscribe")
    bridge("--to-ros")
    back = bridge("--from-ros", "--model", str(RRBOT))
    with connect() as session, StatePublisher(session, MODEL, "rrbot", takeover=True) as publisher:
        stamps = iter(range(S, 2 * S))

        def refused() -> bool:
            publisher.publish([0.0, 0.0], stamp=next(stamps))
            return "(another bridge)" in back.stderr and len(listening.counts()) > 10

        until(refused)
        assert set(listening.counts().values()) == {1}


def test_a_sample_in_ros_has_all_its_numbers_and_nanoseconds(
    bridge: Bridge, peer: Callable[..., RosPeer], namespace: str
):
    listening = peer("subscribe")
    bridge("--to-ros", "--frame-prefix", "left_")
    stamps = iter(range(1_700_000_000_123_456_789, 2**62))
    sent: set[int] = set()
    with connect() as session, StatePublisher(session, MODEL, "rrbot") as publisher:

        def is_complete() -> bool:
            sent.add(stamp := next(stamps))
            publisher.publish([0.25, -1.5], [0.5, 1.0], [7.0, -8.0], stamp)
            listening.collect()
            return bool(listening.joints and listening.edges)

        until(is_complete)
    stamp, names, numbers = listening.joints[0]
    assert stamp in sent
    assert (names, numbers) == (list(JOINTS), [[0.25, -1.5], [0.5, 1.0], [7.0, -8.0]])
    edges = {(parent, child) for parent, child, _ in listening.edges}
    assert edges == {("left_base", "left_upper"), ("left_upper", "left_lower")}
    # Set by the thread that receives the model, not by the one that carries samples.
    until(lambda: listening.query("parameter", f"{namespace}/robot_description") == RRBOT.read_text())


def test_unusable_messages_are_counted_and_logged_once(bridge: Bridge, peer: Callable[..., RosPeer]):
    talker = peer()
    carrying = bridge("--from-ros", "--model", str(RRBOT))
    until(lambda: talker.query("readers") == 1)
    with connect() as session, TransformListener(session, "rrbot") as listener:
        for _ in range(2):
            talker.query("joints", 0, JOINTS, [0.0, 0.0])
            talker.query("joints", S, JOINTS, [0.0, math.nan])
            talker.query("joints", S, ["wheel"], [0.0])
            talker.query("joints", S, JOINTS, [0.0])
        # It continues; joints that are not in the model are left out.
        stamps = iter(range(2 * S, 3 * S))

        def is_carried() -> bool:
            talker.query("joints", next(stamps), ["wheel", *reversed(JOINTS)], [9.0, 0.1, 0.2])
            return listener.buffer.can_lookup("world", "tool")

        until(is_carried)
        # Both joints turn about y, by 0.2 and by 0.1.
        assert math.isclose(listener.buffer.lookup("world", "tool").rpy[1], 0.3, abs_tol=1e-12)
    interrupted(carrying)
    refused = "zero stamp 2, bad numbers 2, unknown joints 2, missing joints 2, sizes 2"
    assert carrying.line().endswith(f"from ROS; refused: {refused}")
    for advice in ("header.stamp", "(nan)", "without any joint", "1 numbers of position", "'wheel'"):
        assert carrying.stderr.count(advice) == 1, carrying.stderr


def test_a_killed_node_ends_the_bridge_with_an_error(namespace: str, spawn: Spawn):
    carrying = spawn(BRIDGE, "ros1", "rrbot", "--to-ros")
    name = carrying.line().rpartition(" ")[2]
    with ServerProxy(os.environ["ROS_MASTER_URI"]) as master:
        _, _, uri = master.lookupNode("/test", name)  # type: ignore[misc]
    with ServerProxy(str(uri)) as node:
        node.shutdown("/test", "as rosnode kill does")
    assert carrying.wait() == 1
    assert "zstate: ROS has ended the node" in carrying.stderr


def test_rospy_does_not_change_other_loggers(namespace: str, spawn: Spawn):
    child = spawn(
        f"""
        import logging, sys
        sys.path.append({DEBIAN_PACKAGES!r})
        logging.basicConfig(level=logging.ERROR)
        before = logging.root.handlers[:], logging.root.level, logging.getLoggerClass()
        from zstate.bridges.ros1.node import Ros1Node
        with Ros1Node():
            print(before == (logging.root.handlers, logging.root.level, logging.getLoggerClass()))
        """
    )
    assert child.line() == "True", child.stderr
    assert child.wait() == 0


def test_a_lost_master_is_logged_and_a_new_one_ends_the_bridge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spawn: Spawn
):
    environment = ros_environment(tmp_path)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    first = Roscore(environment)
    child = spawn(BRIDGE, "ros1", "rrbot", "--to-ros")
    child.line()
    first.close()
    until(lambda: "no ROS master answers" in child.stderr)
    second = Roscore(environment)
    try:
        assert child.wait() == 1
    finally:
        second.close()
    assert "the ROS master was restarted" in child.stderr
    assert child.stderr.count("no ROS master answers") == 1
    assert "Traceback" not in child.stderr


def test_without_a_master_the_error_names_the_command_to_start_one(
    monkeypatch: pytest.MonkeyPatch, spawn: Spawn, free_port: int
):
    monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{free_port}")
    child = spawn(BRIDGE, "ros1", "rrbot", "--to-ros")
    assert child.wait(5.0) == 1
    for fact in (f"127.0.0.1:{free_port}", "ROS_MASTER_URI", "`roscore`"):
        assert fact in child.stderr
    assert "Traceback" not in child.stderr
