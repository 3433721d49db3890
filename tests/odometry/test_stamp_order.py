"""Which readings are late or ahead, and what confirms a jump of time: each limit, and just beyond it."""

from __future__ import annotations

import pytest

from zstate.odometry.stamp_order import Held, StampOrder

S = 1_000_000_000
HALF = S // 2
NOW = 1000 * S


def opened(history_ns: int = S) -> StampOrder:
    """An estimator whose newest reading is of ``NOW``."""
    order = StampOrder(history_ns, "imu")
    assert order.place("imu", NOW) == "present"
    return order


@pytest.mark.parametrize(("history_ns", "jump_ns"), [(S // 5, S), (S, S), (3 * S, 3 * S)])
def test_a_reading_is_ahead_if_it_is_newer_by_more_than_the_history_and_a_second(
    history_ns: int, jump_ns: int
):
    assert opened(history_ns).place("wheels", NOW + jump_ns) == "present"
    assert opened(history_ns).place("wheels", NOW + jump_ns + 1) == "ahead"


def test_a_reading_is_late_if_it_is_older_than_the_history():
    assert opened(S // 5).place("wheels", NOW - S // 5) == "present"
    assert opened(S // 5).place("wheels", NOW - S // 5 - 1) == "late"


def confirmed(source: str, stamps: list[int]) -> int | None:
    """How many of the readings confirm a jump of time; None if all of them do not."""
    order = opened()
    for count, stamp in enumerate(stamps, 1):
        place = order.place(source, stamp)
        assert place != "present"
        if order.hold(Held(source, stamp, lambda: None), place):
            return count
    return None


@pytest.mark.parametrize("source", ["wheels", "imu"])
def test_five_readings_of_half_a_second_confirm_that_time_went_back(source: str):
    start = NOW - 40 * S
    assert confirmed(source, [start + n * HALF // 4 for n in range(5)]) == 5
    assert confirmed(source, [start, start + HALF // 3, start + HALF // 2, start + HALF]) is None
    assert confirmed(source, [start + n * HALF // 4 for n in range(4)] + [start + HALF - 1]) is None


def test_five_readings_of_half_a_second_confirm_a_jump_ahead_and_of_the_imu_the_second_does():
    start = NOW + 40 * S
    stamps = [start + n * HALF // 4 for n in range(5)]
    assert confirmed("wheels", stamps) == 5
    assert confirmed("wheels", [*stamps[:4], start + HALF - 1]) is None
    assert confirmed("imu", stamps) == 2


@pytest.mark.parametrize(
    ("source", "other", "is_confirmed"),
    [
        ("imu", "wheels", True),
        ("imu", "compass", True),
        ("imu", "imu", False),
        ("wheels", "imu", False),
        ("wheels", "compass", False),
        ("compass", "wheels", False),
    ],
)
def test_a_reading_of_the_present_refutes_another_time_but_that_of_the_imu_only_if_it_is_of_the_imu(
    source: str, other: str, is_confirmed: bool
):
    order, found = opened(), []
    for stamp in (NOW + 40 * S + n * HALF // 4 for n in range(5)):
        found.append(order.hold(Held(source, stamp, lambda: None), order.place(source, stamp)))
        if found[-1] is not None:
            break
        assert order.place(other, NOW) == "present"
    assert (found[-1] is not None) == is_confirmed


def test_time_that_went_back_by_less_than_a_second_is_no_jump():
    order = opened(S // 5)
    for n in range(10):
        stamp = NOW - S + n * HALF // 5
        place = order.place("wheels", stamp)
        assert not (place == "late" and order.hold(Held("wheels", stamp, lambda: None), place))


@pytest.mark.parametrize(("gap_ns", "count"), [(10 * S, 5), (10 * S + 1, None)])
def test_readings_of_another_time_that_are_more_than_ten_seconds_apart_do_not_confirm_each_other(
    gap_ns: int, count: int | None
):
    start = NOW + 40 * S
    stamps = [start, *(start + gap_ns + n * HALF // 5 for n in range(4))]
    assert confirmed("wheels", stamps) == count
