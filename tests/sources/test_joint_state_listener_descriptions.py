"""The models of robots as they are described on the network, on both wires."""

import logging

import pytest
from helpers.processes import until
from helpers.robots import RRBOT

from zstate.model.load import load_model
from zstate.net.latched import LatchedPublisher
from zstate.net.session import Session
from zstate.nodes.publisher import StatePublisher
from zstate.sources.joint_state_listener import DescriptionSubscriber
from zstate.wire.messages import RobotDescription
from zstate.wire.native import encode, encoding_of

KEY = "zstate/r1/robot_description"
ENCODING = encoding_of(RobotDescription)
GRIPPER = load_model("gripper")
EACH = "ros2:namespace=*"


class Received(list):
    """Who was described, with the digest of the model."""

    def add(self, robot, model):
        self.append((robot, model.digest))


def description(urdf: str, session: int = 1) -> bytes:
    return encode(RobotDescription(session, urdf, "", (), ()))


def latch(session: Session, *payloads: bytes, encoding: str = ENCODING) -> LatchedPublisher:
    publisher = LatchedPublisher(session, KEY, encoding)
    for payload in payloads:
        publisher.set(payload)
    return publisher


@pytest.mark.parametrize("wire", ["native", "ros2", "ros2dds"])
@pytest.mark.parametrize("publisher_is_first", [True, False], ids=["late", "early"])
def test_early_and_late_joiners_receive_the_model_on_every_wire(sessions, wire, publisher_is_first):
    writer, reader = sessions
    received = Received()
    opened = [
        lambda: StatePublisher(writer, RRBOT, "r1", (wire,)),
        lambda: DescriptionSubscriber(reader, "r1", received.add, wire),
    ]
    first, second = opened if publisher_is_first else reversed(opened)
    with first(), second():
        until(lambda: received)
    assert received == [("r1", RRBOT.digest)]


@pytest.mark.parametrize("wire", ["native", EACH], ids=["native", "ros2"])
def test_every_robot_is_received_under_its_own_name(sessions, wire):
    writer, reader = sessions
    received = Received()
    with (
        StatePublisher(writer, RRBOT, "r1", (wire,)),
        StatePublisher(writer, GRIPPER, "r2", (wire,)),
        DescriptionSubscriber(reader, "*", received.add, wire),
    ):
        until(lambda: len(received) == 2)
    assert sorted(received) == [("r1", RRBOT.digest), ("r2", GRIPPER.digest)]


def test_only_a_changed_model_is_reported_again(sessions):
    writer, reader = sessions
    received = Received()
    with (
        DescriptionSubscriber(reader, "r1", received.add),
        latch(writer, description(RRBOT.urdf)) as publisher,
    ):
        until(lambda: received)
        publisher.set(description(RRBOT.urdf, session=2))
        publisher.withdraw()
        publisher.set(description(GRIPPER.urdf))
        until(lambda: len(received) == 2)
    assert received == [("r1", RRBOT.digest), ("r1", GRIPPER.digest)]


@pytest.mark.parametrize(
    ("payload", "encoding", "reason"),
    [
        (description(RRBOT.urdf)[:20], ENCODING, "truncated"),
        (b"<robot/>", "text/plain", "foreign"),
        (description("<robot name='r'/>"), ENCODING, "model"),
        (description("models/rrbot.urdf"), ENCODING, "model"),
    ],
    ids=["truncated", "foreign", "no links", "a path"],
)
def test_unusable_descriptions_are_counted_and_logged_once(sessions, caplog, payload, encoding, reason):
    writer, reader = sessions
    received = Received()
    with (
        DescriptionSubscriber(reader, "r1", received.add) as descriptions,
        caplog.at_level(logging.WARNING, "zstate"),
    ):
        with latch(writer, payload, encoding=encoding) as publisher:
            until(lambda: descriptions.refused[reason] == 1)
            publisher.set(payload)
            until(lambda: descriptions.refused[reason] == 2)
        with latch(writer, description(RRBOT.urdf)):
            until(lambda: received)
    assert [record.message.partition(":")[0] for record in caplog.records] == [
        f"robot_description refused ({reason})"
    ]
