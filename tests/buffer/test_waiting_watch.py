"""Calls on arrival and on change of a pair."""

from __future__ import annotations

import math
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate import Transform, TransformBuffer
from zstate.errors import InvalidInput


def moved(x: float, stamp: int, yaw: float = 0.0) -> Transform:
    return Transform.from_rpy("map", "base", (x, 0, 0), (0, 0, yaw), stamp=stamp)


def test_watch_reports_each_new_instant_once_and_in_order() -> None:
    buffer, seen = TransformBuffer(), list[int | None]()
    with buffer.watch("map", "base", lambda transform: seen.append(transform.stamp)):
        for stamp in (1, 2, 2, 3):
            buffer.insert(moved(float(stamp), stamp))
    assert seen == [1, 2, 3]


def test_watch_reports_an_available_transform_at_once() -> None:
    buffer, seen = TransformBuffer(), list[int | None]()
    buffer.insert(moved(0.0, 7))
    with buffer.watch("map", "base", lambda transform: seen.append(transform.stamp)):
        assert seen == [7]


def test_late_sample_does_not_trigger_a_watch() -> None:
    buffer, seen = TransformBuffer(), list[int | None]()
    buffer.insert(moved(0.0, 7))
    with buffer.watch("map", "base", lambda transform: seen.append(transform.stamp)):
        buffer.insert(moved(0.0, 5))
    assert seen == [7]


@pytest.mark.parametrize(
    ("thresholds", "expected_stamps"),
    [
        ({"translation_m": 0.1}, [1, 3]),
        ({"rotation_rad": 0.1}, [1, 4]),
        ({"translation_m": 0.1, "rotation_rad": 0.1}, [1, 3, 4]),
    ],
)
def test_thresholds_count_from_the_last_call(
    thresholds: dict[str, float], expected_stamps: list[int]
) -> None:
    buffer, seen = TransformBuffer(), list[int | None]()
    with buffer.watch("map", "base", lambda transform: seen.append(transform.stamp), **thresholds):
        buffer.insert(moved(0.00, 1))
        buffer.insert(moved(0.06, 2))
        buffer.insert(moved(0.12, 3))
        buffer.insert(moved(0.12, 4, yaw=math.pi / 4))
    assert seen == expected_stamps


def test_watch_survives_later_frames_and_a_change_of_parent() -> None:
    buffer, seen = TransformBuffer(), list[float]()
    with buffer.watch("map", "camera", lambda transform: seen.append(float(transform.translation[0]))):
        buffer.insert(moved(1.0, 1))
        buffer.insert_static(Transform("base", "camera", (0.5, 0, 0), (0, 0, 0, 1)))
        assert seen == [1.5]
        buffer.withdraw("camera")
        buffer.insert_static(Transform("map", "camera", (3.0, 0, 0), (0, 0, 0, 1)))
    assert seen == [1.5, 3.0]


def test_callback_that_inserts_is_called_again_afterwards_and_not_recursively() -> None:
    buffer, seen = TransformBuffer(), list[int | None]()

    def follow(transform: Transform) -> None:
        stamp = transform.stamp or 0
        if stamp < 3:
            buffer.insert(moved(0.0, stamp + 1))
        seen.append(stamp)

    with buffer.watch("map", "base", follow):
        buffer.insert(moved(0.0, 1))
    assert seen == [1, 2, 3]


@given(st.lists(st.tuples(st.sampled_from("aabbs!"), st.integers(0, 30)), max_size=60))
def test_watch_reports_each_growth_of_the_common_instant(changes: list[tuple[str, int]]) -> None:
    """Samples of two edges in any order, late ones and repeated stamps; other frames; restarts ("!")."""
    buffer, seen, expected = TransformBuffer(), list[int | None](), list[int]()
    with buffer.watch("map", "tool", lambda transform: seen.append(transform.stamp)):
        for number, (change, at) in enumerate([("!", 0), *changes]):
            pose, stamp = ((float(number), 0, 0), (0, 0, 0, 1)), 0 if change == "!" else at
            if change == "s":
                buffer.insert_static(Transform("tool", f"camera{number}", *pose))
            if change == "!":
                buffer.clear()
            if change in "a!":
                buffer.insert(Transform("map", "base", *pose, stamp=stamp))
            if change in "b!":
                buffer.insert(Transform("base", "tool", *pose, stamp=stamp))
            newest = buffer.latest("map", "tool")
            if change == "!" or newest > expected[-1]:
                expected.append(newest)
    assert seen == expected


def test_exception_of_a_callback_does_not_reach_the_inserting_thread() -> None:
    buffer = TransformBuffer()
    with buffer.watch("map", "base", lambda _: 1 / 0) as watch:
        assert buffer.insert(moved(0.0, 1))
        assert watch.failures == 1
        assert isinstance(watch.last_failure, ZeroDivisionError)


def test_closed_watch_makes_no_calls() -> None:
    buffer, seen = TransformBuffer(), list[int | None]()
    watch = buffer.watch("map", "base", lambda transform: seen.append(transform.stamp))
    watch.close()
    watch.close()
    buffer.insert(moved(0.0, 1))
    assert seen == []


def test_concurrent_inserts_lose_no_final_transform() -> None:
    buffer, seen = TransformBuffer(history_s=100.0), list[int]()

    def write(offset: int) -> None:
        for stamp in range(offset, 4000, 4):
            buffer.insert(moved(0.0, stamp))

    with buffer.watch("map", "base", lambda transform: seen.append(transform.stamp or 0)):
        threads = [threading.Thread(target=write, args=(offset,)) for offset in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert seen[-1] == 3999
    assert seen == sorted(seen)


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_threshold_is_zero_or_more(value: float) -> None:
    with pytest.raises(InvalidInput, match="translation_m"):
        TransformBuffer().watch("a", "b", print, translation_m=value)
