"""Simulated drives with vibration, slip and wrong scales: errors are as large as their claims."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from helpers.base_motion import stamp_at, tilted_mount
from helpers.drives import (
    Errors,
    Vibration,
    errors_of,
    foot_calls,
    imu_calls,
    joint_calls,
    merged,
    new_estimator,
    sliding_legs,
    velocity_calls,
    wandering,
)

from zstate.odometry import Ackermann, DiffDrive, Mecanum, Wheels
from zstate.odometry.health import chi_square_quantile

END_SIGMAS = 3.5
"""Of x and y, and of the yaw: one run of 370 by chance; 50 runs have a larger one in one of seven cases."""
WIDE_SIGMAS = 5.0
"""The bound of all 2,500 drives of the trials, which one choice of 90 of their seeds exceeds by chance.

Of 50 sets of 50 drives one has an end beyond 4.2 in every third choice. Here that is seed 6 of legs that are
at rest first, with 4.44: for a minute its feet slip to one side, and the bias of the gyro is found three
sigma off. The same drive with each of twelve other draws of slips ends within 2.
"""
FAST = 3.0
"""[m/s] No estimate is faster; drives have up to 1 m/s."""

# What a Clearpath Husky has at 1 m/s on asphalt, standard deviations of a sample.
FORCE, RATE = 0.65, 0.03
VIBRATIONS = {
    "none": None,
    "white": Vibration(FORCE, RATE),
    "white, twice": Vibration(2 * FORCE, 2 * RATE),
    "banded": Vibration(FORCE, RATE, is_banded=True),
    "banded, twice": Vibration(2 * FORCE, 2 * RATE, is_banded=True),
}
KINDS: dict[str, Wheels | None] = {
    "diff drive": DiffDrive("left", "right", radius=0.1, track=0.4),
    "mecanum": Mecanum("fl", "fr", "rl", "rr", radius=0.1, track=0.4, wheelbase=0.5),
    "ackermann": Ackermann("left", "right", ("fl", "fr"), radius=0.1, track=0.4, wheelbase=0.6),
    "legs": None,
    "velocity": None,
}


def end_of(
    kind: str, seed: int, seconds: float, vibration: Vibration | None, *, rest_s: float = 3.0
) -> Errors:
    """The errors at the end of a drive."""
    random, wheels = np.random.default_rng(1000 + seed), KINDS[kind]
    drive = wandering(seed, seconds, rest_s=rest_s, sideways=kind == "mecanum", steered=kind == "ackermann")
    calls = imu_calls(drive, tilted_mount(), random, vibration=vibration)
    if wheels is not None:
        base = new_estimator(wheels=wheels)
        calls = merged(calls, joint_calls(drive, wheels, random))
    elif kind == "legs":
        legs = sliding_legs()
        base = new_estimator(legs=legs)
        calls = merged(calls, foot_calls(drive, legs, random))
    else:
        base = new_estimator()
        calls = merged(calls, velocity_calls(drive, random, sigma=0.05, scale=0.02, has_rate=False))
    for call in calls:
        getattr(base, call.kind)(stamp_at(call.t), *call.values, **call.options)
    state = base.state(stamp_at(seconds - 0.05))
    assert np.linalg.norm(state.twist.linear) < FAST
    return errors_of(drive, state)


def check(ends: Sequence[Errors], bound: float, *, has_exact_noise: bool, least_of_yaw: float = 0.1) -> None:
    """Ends inside their claims; without vibration their mean NEES is below its band's upper edge, and above a
    floor: drives have less lateral and vertical noise than is stated, and constant errors are bounds."""
    assert max(end.sigmas for end in ends) < bound
    if not has_exact_noise:
        return
    squares = np.mean([end.squares for end in ends], axis=0).tolist()
    for mean, freedom, least in zip(squares, (3, 3, 3, 1), (0.1, 0.1, 0.1, least_of_yaw), strict=True):
        high = chi_square_quantile(0.999, freedom * len(ends)) / len(ends)
        assert least * freedom < mean < 1.2 * high, squares


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("diff drive", "banded, twice"),
        ("velocity", "white, twice"),
    ],
)
def test_vibration_leaves_the_end_inside_its_claim(kind: str, name: str):
    check([end_of(kind, 0, 20.0, VIBRATIONS[name])], END_SIGMAS, has_exact_noise=False)


@pytest.mark.long
def test_a_start_in_motion_with_much_vibration_is_inside_its_claim_on_the_way_back():
    """It has no rest for the bias of its gyro, and ends near where it began."""
    end = end_of("ackermann", 10, 90.0, VIBRATIONS["banded, twice"], rest_s=0.0)
    assert end.sigmas < END_SIGMAS


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_the_end_of_a_drive_is_inside_its_claim(kind: str):
    rest_s = 0.0 if kind == "velocity" else 3.0
    check([end_of(kind, 0, 20.0, None, rest_s=rest_s)], END_SIGMAS, has_exact_noise=False)


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("rest_s", [0.0, 3.0], ids=["in motion", "at rest"])
@pytest.mark.parametrize("name", VIBRATIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_fifty_drives_are_inside_their_claims(kind: str, name: str, rest_s: float):
    ends = [end_of(kind, seed, 90.0, VIBRATIONS[name], rest_s=rest_s) for seed in range(50)]
    # Without the rate of wheels or legs an even turn looks like rest: the gyro's bias is stated to be known
    # to 0.01 rad/s, though in these drives, which do rest, it is known ten times as well.
    least = 0.01 if kind == "velocity" and rest_s else 0.1
    check(ends, WIDE_SIGMAS, has_exact_noise=name == "none", least_of_yaw=least)
