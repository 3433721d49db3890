"""BaseEstimator on recordings of wheeled robots, with the settings of `zstate odometry`, none of them tuned.

The errors of one drive are one sample: bounds are dead reckoning by wheels and gyro, and the claims of the
estimator.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import recordings
from helpers.drives import Call
from helpers.recordings import HUSKY_REST_S, WHEELS, Recording, Score, Track, calls_of, played, score

from zstate import Transform

THREE_SIGMA = 3.5
PART_S = 120.0
"""A third of the Husky's recording, from its start in motion."""
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


@pytest.mark.parametrize(
    ("as_joints", "has_compass", "start"),
    [
        pytest.param(False, True, HUSKY_REST_S, id="velocity-bad compass-at rest"),
        pytest.param(False, False, 0.0, id="velocity-no compass-in motion", marks=pytest.mark.long),
        pytest.param(True, True, 0.0, id="joints-bad compass-in motion", marks=pytest.mark.long),
        pytest.param(True, False, HUSKY_REST_S, id="joints-no compass-at rest", marks=pytest.mark.long),
        pytest.param(False, True, 0.0, id="velocity-bad compass-in motion", marks=pytest.mark.soak),
        pytest.param(True, False, 0.0, id="joints-no compass-in motion", marks=pytest.mark.soak),
        pytest.param(False, False, HUSKY_REST_S, id="velocity-no compass-at rest", marks=pytest.mark.soak),
        pytest.param(True, True, HUSKY_REST_S, id="joints-bad compass-at rest", marks=pytest.mark.soak),
    ],
)
def test_a_husky_is_found_as_well_as_by_dead_reckoning_inside_its_claim_and_continuously(
    as_joints: bool, has_compass: bool, start: float
):
    """REP-105: no state is further from the last one than its velocity explains, at 10 Hz."""
    calls = calls_of(husky(), as_joints=as_joints, has_compass=has_compass, start=start)
    track = played(husky(), calls, wheels=WHEELS if as_joints else None, reads_live=True)
    found = score(husky(), track)
    assert found.error <= NO_WORSE * dead_reckoning(start)
    assert found.end_sigmas < THREE_SIGMA
    assert found.nees < 4.0  # 2 is expected, of errors that are one sample
    assert track.way == pytest.approx(359.0 if start == 0.0 else 130.0, rel=0.03)
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
@pytest.mark.parametrize("end", [HUSKY_REST_S, pytest.param(math.inf, id="whole", marks=pytest.mark.soak)])
def test_a_mount_that_is_wrong_by_five_degrees_costs_little_and_is_named(end: float):
    """It tilts the base, so the height is many sigmas off: the sentence says so."""
    angle = math.radians(5.0)
    wrong = Transform.from_rpy("base_link", "base_link_wrong", (0.0, 0.0, 0.0), (angle, angle, 0.0)).matrix
    turned = wrong @ husky().mount.matrix
    turned[:3, 3] = husky().mount.translation
    found, track = changed_score(calls_until(end), Transform.from_matrix("base_link", "imu_link", turned))
    assert found.error < 2.0 * dead_reckoning(end=end)
    assert found.end_sigmas < THREE_SIGMA
    assert track.sentences.keys() == {"imu"}
    assert "the mount of the IMU is off" in track.sentences["imu"]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["velocity", "imu"])
@pytest.mark.parametrize(
    ("begin", "end"),
    [(60.0, PART_S), pytest.param(150.0, math.inf, id="whole", marks=pytest.mark.soak)],
)
def test_thirty_seconds_without_a_source_are_inside_the_claim(kind: str, begin: float, end: float):
    found, track = changed_score(without(kind, begin, 30.0, end))
    assert found.error < 5.0 * dead_reckoning(end=end)
    assert found.end_sigmas < THREE_SIGMA
    if kind == "imu":
        assert "silent" in track.sentences["imu"]


@pytest.mark.long
@pytest.mark.parametrize("seconds", [60.0, pytest.param(math.inf, marks=pytest.mark.soak, id="to the end")])
@pytest.mark.parametrize(
    ("calls", "begin", "sentence"),
    [
        pytest.param(lambda: imu_in_base(-1.0, 0.0), 0.0, "the mount of the IMU is mirrored", id="mirrored"),
        pytest.param(lambda: frozen(150.0, 1e9), 150.0, "it repeats its last numbers", id="frozen"),
    ],
)
def test_a_gyro_that_contradicts_the_wheels_is_named_and_the_base_does_not_fly_off(
    calls: Callable[[], list[Call]], begin: float, sentence: str, seconds: float
):
    track = played(husky(), [call for call in calls() if call.t < begin + seconds], reads_live=True)
    assert sentence in track.sentences["imu"]
    assert np.linalg.norm(track.live[:, 4:], axis=1).max() < 3.0  # it drives 1 m/s


@pytest.mark.long
def test_late_and_shuffled_data_of_a_recording_change_nothing():
    random = np.random.default_rng(0)
    calls = calls_of(husky())[:6000]
    arrivals = [call.t + random.uniform(0.0, 0.3) for call in calls]
    shuffled = [calls[row] for row in np.argsort(arrivals, kind="stable")]
    first, second = (played(husky(), one) for one in (calls, shuffled))
    np.testing.assert_allclose(first.poses[:-2], second.poses[: len(first.poses) - 2], atol=1e-9)


@pytest.mark.parametrize(
    ("as_joints", "has_compass"),
    [
        pytest.param(False, True, id="velocity-true compass"),
        pytest.param(True, False, id="joints-no compass"),
        pytest.param(True, True, id="joints-true compass", marks=pytest.mark.soak),
        pytest.param(False, False, id="velocity-no compass", marks=pytest.mark.soak),
    ],
)
@pytest.mark.long
def test_a_jackal_that_turns_before_it_drives_keeps_its_yaw(as_joints: bool, has_compass: bool):
    """The raw gyro drifts 1.5 degrees in this minute."""
    calls = calls_of(jackal(), as_joints=as_joints, has_compass=has_compass)
    track = played(jackal(), calls, wheels=WHEELS if as_joints else None)
    truth = np.unwrap(jackal().compass[:, 1])
    at = np.interp(track.t, jackal().compass[:, 0], truth)
    errors = np.unwrap(track.poses[:, 3]) - at
    errors -= errors[0]
    sigmas = np.sqrt(track.covariances[:, 5, 5])
    late = track.t > 1.0
    assert np.abs(errors[-1]) < math.radians(6.0)
    assert (np.abs(errors) < THREE_SIGMA * sigmas)[late].all()
