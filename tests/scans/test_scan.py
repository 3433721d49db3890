"""Scan: what its numbers mean, and which are refused."""

import dataclasses
import math
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate import InvalidInput
from zstate.scans import Scan

QUARTER = math.pi / 2
WHOLE: dict[str, Any] = {
    "stamp": 1_000,
    "angle_min": -QUARTER,
    "angle_increment": QUARTER,
    "ray_ns": 10,
    "ranges": [1.0, 2.0, 3.0],
    "range_min": 0.5,
    "range_max": 2.5,
}


def scan(**changes: Any) -> Scan:
    return Scan(**{**WHOLE, **changes})


def test_points_lie_along_the_rays_in_the_plane_of_the_sensor():
    points = scan(range_max=3.0).points()
    assert points.dtype == np.float32
    np.testing.assert_allclose(points, [[0, -1, 0], [2, 0, 0], [0, 3, 0]], atol=1e-6)


def test_a_negative_increment_is_a_clockwise_sweep():
    clockwise = scan(angle_min=QUARTER, angle_increment=-QUARTER, range_max=3.0)
    np.testing.assert_allclose(clockwise.points(), [[0, 1, 0], [2, 0, 0], [0, -3, 0]], atol=1e-6)


@given(
    st.floats(-math.tau, math.tau),
    st.floats(-0.3, 0.3).filter(bool),
    st.lists(st.floats(0.0, 100.0, width=32), min_size=2, max_size=20),
)
def test_each_point_is_at_its_range_and_angle(angle_min: float, increment: float, ranges: list[float]):
    points = Scan(0, angle_min, increment, 0, ranges, 0.0, 100.0).points().astype(np.float64)
    angles = [angle_min + increment * i for i in range(len(ranges))]
    expected = [(r * math.cos(a), r * math.sin(a), 0.0) for r, a in zip(ranges, angles, strict=True)]
    # float32 has 24 bits: the direction, the product and the range are each rounded once.
    np.testing.assert_allclose(points, expected, atol=100.0 * 3 * 2**-24)


def test_each_ray_has_its_own_stamp():
    late = scan(stamp=10**18)
    assert late.stamps().tolist() == [10**18, 10**18 + 10, 10**18 + 20]
    assert late.stamps().dtype == np.int64
    assert late.end_stamp == 10**18 + 20
    assert not late.is_rigid


def test_without_a_time_between_rays_all_have_the_stamp_of_the_scan():
    rigid = scan(ray_ns=0)
    assert rigid.is_rigid
    assert rigid.stamps().tolist() == [1_000] * 3
    assert rigid.end_stamp == 1_000


def test_ranges_that_rep_117_calls_no_measurement_are_not_valid():
    ranges = [math.nan, math.inf, -math.inf, 0.4, 2.6, 0.5, 2.5, -1.0]
    mixed = scan(ranges=ranges, angle_increment=0.1)
    assert mixed.valid.tolist() == [False] * 5 + [True, True, False]
    is_nan = np.isnan(mixed.points())
    assert is_nan.all(axis=1).tolist() == is_nan.any(axis=1).tolist() == (~mixed.valid).tolist()


def test_an_infinite_range_is_not_valid_even_if_the_sensor_has_no_limit():
    assert scan(ranges=[1.0, math.inf], range_max=math.inf).valid.tolist() == [True, False]


def test_limits_are_compared_as_float32_as_ranges_are():
    # 5.6 as float32 is below 5.6.
    assert scan(ranges=[5.6], range_min=5.6, range_max=5.6).valid.tolist() == [True]
    assert scan(ranges=np.float64([5.6]), range_min=np.float64(5.6), range_max=6.0).valid.tolist() == [True]


def test_a_range_beyond_float32_is_not_valid():
    assert scan(ranges=[1e300], range_max=math.inf).valid.tolist() == [False]


def test_arrays_are_read_only_copies():
    ranges = np.ones(3, dtype=np.float32)
    one = scan(ranges=ranges, intensities=ranges)
    ranges[:] = 2.0
    assert one.intensities is not None
    assert one.ranges.tolist() == one.intensities.tolist() == [1.0] * 3
    for array in (one.ranges, one.intensities):
        assert array.dtype == np.float32
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 3.0


def test_a_scan_cannot_be_changed_and_can_be_pickled():
    with pytest.raises(dataclasses.FrozenInstanceError):
        scan().stamp = 5  # type: ignore[misc]
    copy = pickle.loads(pickle.dumps(scan()))
    assert copy.stamps().tolist() == scan().stamps().tolist()
    np.testing.assert_array_equal(copy.points(), scan().points())


@pytest.mark.parametrize("increment", [math.radians(0.25), -math.radians(0.25)])
def test_the_last_ray_of_a_full_turn_may_repeat_the_first(increment: float):
    points = scan(angle_increment=increment, ranges=[1.0] * 1441).points()
    np.testing.assert_allclose(points[-1], points[0], atol=1e-6)


def test_one_ray_needs_no_increment():
    np.testing.assert_allclose(scan(ranges=[2.0], angle_increment=0.0).points(), [[0, -2, 0]], atol=1e-6)


def test_the_repr_is_short():
    assert repr(scan()) == "<Scan of 'laser' at 0.000001000: 3 rays, 2 valid>"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ranges": []}, "one ray or more"),
        ({"ranges": [[1.0]]}, r"ranges of a scan are a flat array \(N,\); got shape \(1, 1\)"),
        ({"ranges": 1.0}, r"got shape \(\)"),
        ({"ranges": ["near"]}, "ranges must be real numbers, not text"),
        ({"intensities": [1.0]}, "got 1 intensities of 3 rays"),
        ({"intensities": []}, "pass None if they are not measured"),
        ({"angle_increment": 0.0}, "all 3 rays would have one direction"),
        ({"angle_increment": math.nan}, "angles of a scan are finite"),
        ({"angle_min": math.inf}, "angles of a scan are finite"),
        ({"angle_min": -135.0}, "in degrees, it is -2.35619 rad"),
        ({"angle_increment": 0.25, "ranges": [1.0] * 1440}, "1440 rays .* in degrees, it is 0.00436332 rad"),
        ({"angle_increment": -0.25, "ranges": [1.0] * 1440}, "in degrees, it is -0.00436332 rad"),
        ({"angle_increment": 1e308, "ranges": [1.0] * 2}, "at most a full turn"),
        ({"angle_min": [0.0]}, r"angle_min of a scan is one number; got shape \(1,\)"),
        ({"ray_ns": -1}, "0 or more; got -1"),
        ({"ray_ns": 1e5}, r"round\(time_increment \* 1e9\)"),
        ({"ray_ns": True}, "whole number"),
        ({"ray_ns": 2**70, "ranges": [1.0]}, "a stamp is a 64-bit integer"),
        ({"ray_ns": 2**62}, "a stamp is a 64-bit integer"),
        ({"stamp": 1.5}, "a stamp is a 64-bit integer"),
        ({"range_min": 3.0}, "range_min=3.0, range_max=2.5"),
        ({"range_min": -1.0}, "0 <= range_min <= range_max"),
        ({"range_max": math.nan}, "range_max=nan"),
        ({"frame": ""}, "a frame name is empty"),
    ],
)
def test_what_is_no_scan_is_refused_with_the_reason(changes: dict[str, Any], message: str):
    with pytest.raises(InvalidInput, match=message):
        scan(**changes)
