"""Arguments at the door: numbers that are no real numbers are refused, whatever numpy would make of them."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from zstate.buffer.buffer import TransformBuffer
from zstate.checks import real_numbers
from zstate.clock import check_stamp, check_stamps
from zstate.errors import InvalidInput
from zstate.model.kinematics import Kinematics
from zstate.model.load import load_model
from zstate.nodes.publisher import RobotEncoder
from zstate.transform import Transform

MODEL = load_model("rrbot")
POSE7 = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
NOT_REAL: dict[str, Callable[[Any], Any]] = {
    "complex": lambda numbers: np.array(numbers, dtype=complex),
    "bool": lambda numbers: np.array(numbers, dtype=bool),
    "text": lambda numbers: [str(number) for number in numbers],
    "object": lambda numbers: np.array(numbers, dtype=object),
    "masked": lambda numbers: np.ma.masked_equal(np.array(numbers, dtype=np.float64), 1.0),
    "masked int": lambda numbers: np.ma.masked_equal(np.array(numbers, dtype=np.int64), 1),
    "dates": lambda numbers: np.array(numbers).astype(np.int64).astype("M8[ns]"),
    "ragged": lambda numbers: [[numbers[0]], *numbers[1:]],
    "nothing": lambda numbers: None,
}


def doors(numbers: Callable[[Any], Any]) -> dict[str, tuple[Callable[[], object], str]]:
    """Every call that takes numbers, with what its refusal has to name."""
    buffer = TransformBuffer()
    track = buffer.add_robot(MODEL)
    encoder = RobotEncoder(MODEL, "r", 7)
    two, seven = numbers([1, 0]), numbers([1, 0, 0, 0, 0, 0, 1])
    three = numbers([1, 0, 0])
    return {
        "positions": (lambda: buffer.insert_joints(track, 0, two), "positions"),
        "velocities": (lambda: buffer.insert_joints(track, 0, [0.0, 0.0], two), "velocities"),
        "published": (lambda: encoder.encode(two, None, None, 0, 0), "positions"),
        "checked": (lambda: MODEL.check_positions(two), "positions"),
        "efforts": (lambda: MODEL.check_efforts(two), "efforts"),
        "kinematics": (lambda: Kinematics(MODEL).edge_poses(two), "positions"),
        "poses": (lambda: buffer.insert_many([("a", "b")], 0, numbers([seven])), "poses"),
        "pose7": (lambda: Transform.from_pose7("a", "b", seven), "'a' from 'b'"),
        "translation": (lambda: Transform("a", "b", three, POSE7[3:]), "translation"),
        "rotation": (lambda: Transform("a", "b", POSE7[:3], numbers([1, 0, 0, 0])), "rotation"),
        "rpy": (lambda: Transform.from_rpy("a", "b", POSE7[:3], three), "rpy"),
        "matrix": (lambda: Transform.from_matrix("a", "b", numbers(np.eye(4).tolist())), "matrix"),
        "points": (lambda: Transform.from_pose7("a", "b", POSE7).apply(three), "points"),
        "placed": (lambda: buffer.place(numbers([three]), 0, "tool", "world"), "points"),
        "stamps of points": (
            lambda: buffer.place([[1, 0, 0]] * 2, numbers([1.0, 2.0]), "tool", "world"),
            "stamps",
        ),
        "stamps": (lambda: buffer.lookup_many("world", "tool", numbers([1.0, 2.0])), "stamps"),
    }


@pytest.mark.parametrize("kind", NOT_REAL)
def test_every_entry_point_refuses_values_that_are_not_real_numbers(kind: str) -> None:
    for door, (call, what) in doors(NOT_REAL[kind]).items():
        if (kind, door) in (("dates", "stamps"), ("dates", "stamps of points"), ("nothing", "velocities")):
            continue  # which they may be
        with pytest.raises(InvalidInput) as caught:
            call()
        assert what in str(caught.value), door


@pytest.mark.parametrize("value", [1j, True, "1.5", np.str_("2"), None, [1.0, 2.0], object()])
def test_a_named_position_is_one_real_number(value) -> None:
    first, second = MODEL.joint_names
    with pytest.raises(InvalidInput, match=first):
        MODEL.positions({first: value, second: 0.0})


@pytest.mark.parametrize(
    "numbers",
    [
        [1, 2],
        (1.0, 2.0),
        np.array([1, 2], np.int8),
        np.array([1, 2], np.uint64),
        np.array([1, 2], np.float16),
        np.array([1, 2], np.longdouble),
        array("d", [1, 2]),
        array("i", [1, 2]),
        memoryview(np.array([1.0, 2.0])),
        np.array([1.0, 9.0, 2.0])[::2],
        np.array([1.0, 2.0]).astype(">f8"),
        [np.float32(1), np.int64(2)],
    ],
)
def test_integers_and_floats_of_any_width_are_accepted_in_any_sequence(numbers) -> None:
    taken = real_numbers(numbers, "numbers")
    assert (taken.dtype, taken.tolist()) == (np.dtype(np.float64), [1.0, 2.0])
    buffer = TransformBuffer()
    track = buffer.add_robot(MODEL)
    assert buffer.insert_joints(track, 0, numbers, numbers)
    assert buffer.joint_positions(MODEL.name)[0].tolist() == [1.0, 2.0]


def test_stamps_of_numpy_s_dates_are_exact() -> None:
    buffer = TransformBuffer()
    first = 1_790_000_000_123_456_789
    for n in range(3):
        buffer.insert(Transform("a", "b", (n, 0, 0), POSE7[3:], np.datetime64(first + n, "ns")))  # type: ignore[arg-type]
    assert buffer.latest("a", "b") == first + 2
    dates = np.arange(first, first + 3).astype("datetime64[ns]")
    poses, valid = buffer.lookup_many("a", "b", dates)
    assert (poses[:, 0].tolist(), valid.tolist()) == ([0.0, 1.0, 2.0], [True] * 3)
    assert buffer.plan("a", "b").poses(dates)[:, 0].tolist() == [0.0, 1.0, 2.0]
    for answer in (buffer.lookup("a", "b", dates[1]), buffer.plan("a", "b").at(dates[1])):  # type: ignore[arg-type]
        assert (answer.stamp, answer.translation[0]) == (first + 1, 1.0)
        assert type(answer.stamp) is int
    assert check_stamp(dates[0]) == first
    assert check_stamps([]).tolist() == []


@pytest.mark.parametrize(
    ("stamps", "why"),
    [
        (np.array(["2026-01-01"], "M8[s]"), "datetime64\\[ns\\]"),
        (np.array(["2026-01-01"], "M8[10ns]"), "datetime64\\[ns\\]"),
        (np.array(["2026-01-01", "NaT"], "M8[ns]"), "NaT"),
        (np.array([["2026-01-01"]], "M8[ns]"), "shape"),
        (np.array([1, 2], "m8[ns]"), "integer"),
        (np.ma.masked_equal(np.array([1, 2]), 1), "masked"),
        ([1.0, 2.0], "integer"),
        ([True, False], "integer"),
        (5, "flat"),
        (np.array([2**63], np.uint64), "64-bit"),
    ],
    ids=repr,
)
def test_stamps_that_are_not_whole_nanoseconds_are_refused(stamps, why: str) -> None:
    with pytest.raises(InvalidInput, match=why):
        check_stamps(stamps)


@pytest.mark.parametrize(
    "stamp", [np.datetime64("NaT"), np.datetime64(5, "s"), math.nan, True, "5"], ids=repr
)
def test_a_stamp_that_is_not_whole_nanoseconds_is_refused(stamp) -> None:
    with pytest.raises(InvalidInput):
        check_stamp(stamp)
