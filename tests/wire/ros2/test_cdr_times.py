from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import InvalidInput, MessageError
from zstate.wire.ros2.cdr import from_time, pack_stamp, to_time, unpack_stamps

SECOND = 10**9
FIRST, LAST = -(2**31) * SECOND, (2**31) * SECOND - 1


@pytest.mark.parametrize(
    ("stamp", "time"),
    [
        (0, (0, 0)),
        (1_700_000_000_123_456_789, (1_700_000_000, 123_456_789)),
        (-1, (-1, 999_999_999)),
        (-SECOND, (-1, 0)),
        (FIRST, (-(2**31), 0)),
        (LAST, (2**31 - 1, 999_999_999)),
    ],
)
def test_a_stamp_is_whole_seconds_and_the_nanoseconds_that_follow_them(stamp: int, time: tuple[int, int]):
    assert to_time(stamp) == time
    assert from_time(*time) == stamp
    # int32 and uint32, little-endian
    assert pack_stamp(stamp) == time[0].to_bytes(4, "little", signed=True) + time[1].to_bytes(4, "little")


@given(st.lists(st.integers(FIRST, LAST), max_size=5))
def test_stamps_round_trip_through_their_bytes(stamps: list[int]):
    assert unpack_stamps(b"".join(pack_stamp(stamp) for stamp in stamps)) == tuple(stamps)


@pytest.mark.parametrize("stamp", [FIRST - 1, LAST + 1, 2**63 - 1, -(2**63)])
def test_stamp_outside_the_seconds_of_ros_2_is_refused_by_name(stamp: int):
    for convert in (to_time, pack_stamp):
        with pytest.raises(InvalidInput, match=f"{stamp}.*1901.*2038"):
            convert(stamp)


def test_the_years_named_are_those_where_an_int32_ends():
    years = [datetime.fromtimestamp(stamp // SECOND, UTC).year for stamp in (FIRST, LAST)]
    assert years == [1901, 2038]


@pytest.mark.parametrize("nanosec", [SECOND, 2**32 - 1])
def test_nanoseconds_that_make_a_second_are_malformed(nanosec: int):
    with pytest.raises(MessageError, match=str(nanosec)) as caught:
        from_time(0, nanosec)
    assert caught.value.reason == "malformed"
