"""BaseEstimator on recordings of wheeled robots, with the settings of `zstate odometry`, none of them tuned.

The errors of one drive are one sample: bounds are dead reckoning by wheels and gyro, and the claims of the
estimator.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import recordings
from helpers.drives import Call
from helpers.recordings import HUSKY_REST_S, WHEELS, Recording, Score, Track, calls_of, played, score

from zstate import Transform

THREE_SIGMA = 3.5
PART_S = 60.0
"""A seventh of the Husky's recording, from its start in motion."""
REST_PART_S = HUSKY_REST_S + PART_S
NO_WORSE = 1.1
"""A drive with GPS errors of 0.8 to 1.7 m tells errors of 3 m apart by no more than a tenth."""


@cache
def husky() -> Recording:
    return recordings.load("husky")


@cache
def jackal() -> Recording:
    return recordings.load("jackal")


def dead_reckoning(start: float = 0.0, end: float = math.inf) -> float:
    t, path = recordings.dead_reckoned(husky(), start=start)
    return recordings.error_of(husky(), t[t < end], path[t < end])


def changed_score(calls: list[Call], mount: Transform | None = None) -> tuple[Score, Track]:
    track = played(husky(), calls, mount=mount)
    return score(husky(), track), track


def calls_until(end: float, **options: Any) -> list[Call]:
    return [call for call in calls_of(husky(), **options) if call.t < end]


def without(kind: str, begin: float, seconds: float, end: float) -> list[Call]:
    return [call for call in calls_until(end) if call.kind != kind or not begin <= call.t < begin + seconds]


def imu_in_base(rate_factor: float, rate_offset: float, end: float = math.inf) -> list[Call]:
    """The calls with another yaw rate of the IMU."""
    turn, calls = husky().mount.matrix[:3, :3], calls_until(end)
    for row, call in enumerate(calls):
        if call.kind == "imu":
            rate = turn @ call.values[0]
            rate[2] = rate[2] * rate_factor + rate_offset
            calls[row] = call._replace(values=(turn.T @ rate, call.values[1]))
    return calls


def frozen(begin: float, end: float) -> list[Call]:
    """The calls with an IMU that repeats its last sample."""
    calls, last = calls_of(husky()), None
    for row, call in enumerate(calls):
        if call.kind == "imu":
            if last is not None and begin <= call.t < end:
                calls[row] = call._replace(values=last)
            else:
                last = call.values
    return calls


whole_or_in_part = pytest.mark.parametrize(
    "end", [PART_S, pytest.param(math.inf, id="whole", marks=pytest.mark.soak)]
)


def test_wheels_and_gyro_alone_are_three_metres_off_after_359_metres():
    """The baseline of the others, by an integration that has nothing of the estimator."""
    assert dead_reckoning() == pytest.approx(3.06, abs=0.01)


@pytest.mark.long
@pytest.mark.parametrize(
    ("as_joints", "has_compass", "start", "end"),
    [
        pytest.param(False, False, 0.0, PART_S, id="velocity-no compass-in motion, in part"),
        pytest.param(True, True, HUSKY_REST_S, REST_PART_S, id="joints-bad compass-at rest, in part"),
        *(
            pytest.param(as_joints, has_compass, start, math.inf, marks=pytest.mark.soak)
            for as_joints in (False, True)
            for has_compass in (False, True)
            for start in (0.0, HUSKY_REST_S)
        ),
    ],
)
def test_a_husky_is_found_as_well_as_by_dead_reckoning_inside_its_claim_and_continuously(
    as_joints: bool, has_compass: bool, start: float, end: float
):
    """REP-105: no state is further from the last one than its velocity explains, at 10 Hz."""
    calls = calls_until(end, as_joints=as_joints, has_compass=has_compass, start=start)
    track = played(husky(), calls, wheels=WHEELS if as_joints else None, reads_live=True)
    found = score(husky(), track)
    assert found.error <= NO_WORSE * dead_reckoning(start, end)
    assert found.end_sigmas < THREE_SIGMA
    assert found.nees < 4.0  # 2 is expected, of errors that are one sample
    t, speed, _ = husky().wheels.T
    driven = (t >= start) & (t < end)
    assert track.way == pytest.approx(np.trapezoid(speed[driven], t[driven]), rel=0.03)
    assert track.longest_jump < 0.1


@pytest.mark.long
@pytest.mark.parametrize(
    ("as_joints", "wheel_step"),
    [
        pytest.param(False, 3, id="velocity-3"),
        pytest.param(True, 1, id="joints-1"),
        pytest.param(False, 1, id="velocity-1", marks=pytest.mark.soak),
        pytest.param(True, 3, id="joints-3", marks=pytest.mark.soak),
    ],
)
@whole_or_in_part
def test_slow_sensors_cost_accuracy_and_no_more(as_joints: bool, wheel_step: int, end: float):
    """The IMU at 10 Hz, and the wheels at 10 or 3.3 Hz."""
    calls = calls_until(end, as_joints=as_joints, imu_step=3, wheel_step=wheel_step)
    track = played(husky(), calls, wheels=WHEELS if as_joints else None)
    found = score(husky(), track)
    assert found.error < 2.0 * dead_reckoning(end=end)
    assert found.end_sigmas < THREE_SIGMA


@pytest.mark.long
@whole_or_in_part
def test_wheels_five_percent_too_fast_are_inside_the_claim(end: float):
    calls = [
        call._replace(values=(tuple(1.05 * part for part in call.values[0]),))
        if call.kind == "velocity"
        else call
        for call in calls_until(end)
    ]
    found, _ = changed_score(calls)
    assert found.error < 2.0 * dead_reckoning(end=end)  # the whole: 359 m times 5 % in a round
    assert found.end_sigmas < THREE_SIGMA


@pytest.mark.long
@whole_or_in_part
def test_a_gyro_whose_bias_is_far_off_is_inside_the_claim(end: float):
    """0.02 rad/s, two sigmas of a start in motion: a quarter of a turn in each 80 s."""
    found, _ = changed_score(imu_in_base(1.0, 0.02, end))
    assert found.error < 15.0
    assert found.end_sigmas < THREE_SIGMA


@pytest.mark.long
@pytest.mark.parametrize(
    ("start", "end"),
    [
        pytest.param(130.0, HUSKY_REST_S, id="where it turns"),
        pytest.param(0.0, math.inf, id="whole", marks=pytest.mark.soak),
    ],
)
def test_a_mount_that_is_wrong_by_five_degrees_costs_little_and_is_named(start: float, end: float):
    """It tilts the base, so the height is many sigmas off: the sentence says so."""
    angle = math.radians(5.0)
    wrong = Transform.from_rpy("base_link", "base_link_wrong", (0.0, 0.0, 0.0), (angle, angle, 0.0)).matrix
    turned = wrong @ husky().mount.matrix
    turned[:3, 3] = husky().mount.translation
    mount = Transform.from_matrix("base_link", "imu_link", turned)
    found, track = changed_score(calls_until(end, start=start), mount)
    assert found.error < 2.0 * dead_reckoning(start, end)
    assert found.end_sigmas < THREE_SIGMA
    assert track.sentences.keys() == {"imu"}
    assert "the mount of the IMU is off" in track.sentences["imu"]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["velocity", "imu"])
@pytest.mark.parametrize(
    ("begin", "end"),
    [(20.0, PART_S), pytest.param(150.0, math.inf, id="whole", marks=pytest.mark.soak)],
)
def test_thirty_seconds_without_a_source_are_inside_the_claim(kind: str, begin: float, end: float):
    found, track = changed_score(without(kind, begin, 30.0, end))
    assert found.error < 5.0 * dead_reckoning(end=end)
    assert found.end_sigmas < THREE_SIGMA
    if kind == "imu":
        assert "silent" in track.sentences["imu"]


@pytest.mark.long
@pytest.mark.parametrize("fault", ["mirrored", "frozen"])
@pytest.mark.parametrize("is_whole", [False, pytest.param(True, marks=pytest.mark.soak)])
def test_a_gyro_that_contradicts_the_wheels_is_named_and_the_base_does_not_fly_off(
    fault: str, is_whole: bool
):
    """The IMU is frozen from 150 s on, where the base turns."""
    if fault == "mirrored":
        calls, part, sentence = imu_in_base(-1.0, 0.0), (0.0, 30.0), "the mount of the IMU is mirrored"
    else:
        calls, part, sentence = frozen(150.0, 1e9), (130.0, 190.0), "it repeats its last numbers"
    start, end = (0.0, math.inf) if is_whole else part
    track = played(husky(), [call for call in calls if start <= call.t < end], reads_live=True)
    assert sentence in track.sentences["imu"]
    assert np.linalg.norm(track.live[:, 4:], axis=1).max() < 3.0  # it drives 1 m/s


@pytest.mark.long
def test_late_and_shuffled_data_of_a_recording_change_nothing():
    random = np.random.default_rng(0)
    calls = calls_of(husky())[:2000]
    arrivals = [call.t + random.uniform(0.0, 0.3) for call in calls]
    shuffled = [calls[row] for row in np.argsort(arrivals, kind="stable")]
    first, second = (played(husky(), one) for one in (calls, shuffled))
    np.testing.assert_allclose(first.poses[:-2], second.poses[: len(first.poses) - 2], atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(
    ("as_joints", "has_compass", "step"),
    [
        pytest.param(False, True, 3, id="velocity-true compass-17 Hz"),
        pytest.param(True, False, 3, id="joints-no compass-17 Hz"),
        *(
            pytest.param(as_joints, has_compass, 1, marks=pytest.mark.soak)
            for as_joints in (False, True)
            for has_compass in (False, True)
        ),
    ],
)
def test_a_jackal_that_turns_before_it_drives_keeps_its_yaw(as_joints: bool, has_compass: bool, step: int):
    """The raw gyro drifts 1.5 degrees in this minute. Sensors are read at 17 or 50 Hz."""
    calls = calls_of(jackal(), as_joints=as_joints, has_compass=has_compass, imu_step=step, wheel_step=step)
    track = played(jackal(), calls, wheels=WHEELS if as_joints else None)
    truth = np.unwrap(jackal().compass[:, 1])
    at = np.interp(track.t, jackal().compass[:, 0], truth)
    errors = np.unwrap(track.poses[:, 3]) - at
    errors -= errors[0]
    sigmas = np.sqrt(track.covariances[:, 5, 5])
    late = track.t > 1.0
    assert np.abs(errors[-1]) < math.radians(6.0)
    assert (np.abs(errors) < THREE_SIGMA * sigmas)[late].all()
