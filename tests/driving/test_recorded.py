"""Messages of drivers as ROS 2 messages, and back."""

from typing import get_args

import pytest

from zstate.driving.messages import DriverState, JointCommand, MotionOutcome, OutcomeName, Stop
from zstate.driving.recorded import (
    decode_command,
    decode_state,
    decode_stop,
    encode_command,
    encode_status,
    program_of_stop,
)
from zstate.errors import InvalidInput, MessageError
from zstate.wire.identity import WriterId
from zstate.wire.measurements import message_fields
from zstate.wire.messages import order_digest, to_block

STATE = DriverState(
    *(1_700_000_000_123_456_789, 2**63, "drive@desk pid 7", "stopped", '["1"] \n stopped', ("a", "b")),
    *(
        250_000_000,
        "teleop@desk pid 8",
        7,
        ("b",),
        99.5,
        10,
        1,
        2,
        {"ttl": 3},
        "null",
        ((5, 6),),
        (8, 9),
        0.5,
    ),
    outcomes=tuple(MotionOutcome(1, k, name, "5") for k, name in enumerate(get_args(OutcomeName))),
    modes=("position", "velocity"),
    instant=11,
    received=(12, 13),
    transit_excess=14,
)
STOP = Stop(5, 0, 9, "relax", "7")


@pytest.mark.parametrize(("decode", "message"), [(decode_state, STATE), (decode_stop, STOP)])
def test_every_field_of_a_state_and_of_a_stop_comes_back(decode, message):
    defaults = type(message).__struct_defaults__
    assert not any(value in defaults for value in list(message_fields(message).values())[-len(defaults) :])
    payload = encode_status(message, "arm", "desk")
    assert decode(payload, 0, 0) == message
    with pytest.raises(MessageError, match="cut off"):
        decode(payload[:-8], 0, 0)


def test_a_status_without_a_required_field_or_with_another_type_is_malformed():
    payload = encode_status(STOP, "arm", "desk")
    for change in ((b"how\0", b"who\0"), (b"relax", b"float"), (b"\0\0\x009\0", b"\0\0\0x\0")):
        with pytest.raises(MessageError, match="malformed"):
            decode_stop(payload.replace(*change), 0, 0)


@pytest.mark.parametrize("block", ["positions", "velocities", "efforts"])
def test_a_command_comes_back_with_its_ttl_and_with_the_blocks_that_it_has(block):
    names = ("a", "b")
    command = JointCommand(5, 6, 7, order_digest(names), names=names, ttl=8, **{block: to_block([1.0, 2.0])})
    assert decode_command(encode_command(command, "arm", "") or b"", 7, 6) == command


def test_a_command_without_joint_names_cannot_be_represented():
    with pytest.raises(InvalidInput, match="without the names of its joints"):
        encode_command(JointCommand(5, 6, 7, order_digest(()), to_block([1.0])), "arm", "")


def test_a_stop_on_the_key_of_another_session_is_refused():
    writer = WriterId("door", "desk", 7, 1, session=9)
    assert program_of_stop(STOP, writer.identity) == "door@desk pid 7"
    with pytest.raises(InvalidInput, match="another program"):
        program_of_stop(Stop(5, 0, 8, "hold"), writer.identity)
