"""Random messages on every topic that a listener subscribes to on the ros2 wire."""

from __future__ import annotations

import threading

import pytest
from helpers.manual_cdr import rosbags_cdr, rosbags_joint_state, rosbags_tf_message
from helpers.processes import until
from helpers.raw_ros_nodes import (
    DESCRIPTION,
    JOINT_STATES,
    TF,
    TF_STATIC,
    attachment,
    key_of,
    moved,
)
from helpers.robots import RRBOT, STAMP, assert_pose, kinematic_pose, put, wait_for_reader
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from zstate.errors import MessageError
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.wire.protocol import SerializedSample
from zstate.wire.ros2.wire import Ros2Wire


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


# Payloads on the network: whole messages, and messages with bytes cut off, changed or random.
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
    """Puts payloads, and counts the outcomes that a listener must report."""

    def __init__(self, session: Session, topic) -> None:
        self.samples = self.refusals = 0
        self._session, self._topic, self._wire = session, topic, Ros2Wire()

    def put(self, payload: bytes, attached: bytes | None) -> None:
        key = key_of(self._topic)
        put(self._session, key, payload, attachment=attached)
        try:
            decoded = self._wire.decode(self._topic[0], SerializedSample(key, payload, "", attached), "r1")
        except MessageError:
            self.refusals += 1
        else:
            self.samples += len(decoded)


@pytest.mark.parametrize(
    ("topic", "follow"),
    [
        *((JOINT_STATES, "joint_states"), (DESCRIPTION, "joint_states"), (TF, "tf"), (TF_STATIC, "tf")),
        pytest.param(TF_STATIC, "joint_states", marks=pytest.mark.soak),
        pytest.param(DESCRIPTION, "tf", marks=pytest.mark.soak),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_no_payload_stops_a_listener_and_all_are_counted(sessions, monkeypatch, topic, follow):
    writer, reader = sessions
    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    with (
        TransformListener(reader, "r1", wire="ros2", follow=follow) as listener,
        StatePublisher(writer, RRBOT, "r1", ("ros2",), streams=["robot_description"]),
    ):
        wait_for_reader(writer, key_of(topic))
        fuzz = Fuzz(writer, topic)

        @settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck), database=None)
        @given(broken(WHOLE[topic]), BESIDE)
        def put(payload: bytes, attached: bytes | None) -> None:
            fuzz.put(payload, attached)

        put()
        assert min(fuzz.samples, fuzz.refusals) > 0

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
                    and listener.buffer.lookup("r1/upper", "r1/lower", STAMP + 10).kind == "exact"
                )
            )
        pose = listener.buffer.lookup("r1/upper", "r1/lower", STAMP + 10)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "upper", "lower"))
    assert raised == []
