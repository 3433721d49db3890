import struct

import pytest
from helpers.manual_cdr import cdr, rosbags_cdr, rosbags_time, time
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import InvalidInput, MessageError
from zstate.wire.ros2.cdr import decode_clock, decode_string, encode_clock, encode_string

STAMP = 1_700_000_000_123_456_789
TEXTS = ["", "a", "abc", "<robot name='ü'/>", "日本", "x" * 3_000_000]


def test_a_string_has_the_bytes_of_the_specification():
    assert encode_string("abc") == b"\x00\x01\x00\x00" + struct.pack("<I4s", 4, b"abc\0")


def test_a_clock_has_the_bytes_of_the_specification():
    assert encode_clock(STAMP) == b"\x00\x01\x00\x00" + struct.pack("<iI", 1_700_000_000, 123_456_789)


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text[:4])
def test_a_string_is_that_of_rosbags(text: str):
    theirs = rosbags_cdr("std_msgs/msg/String", text)
    assert encode_string(text) == theirs
    turned = rosbags_cdr("std_msgs/msg/String", text, little_endian=False)
    assert [decode_string(payload) for payload in (theirs, turned, theirs + b"\x07\0\0")] == [text] * 3


@pytest.mark.parametrize("stamp", [0, STAMP, -1, 2**31 * 10**9 - 1, -(2**31) * 10**9])
def test_a_clock_is_that_of_rosbags(stamp: int):
    theirs = rosbags_cdr("rosgraph_msgs/msg/Clock", rosbags_time(stamp))
    assert encode_clock(stamp) == theirs == cdr(time(stamp))
    turned = rosbags_cdr("rosgraph_msgs/msg/Clock", rosbags_time(stamp), little_endian=False)
    assert [decode_clock(payload) for payload in (theirs, turned, theirs + b"\x07")] == [stamp] * 3


@given(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")))
def test_text_round_trips(text: str):
    assert decode_string(encode_string(text)) == text


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_stamp_round_trips(stamp: int):
    assert decode_clock(encode_clock(stamp)) == stamp


@pytest.mark.parametrize(
    ("decode", "payload"), [(decode_string, encode_string("abc")), (decode_clock, encode_clock(STAMP))]
)
def test_a_message_cut_off_anywhere_is_truncated(decode, payload: bytes):
    for length in range(len(payload)):
        with pytest.raises(MessageError) as caught:
            decode(payload[:length])
        assert caught.value.reason == "truncated"


def test_values_that_ros_2_cannot_represent_are_refused():
    with pytest.raises(InvalidInput):
        encode_string("a\0b")
    with pytest.raises(InvalidInput):
        encode_clock(2**62)


def test_a_clock_whose_nanoseconds_make_a_second_is_malformed():
    with pytest.raises(MessageError) as caught:
        decode_clock(b"\x00\x01\x00\x00" + struct.pack("<iI", 0, 10**9))
    assert caught.value.reason == "malformed"
