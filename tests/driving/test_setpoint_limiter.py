"""SetpointLimiter: no step or change of velocity above the limits, whatever happens to target and robot."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.driving.limits import Limits
from zstate.driving.setpoint_limiter import SetpointLimiter
from zstate.driving.trajectory import Trajectory
from zstate.errors import InvalidInput

DT = 0.002
EXACT = 1e-9  # rounding, in units of each bound


def limits_of_elbow(
    lower: float = -2.0, upper: float = 2.0, velocity: float = 1.0, acceleration: float = 4.0
) -> Limits:
    return Limits(
        ("elbow",), np.array([lower]), np.array([upper]), np.array([velocity]), np.array([acceleration])
    )


def started(position: float = 0.0, moving: float = 0.0, **limits: float) -> SetpointLimiter:
    limiter = SetpointLimiter(limits_of_elbow(**limits))
    limiter.start([position], [moving])
    return limiter


def test_ten_thousand_take_overs_replacements_stops_and_restarts_never_step_above_the_limits():
    generator = np.random.default_rng(19)
    count = 24
    limits = Limits(
        tuple(f"j{number}" for number in range(count)),
        np.where(np.arange(count) % 4, -generator.uniform(0.01, 3.0, count), -np.inf),
        np.where(np.arange(count) % 4, generator.uniform(0.01, 3.0, count), np.inf),
        generator.uniform(0.1, 5.0, count),
        np.where(np.arange(count) % 3, generator.uniform(0.5, 50.0, count), np.inf),
    )
    finite = np.isfinite(limits.acceleration)
    low, high = np.maximum(limits.lower, -4.0), np.minimum(limits.upper, 4.0)
    limiter = SetpointLimiter(limits)
    positions, velocities = np.zeros(count), np.zeros(count)
    worst_step = worst_change = 0.0
    limiter.start(positions)
    for _ in range(10_000):
        event = generator.choice(["take over", "replace", "stop", "restart"])
        target = generator.uniform(low, high)
        if event == "take over":  # of a robot at rest, which may be outside its limits
            positions = positions + generator.normal(0.0, 0.005, count)
            velocities = np.zeros(count)
            limiter.start(positions)
        elif event == "restart":  # of a moving robot: the last setpoint, with velocities as they are
            limiter.start(positions, velocities)
        for _ in range(generator.integers(1, 12)):
            dt = generator.uniform(0.2, 3.0) * DT
            allowed = limits.containing(positions)
            limited = limiter.brake(dt) if event == "stop" else limiter.step(target, dt)
            steps = np.abs(limited.positions - positions)
            changes = np.abs(limited.velocities - velocities)[finite]
            worst_step = max(worst_step, (steps / (limits.velocity * dt)).max())
            worst_change = max(worst_change, (changes / (limits.acceleration[finite] * dt)).max())
            assert (limited.positions >= allowed.lower).all()
            assert (limited.positions <= allowed.upper).all()
            positions, velocities, _ = limited
    assert 1.0 - EXACT < worst_step <= 1.0 + EXACT
    assert 1.0 - EXACT < worst_change <= 1.0 + EXACT


@settings(deadline=None, max_examples=40)
@given(
    target=st.floats(-2.0, 2.0),
    velocity=st.floats(0.2, 10.0),
    acceleration=st.floats(0.5, 100.0) | st.just(math.inf),
    steps=st.lists(st.floats(5e-4, 0.02), min_size=1, max_size=20),
)
def test_a_joint_at_rest_reaches_a_target_without_overshoot_in_steps_of_any_length(
    target: float, velocity: float, acceleration: float, steps: list[float]
):
    limiter = started(velocity=velocity, acceleration=acceleration)
    # Accelerate, cruise, brake, and the slack of the bound: v' below the root by less than a dt in each step.
    longest = abs(target) / velocity + 2.0 * velocity / acceleration + 40.0 * max(steps)
    last, elapsed, number = 0.0, 0.0, 0
    while elapsed < 2.0 * longest:
        dt = steps[number % len(steps)]
        position = limiter.step([target], dt).positions[0]
        assert abs(position) >= abs(last) - 1e-12
        assert abs(position) <= abs(target) + 1e-12
        last, elapsed, number = position, elapsed + dt, number + 1
    assert last == pytest.approx(target, abs=1e-9)


def test_a_step_of_a_second_takes_the_time_of_a_trapezoid_and_ends_at_rest_on_the_target():
    # 1 rad at 1 rad/s and 4 rad/s^2: 0.25 s up, 0.125 rad; 0.75 rad at full speed; 0.25 s down.
    limiter = started()
    count = next(number for number in range(1, 2_000) if not limiter.step([1.0], DT).limited)
    assert count * DT == pytest.approx(1.25, abs=0.02)
    limited = limiter.step([1.0], DT)
    assert limited.positions[0] == pytest.approx(1.0, abs=1e-12)
    assert limited.velocities[0] == pytest.approx(0.0, abs=1e-5)


def test_slowed_joints_are_named_until_they_reach_the_target():
    limits = Limits(("slow", "fast"), np.full(2, -1.0), np.ones(2), np.array([0.1, 10.0]), np.full(2, np.inf))
    limiter = SetpointLimiter(limits)
    limiter.start([0.0, 0.0])
    assert limiter.step([0.0005, 0.0005], 0.002).limited == ("slow",)  # 0.0002 of 0.0005 rad
    assert limiter.step([0.0005, 0.0005], 0.002).limited == ("slow",)
    assert limiter.step([0.0005, 0.0005], 0.002).limited == ()


def test_a_moving_target_within_the_limits_is_followed_without_a_lag():
    # x = 0.5 (1 - cos(w t)) has velocities up to 0.5 w and accelerations up to 0.5 w^2.
    rate = 1.4
    limiter = started(velocity=1.0, acceleration=1.0)
    for number in range(1, 3_000):
        time = number * DT
        target = 0.5 * (1.0 - math.cos(rate * time))
        limited = limiter.step([target], DT, velocities=[0.5 * rate * math.sin(rate * time)])
        assert limited.positions[0] == pytest.approx(target, abs=1e-12)
        assert limited.limited == ()


def test_an_accepted_trajectory_is_followed_without_a_lag_and_its_replacement_within_the_limits():
    limits = limits_of_elbow(velocity=1.0, acceleration=4.0)
    first = Trajectory(("elbow",), [[0.0], [1.5], [-1.0]], [0.0, 1.0, 2.0]).stretched(limits)
    limiter = started()
    for number in range(1, round(first.duration_s / DT)):
        positions, velocities, _ = first.sample(number * DT)
        limited = limiter.step(positions, DT, velocities)
        assert limited.positions == pytest.approx(positions, abs=1e-12)
        if abs(velocities[0]) > 0.9:
            break  # replaced at full speed, by one that rests where the joint is
    assert abs(limited.velocities[0]) > 0.85
    second = Trajectory(("elbow",), [limited.positions, [0.5]], [0.0, 2.0])
    assert second.findings(limits) == ()
    for number in range(1, 1_500):
        positions, velocities, _ = second.sample(number * DT)
        following = limiter.step(positions, DT, velocities)
        assert abs(following.positions - limited.positions) <= 1.0 * DT + 1e-12
        assert abs(following.velocities - limited.velocities) <= 4.0 * DT + 1e-12
        limited = following
    assert limited.positions == pytest.approx(0.5, abs=1e-9)


def test_a_moving_target_far_ahead_is_caught_up_with_and_then_followed():
    limiter = started(upper=100.0, velocity=2.0)
    limited = [limiter.step([1.0 + number * DT], DT, velocities=[1.0]).limited for number in range(1, 2_000)]
    assert limited[0] == ("elbow",)
    assert set(limited[1_500:]) == {()}


def test_braking_ends_at_rest_after_the_braking_distance():
    limiter = started(velocity=1.0)
    for _ in range(500):
        moving = limiter.step([2.0], DT)
    assert moving.velocities[0] == pytest.approx(1.0)
    braked = [limiter.brake(DT) for _ in range(126)]
    assert [limited.velocities[0] for limited in braked[-2:]] == [0.0, 0.0]
    # v^2 / 2 a = 0.125 rad, less half a step of the velocity because each step has the lower velocity
    assert braked[-1].positions[0] - moving.positions[0] == pytest.approx(0.125 - 0.5 * DT, abs=1e-9)
    assert (braked[0].limited, braked[-1].limited) == (("elbow",), ())


def test_velocities_at_the_start_are_reduced_to_those_that_can_be_stopped_within_the_limits():
    # 0.02 rad before the limit, 4 rad/s^2: sqrt(2 * 4 * 0.02) = 0.4 rad/s
    limiter = started(position=1.98, moving=0.9)
    assert limiter.brake(DT).velocities[0] == pytest.approx(0.4 - 4.0 * DT)
    assert max(limiter.brake(DT).positions[0] for _ in range(200)) <= 2.0
    assert started(moving=7.0).brake(DT).velocities[0] == pytest.approx(1.0 - 4.0 * DT)


def test_a_joint_outside_its_limits_may_stay_or_move_inwards_only():
    limiter = started(position=2.05)
    assert limiter.check([2.05]).tolist() == [2.05]
    assert limiter.check([2.01]).tolist() == [2.01]
    with pytest.raises(
        InvalidInput,
        match=r"'elbow' at 2.06 rad is outside -2 to 2.05; "
        r"'elbow' at 2.05 rad is outside -2 to 2 already, and the joint may only move inwards",
    ):
        limiter.check([2.06])
    assert limiter.step([2.5], DT).positions.tolist() == [2.05]
    for _ in range(100):
        inside = limiter.step([1.9], DT).positions[0]
    assert inside < 2.0
    with pytest.raises(InvalidInput, match=r"'elbow' at 2.01 rad is outside -2 to 2$"):
        limiter.check([2.01])


def test_a_target_beyond_a_limit_is_never_followed_beyond_it():
    limiter = started(position=1.9)
    reached = [limiter.step([5.0], DT).positions[0] for _ in range(2_000)]
    assert max(reached) <= 2.0
    assert reached[-1] == pytest.approx(2.0, abs=1e-12)


@pytest.mark.parametrize(
    ("target", "dt", "text"),
    [
        ([math.nan], DT, r"target positions must be finite; not so: 'elbow' \(nan\)"),
        ([0.0, 0.0], DT, r"target positions of 1 joints have shape \(1,\), in the order elbow; got \(2,\)"),
        ([0.0], 0.0, "a step takes a duration above zero; got dt_s=0.0"),
        ([0.0], math.nan, "a step takes a duration above zero; got dt_s=nan"),
        ([0.0], math.inf, "a step takes a duration above zero; got dt_s=inf"),
    ],
)
def test_an_unusable_step_is_refused_and_changes_nothing(target: list[float], dt: float, text: str):
    limiter = started(position=0.5)
    with pytest.raises(InvalidInput, match=text):
        limiter.step(target, dt)
    assert limiter.step([0.5], DT).positions.tolist() == [0.5]


def test_a_limiter_needs_to_be_started_and_refuses_nan_there():
    limiter = SetpointLimiter(limits_of_elbow())
    with pytest.raises(InvalidInput, match="the limiter has no setpoint yet; call start"):
        limiter.step([0.0], DT)
    with pytest.raises(InvalidInput, match=r"velocities must be finite; not so: 'elbow' \(nan\)"):
        limiter.start([0.0], [math.nan])
    with pytest.raises(InvalidInput, match=r"no setpoint yet"):
        limiter.brake(DT)
    with pytest.raises(InvalidInput, match=r"'elbow' at 2.01 rad is outside -2 to 2"):
        limiter.check([2.01])


def test_returned_vectors_are_the_callers_own():
    limiter = started()
    limiter.step([1.0], DT).positions[0] = 9.0
    assert limiter.step([0.0], DT).positions[0] < 0.1
