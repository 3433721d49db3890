"""Writers of one robot on one wire, from announcement to close."""

import pytest
from helpers.processes import until
from helpers.raw_ros_nodes import DESCRIPTION, JOINT_STATES, KeySubscriber, key_of, tokens
from helpers.robots import STAMP, wait_for_reader

from zstate.errors import Closed, InvalidInput
from zstate.net.discovery import discover
from zstate.net.presence import local_writer
from zstate.net.session import connect
from zstate.net.writer import WireWriter, write_all
from zstate.wire.joint_order import SampleLayout
from zstate.wire.messages import JointState, RobotDescription, order_digest, to_block
from zstate.wire.registry import get_wire

WIRES = ("native", "ros2", "ros2dds")
LAYOUT = SampleLayout(("a", "b"), (0, 1))
STATE = JointState(STAMP, 0, 1, order_digest(("a", "b")), to_block([1.0, 2.0]))
UNSTAMPED = JointState(0, 0, 1, STATE.order, STATE.positions)
DESCRIBED = RobotDescription(1, "<robot/>", "digest", (), ())
KEYS = {
    "native": ("zstate/r1/joint_states", "zstate/r1/robot_description"),
    "ros2": (key_of(JOINT_STATES), key_of(DESCRIPTION)),
    "ros2dds": ("joint_states", "robot_description"),
}


@pytest.fixture(autouse=True)
def no_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def opened(session, wire: str) -> WireWriter:
    return WireWriter(session, get_wire(wire), "r1", local_writer(3), LAYOUT)


@pytest.mark.parametrize("wire", WIRES)
def test_open_streams_are_announced_and_received_until_close(sessions, wire: str):
    writer, reader = sessions
    joints, described = KEYS[wire]
    subscriber = KeySubscriber(reader, joints)
    with opened(writer, wire) as out:
        stream = out.open_stream("joint_states")
        write_all([out.open_latched("robot_description")], DESCRIBED)
        wait_for_reader(writer, joints)
        write_all([stream], STATE)
        subscriber.wait_for(1)
        late = KeySubscriber(reader, described, latched=True)
        late.wait_for(1)
        until(lambda: len(discover(reader, wire=wire)) == 1)
        (robot,) = discover(reader, wire=wire)
        assert {stream for stream, _ in robot.writers} == {"joint_states", "robot_description"}
    until(lambda: discover(reader, timeout_s=0.1, wire=wire) == ())
    until(lambda: tokens(reader) == [])


@pytest.mark.parametrize(("wire", "kinds"), [("native", ["PUT", "DELETE"]), ("ros2", ["PUT", "PUT"])])
def test_value_is_withdrawn_only_if_the_wire_can(sessions, wire: str, kinds: list[str]):
    writer, reader = sessions
    subscriber = KeySubscriber(reader, KEYS[wire][1])
    wait_for_reader(writer, KEYS[wire][1])
    with opened(writer, wire) as out:
        latched = out.open_latched("robot_description")
        write_all([latched], DESCRIBED)
        latched.withdraw()
        if wire == "ros2":
            write_all([latched], DESCRIBED)
        assert [str(sample.kind).rpartition(".")[2] for sample in subscriber.wait_for(2)] == kinds


@pytest.mark.parametrize("wire", WIRES)
def test_has_readers_is_true_with_a_subscriber(sessions, wire: str):
    writer, reader = sessions
    with opened(writer, wire) as out:
        stream = out.open_stream("joint_states")
        assert not stream.has_readers
        subscriber = KeySubscriber(reader, KEYS[wire][0])
        until(lambda: stream.has_readers)
    assert subscriber.samples == []


@pytest.mark.parametrize("wire", WIRES)
def test_write_after_close_raises_and_a_second_close_does_nothing(wire: str):
    with connect() as session:
        out = opened(session, wire)
        stream, latched = out.open_stream("joint_states"), out.open_latched("robot_description")
        out.close()
        out.close()
        for use in (lambda: write_all([stream], STATE), lambda: write_all([latched], DESCRIBED)):
            with pytest.raises(Closed):
                use()
        latched.withdraw()
    latched.withdraw()


def test_each_stream_has_a_unique_number_in_its_session(sessions):
    writer, reader = sessions
    with opened(writer, "ros2") as one, opened(writer, "ros2") as other:
        for out in (one, other):
            out.open_stream("joint_states")
            out.open_stream("tf")
        until(lambda: len(tokens(reader)) == 6)
        ids = [token.split("/")[4] for token in tokens(reader)]
        nodes = [token.split("/")[3] for token in tokens(reader)]
    assert len(set(ids)) == 6
    assert len(set(nodes)) == 2


def test_a_message_that_one_wire_cannot_represent_is_sent_on_none(sessions):
    with opened(sessions[0], "native") as native, opened(sessions[0], "ros2") as ros:
        writers = [native.open_stream("joint_states"), ros.open_stream("joint_states")]
        with pytest.raises(InvalidInput, match="the stamp is 0"):
            write_all(writers, UNSTAMPED)
        assert [writer.sent for writer in writers] == [(0, 0), (0, 0)]
        write_all(writers, STATE)
    sizes = [len(writer.encoder.encode(STATE)) for writer in writers]
    assert [writer.sent for writer in writers] == [(1, size) for size in sizes]


def test_stream_without_a_ros_topic_is_refused(sessions):
    with opened(sessions[0], "ros2") as out, pytest.raises(InvalidInput, match="'joint_commands'"):
        out.open_stream("joint_commands")
