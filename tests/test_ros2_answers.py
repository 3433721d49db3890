"""The ros2 wires beside the native one: the same answers, and nothing that stops a listener."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from live import RRBOT, STAMP, assert_pose, await_reader, kinematic_pose
from model.kinds_of_robot import every_joint, random_positions
from support import until
from wire.ros2.by_hand import rosbags_cdr, rosbags_joint_state, rosbags_tf_message
from wire.ros2.raw_nodes import (
    DESCRIPTION,
    JOINT_STATES,
    TF,
    TF_STATIC,
    RosNode,
    attachment,
    key_of,
    moved,
)

from zstate.errors import MessageError
from zstate.listener import TransformListener
from zstate.model.catalog import load_model
from zstate.model.coordinates import velocity_slots
from zstate.net.presence import discover
from zstate.net.session import Session
from zstate.publisher import StatePublisher
from zstate.sources import SubscribedSource
from zstate.statics import StaticPublisher
from zstate.transform import Transform
from zstate.wire.native import NativeWire
from zstate.wire.ros2.wire import Ros2Wire
from zstate.wire.wire import Arrival

EVERY = every_joint().model
WIRES = ("native", "ros2", "ros2dds")
MS = 1_000_000


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def data_key(wire: str, robot: str, stream: str) -> str:
    topic = JOINT_STATES if stream == "joint_states" else TF
    return {"native": f"zstate/{robot}/{stream}", "ros2": key_of(topic), "ros2dds": stream}[wire]


@pytest.mark.parametrize("model", [EVERY, load_model("panda")], ids=["every joint", "panda"])
@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_the_answers_are_those_of_the_native_wire_bit_for_bit(sessions, model, follow: str):
    writer, reader = sessions
    random = np.random.default_rng(7)
    listeners = [TransformListener(reader, "r1", wire=wire, follow=follow) for wire in WIRES]
    with StatePublisher(writer, model, "r1", WIRES) as publisher:
        for wire in WIRES:
            await_reader(writer, data_key(wire, "r1", follow))
        leaves = [link for link in model.links if link not in {joint.parent for joint in model.joints}]
        links = {
            f"r1/{joint.child}" for joint in model.joints if joint.type == "fixed" or follow == "joint_states"
        }
        for listener in listeners:
            until(lambda one=listener: links <= {frame.name for frame in one.buffer.frames()})
        for number in range(4):
            rates = random.normal(size=len(velocity_slots(model)))
            publisher.publish(
                random_positions(model, number), rates, rates * 2, stamp=STAMP + number * 10 * MS
            )
        for listener in listeners:
            until(lambda one=listener: one.stats.received == 4)
        moments = [STAMP, STAMP + 12 * MS + 345, STAMP + 30 * MS]
        for leaf in leaves:
            ours, *others = (
                [
                    *(one.buffer.lookup(model.root, leaf, at).pose7.tolist() for at in moments),
                    one.buffer.twist(leaf, model.root, moments[1]).linear.tolist(),
                    one.buffer.twist(leaf, model.root, moments[1]).angular.tolist(),
                ]
                for one in listeners
            )
            assert others == [ours, ours]
            if follow == "joint_states":
                ahead = {
                    (answer.kind, tuple(answer.pose7.tolist()))
                    for one in listeners
                    for answer in [one.buffer.lookup(model.root, leaf, moments[2] + MS, predict_s=0.01)]
                }
                assert len(ahead) == 1
                assert ahead.pop()[0] == "predicted"
        assert [one.stats.refused for one in listeners] == [{}, {}, {}]
    for listener in listeners:
        listener.close()


@pytest.mark.parametrize("wire", WIRES)
def test_joint_states_are_read_back_as_they_were_published(sessions, wire: str):
    writer, reader = sessions
    positions = random_positions(EVERY, 1)
    rates = np.arange(float(len(velocity_slots(EVERY))))
    with (
        SubscribedSource(reader, EVERY, "r1", wire=wire) as source,
        StatePublisher(writer, EVERY, "r1", (wire,), streams=["joint_states"]) as publisher,
    ):
        await_reader(writer, data_key(wire, "r1", "joint_states"))
        publisher.publish(positions, rates, rates + 1.0, stamp=STAMP)
        publisher.publish(positions, stamp=STAMP + 1)
        full, bare = (reading for _, reading in zip(range(2), source, strict=False))
    assert (full.stamp, bare.stamp) == (STAMP, STAMP + 1)
    assert full.positions.tolist() == bare.positions.tolist() == positions.tolist()
    assert (full.velocities.tolist(), full.efforts.tolist()) == (rates.tolist(), (rates + 1.0).tolist())
    assert (bare.velocities, bare.efforts) == (None, None)


def test_a_source_takes_what_a_ros_driver_says_and_counts_the_rest(sessions):
    writer, reader = sessions
    names, nan = RRBOT.joint_names, float("nan")
    with SubscribedSource(reader, RRBOT, "r1", wire="ros2") as source:
        driver = RosNode(writer, "driver").publisher(JOINT_STATES).announce().await_reader()
        driver.joints(STAMP, ("elbow", "lid", "shoulder"), [2.0, 7.0, 1.0], [nan] * 3, [0.2, nan, 0.1])
        driver.joints(0, names, [0.0, 0.0])
        driver.joints(STAMP, names[:1], [0.0])
        driver.joints(STAMP, names, [nan, 0.0])
        driver.put(rosbags_joint_state(STAMP, "", names, [], [], []))
        driver.put(rosbags_joint_state(STAMP, "", names, [0.0], [], []))
        driver.put(b"\x00\x01")
        driver.put(rosbags_joint_state(STAMP, "", names, [0.0, 0.0], [], []), None)
        driver.joints(STAMP + 1, names, [3.0, 4.0])
        first, last = (reading for _, reading in zip(range(2), source, strict=False))
    assert (first.positions.tolist(), first.velocities, first.efforts.tolist()) == (
        [1.0, 2.0],
        None,
        [0.1, 0.2],
    )
    assert (last.stamp, last.positions.tolist()) == (STAMP + 1, [3.0, 4.0])
    reasons = ["no stamp", "missing joints", "bad numbers", "no positions", "malformed", "truncated"]
    assert source.refused == dict.fromkeys([*reasons, "no attachment"], 1)


def test_both_wires_say_the_same_numbers_at_the_same_instants(sessions):
    writer, reader = sessions
    keys = {wire: data_key(wire, "r1", "joint_states") for wire in ("native", "ros2")}
    said: dict[str, list[Arrival]] = {wire: [] for wire in keys}

    def note(wire: str) -> Callable:
        def take(sample) -> None:
            beside = sample.attachment.to_bytes() if sample.attachment else None
            key, payload = str(sample.key_expr), sample.payload.to_bytes()
            said[wire].append(Arrival(key, payload, str(sample.encoding), beside))

        return take

    ears = [reader.zenoh.declare_subscriber(key, note(wire)) for wire, key in keys.items()]
    with StatePublisher(writer, RRBOT, "r1", tuple(keys)) as publisher:
        for key in keys.values():
            await_reader(writer, key)
        for number in range(5):
            publisher.publish([0.1 * number, 0.2], [1.0, 2.0])
        until(lambda: all(len(arrivals) == 5 for arrivals in said.values()))
    native = [NativeWire().decode("joint_states", one, "r1")[0] for one in said["native"]]
    ros = [Ros2Wire().decode("joint_states", one, "r1")[0] for one in said["ros2"]]
    for one, other in zip(native, ros, strict=True):
        assert (one.stamp, one.positions, one.velocities) == (other.stamp, other.positions, other.velocities)
        assert (one.seq + 1, one.order) == (other.seq, other.order)
    assert len(ears) == 2


def test_behind_a_bridge_robots_are_followed_and_their_writers_named(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "r1", wire="ros2dds", follow="tf") as listener,
        StatePublisher(writer, RRBOT, "r1", ("ros2dds",)) as publisher,
        StaticPublisher(writer, "r1", "mount", wire="ros2dds") as statics,
    ):
        statics.set(Transform("tool", "camera", (0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        await_reader(writer, "tf")
        until(lambda: len(discover(reader, wire="ros2dds")) == 1)
        publisher.publish([0.5, 0.25], stamp=STAMP)
        pose = listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        assert listener.buffer.wait("tool", "camera", timeout_s=5.0).translation[0] == 0.5
        expected = f"ros2dds bridge {writer.zid[:8]}"
        until(
            lambda: (
                publisher.publish([0.5, 0.25], stamp=STAMP)
                or expected in {frame.writer for frame in listener.buffer.frames()}
            )
        )
        assert listener.stats.refused == {}


def test_plain_puts_of_a_bridge_need_no_token_and_jumps_of_stamps_are_new_epochs(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2dds", follow="tf") as listener:
        await_reader(writer, "tf")
        for stamp in (STAMP, STAMP + 1, STAMP - 3600 * 1000 * MS, STAMP - 3600 * 1000 * MS + 1):
            writer.zenoh.put("tf", rosbags_tf_message([stamp], [("odom", "base")], [moved(1.0)]))
        until(lambda: listener.stats.received == 3)
        assert listener.buffer.latest("odom", "base") == STAMP - 3600 * 1000 * MS + 1
        assert (listener.stats.late, listener.stats.missed, listener.stats.refused) == (1, 0, {})


# What a listener may hear: whole messages, and messages with some bytes cut off, changed or made up.
NUMBERS = st.floats(width=64)
WHOLE = {
    JOINT_STATES: st.builds(
        lambda stamp, numbers: rosbags_joint_state(stamp, "", RRBOT.joint_names, numbers, [], []),
        st.sampled_from([0, 1, STAMP, STAMP + 1]),
        st.one_of(st.just([1.0, 2.0]), st.lists(NUMBERS, max_size=3)),
    ),
    TF: st.builds(
        lambda stamp, names, pose: rosbags_tf_message([stamp] * len(names), names, [pose] * len(names)),
        st.sampled_from([0, 1, STAMP, STAMP + 1]),
        st.lists(st.tuples(*[st.sampled_from(["a", "b", "c", "/a", "", "é/"])] * 2), max_size=3),
        st.one_of(st.just(moved(1.0)), st.tuples(*[NUMBERS] * 7)),
    ),
    DESCRIPTION: st.builds(
        lambda text: rosbags_cdr("std_msgs/msg/String", text),
        st.one_of(
            st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=20), st.just("<robot/>")
        ),
    ),
}
WHOLE[TF_STATIC] = WHOLE[TF]
GID = bytes(range(16))
SIGNED = st.one_of(st.integers(0, 50), st.integers(-(2**63), 2**63 - 1)).map(lambda seq: attachment(seq, GID))
BESIDE = st.booleans().flatmap(lambda good: SIGNED if good else st.one_of(st.binary(max_size=40), st.none()))


def broken(whole: st.SearchStrategy[bytes]) -> st.SearchStrategy[bytes]:
    def spoil(data: bytes, place: int, some: bytes) -> bytes:
        place %= len(data) + 1
        return data[:place] + some + data[place + len(some) :]

    cut = st.tuples(whole, st.integers(0, 200)).map(lambda given: given[0][: given[1]])
    changed = st.builds(spoil, whole, st.integers(0, 400), st.binary(max_size=4))
    spoiled = st.one_of(cut, changed, st.binary(max_size=60))
    return st.booleans().flatmap(lambda good: whole if good else spoiled)


class Fuzz:
    """Puts what it is told to, and knows what a listener must have counted in the end."""

    def __init__(self, session: Session, topic) -> None:
        self.samples = self.refusals = 0
        self._session, self._topic, self._wire = session, topic, Ros2Wire()

    def put(self, payload: bytes, beside: bytes | None) -> None:
        key = key_of(self._topic)
        self._session.zenoh.put(key, payload, attachment=beside)
        try:
            said = self._wire.decode(self._topic[0], Arrival(key, payload, "", beside), "r1")
        except MessageError:
            self.refusals += 1
        else:
            self.samples += len(said)


@pytest.mark.parametrize(
    ("topic", "follow"),
    [
        *((topic, "joint_states") for topic in (JOINT_STATES, TF_STATIC, DESCRIPTION)),
        *((topic, "tf") for topic in (TF, TF_STATIC, DESCRIPTION)),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_nothing_that_arrives_stops_a_listener_and_all_of_it_is_counted(sessions, monkeypatch, topic, follow):
    writer, reader = sessions
    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    with (
        TransformListener(reader, "r1", wire="ros2", follow=follow) as listener,
        StatePublisher(writer, RRBOT, "r1", ("ros2",), streams=["robot_description"]),
    ):
        await_reader(writer, key_of(topic))
        fuzz = Fuzz(writer, topic)

        @settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck), database=None)
        @given(broken(WHOLE[topic]), BESIDE)
        def put(payload: bytes, beside: bytes | None) -> None:
            fuzz.put(payload, beside)

        put()
        assert min(fuzz.samples, fuzz.refusals) > 10

        def counted() -> int:
            stats = listener.stats
            return stats.received + stats.late + sum(stats.refused.values())

        if topic[0] == follow:
            until(lambda: counted() == fuzz.samples + fuzz.refusals)
        else:
            until(lambda: counted() >= fuzz.refusals)
        with StatePublisher(writer, RRBOT, "r1", ("ros2",)) as publisher:
            until(
                lambda: (
                    publisher.publish([0.5, 0.25], stamp=STAMP + 10) is None
                    and listener.buffer.can_lookup("r1/upper", "r1/lower", STAMP + 10)
                )
            )
        pose = listener.buffer.lookup("r1/upper", "r1/lower", STAMP + 10)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "upper", "lower"))
    assert raised == []
