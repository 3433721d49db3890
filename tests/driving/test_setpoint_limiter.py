"""SetpointLimiter: no step or change of velocity above the limits, whatever happens to target and robot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.driving.driver import Mode
from zstate.driving.limits import Limits
from zstate.driving.setpoint_limiter import JointRate, SetpointLimiter
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


@pytest.mark.parametrize("events", [800, pytest.param(10_000, marks=pytest.mark.soak)])
@pytest.mark.long
def test_take_overs_replacements_stops_and_restarts_never_step_above_the_limits(events: int):
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
    for _ in range(events):
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
            positions, velocities = limited[:2]
    assert 1.0 - EXACT < worst_step <= 1.0 + EXACT
    assert 1.0 - EXACT < worst_change <= 1.0 + EXACT


@settings(deadline=None, max_examples=40)
@given(
    target=st.floats(-2.0, 2.0),
    velocity=st.floats(0.2, 10.0),
    acceleration=st.floats(0.5, 100.0) | st.just(math.inf),
    steps=st.lists(st.floats(5e-4, 0.02), min_size=1, max_size=20),
)
@pytest.mark.long
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


@pytest.mark.parametrize(("side", "allowed"), [(1.0, "-2 to 2.05"), (-1.0, "-2.05 to 2")])
def test_a_joint_outside_its_limits_may_stay_or_move_inwards_only(side: float, allowed: str):
    limiter = started(position=side * 2.05)
    assert limiter.check([side * 2.05]).tolist() == [side * 2.05]
    assert limiter.check([side * 2.01]).tolist() == [side * 2.01]
    with pytest.raises(
        InvalidInput,
        match=rf"'elbow' at {side * 2.06} rad is outside {allowed}; "
        rf"'elbow' at {side * 2.05} rad is outside -2 to 2 already, and the joint may only move inwards",
    ):
        limiter.check([side * 2.06])
    assert limiter.step([side * 2.5], DT).positions.tolist() == [side * 2.05]
    for _ in range(100):
        inside = limiter.step([side * 1.9], DT).positions[0]
    assert abs(inside) < 2.0
    with pytest.raises(InvalidInput, match=rf"'elbow' at {side * 2.01} rad is outside -2 to 2$"):
        limiter.check([side * 2.01])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_target_beyond_a_limit_is_never_followed_beyond_it(side: float):
    limiter = started(position=side * 1.9)
    reached = [side * limiter.step([side * 5.0], DT).positions[0] for _ in range(2_000)]
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


# Other modes than positions

ALL_MODES: tuple[Mode, ...] = ("position", "velocity", "effort")


def in_modes(
    modes: tuple[Mode, ...] = ALL_MODES, position: float = 0.0, **limits: float
) -> tuple[SetpointLimiter, Limits]:
    of_elbow = replace(limits_of_elbow(**limits), effort=np.array([5.0]))
    limiter = SetpointLimiter(of_elbow, modes)
    limiter.start([position])
    return limiter, of_elbow


@pytest.mark.parametrize("acceleration", [4.0, 50.0, math.inf])
@pytest.mark.parametrize("lag_s", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_velocity_towards_a_limit_ends_there_at_rest_also_if_the_joint_follows_with_a_lag(
    acceleration: float, lag_s: float, side: float
):
    limiter, _ = in_modes(acceleration=acceleration, velocity=2.0)
    position = velocity = 0.0
    path: list[float] = []
    for tick in range(3_000):
        limiter.observe(np.array([position]), None, tick * 2_000_000)
        setpoint = limiter.step([0.0], DT, rates={0: JointRate("velocity", 5.0 * side)}).velocities[0]
        assert 0.0 <= side * setpoint <= 2.0
        assert abs(setpoint - velocity) <= acceleration * DT * (1 + EXACT) or lag_s
        velocity = setpoint + (velocity - setpoint) * math.exp(-DT / lag_s) if lag_s else setpoint
        position += velocity * DT
        path.append(side * position)
    assert max(path) <= 2.0 + 1e-9
    assert path[-1] == pytest.approx(2.0, abs=1e-3)
    assert abs(velocity) < 1e-3


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_near_a_limit_the_velocity_is_that_which_takes_0_2625_s_and_a_step_for_the_room(side: float):
    limiter, _ = in_modes(acceleration=math.inf, velocity=2.0)
    room = 0.05
    limiter.observe(np.array([side * (2.0 - room)]), None, 0)
    limiter.step([0.0], DT, rates={0: JointRate("velocity", side)})  # enters the mode
    limiter.observe(np.array([side * (2.0 - room)]), None, 1)
    found = limiter.step([0.0], DT, rates={0: JointRate("velocity", 2.0 * side)})
    # T = 0.2 s of the approach, and s = 0.05 s (1 + 0.05 s / T) of a lag.
    assert found.velocities[0] == pytest.approx(side * room / (DT + 0.0625 + 0.2))


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_joint_outside_its_limits_turns_inwards_only(side: float):
    limiter, _ = in_modes(position=side * 2.1, acceleration=math.inf)
    limiter.observe(np.array([side * 2.1]), None, 0)
    outwards = limiter.step([0.0], DT, rates={0: JointRate("velocity", side)})
    assert (outwards.velocities[0], outwards.limited) == (0.0, ("elbow",))
    assert limiter.step([0.0], DT, rates={0: JointRate("velocity", -side)}).velocities[0] == -side


def test_after_a_velocity_the_joint_brakes_in_that_mode_and_then_holds_its_position():
    limiter, _ = in_modes()
    for _ in range(500):
        turning = limiter.step([0.0], DT, rates={0: JointRate("velocity", 1.0)})
    assert turning.velocities[0] == 1.0
    braking = [limiter.brake(DT) for _ in range(350)]
    # 1 rad/s / 4 rad/s^2 are 125 steps; 0.2 s at rest are 100.
    assert [one.modes[0] for one in braking].index("position") == pytest.approx(225, abs=2)
    assert braking[124].velocities[0] == pytest.approx(0.0, abs=1e-12)
    assert braking[-1].positions[0] == pytest.approx(braking[124].positions[0], abs=1e-12)


def test_a_joint_in_mode_velocity_has_moved_on_while_a_setpoint_could_not_be_written():
    limiter, _ = in_modes(acceleration=math.inf)
    turning = {0: JointRate("velocity", 0.5)}
    last = limiter.step([0.0], DT, rates=turning)
    limiter.step([0.0], DT, rates=turning)
    limiter.resume(last, 0.1)
    found = limiter.step([0.0], DT, rates=turning)
    assert found.positions[0] == pytest.approx(last.positions[0] + 0.5 * (0.1 + DT))


def test_setpoints_that_could_not_be_written_are_no_time_at_rest():
    limiter = SetpointLimiter(limits_of_elbow(), ("position", "velocity"))
    last, at_rest = limiter.start([0.0]), {0: JointRate("velocity", 0.0)}
    for _ in range(200):  # 0.4 s; after 0.2 s at rest a position is held
        limiter.step([0.0], DT, rates=at_rest)
        limiter.resume(last, DT)
    limiter.step([0.0], DT, rates=at_rest)
    assert limiter.step([0.0], DT, rates={0: None}).modes == ("velocity",)


@pytest.mark.parametrize("modes", [ALL_MODES, ("velocity",)])
def test_a_wheel_has_zero_velocity_after_its_commands(modes: tuple[Mode, ...]):
    limiter, _ = in_modes(modes, lower=-math.inf, upper=math.inf)
    for _ in range(500):
        limiter.step([0.0], DT, rates={0: JointRate("velocity", 1.0)})
    at_rest = [limiter.step([0.0], DT, rates={0: None}) for _ in range(200)][-1]
    assert (at_rest.modes, at_rest.velocities[0]) == (("velocity",), 0.0)


@pytest.mark.parametrize(
    ("modes", "mode"),
    [(ALL_MODES, "position"), (("velocity", "effort"), "velocity"), (("effort",), "effort")],
)
def test_after_an_effort_the_joint_brakes_from_the_measured_velocity_by_what_the_driver_has(
    modes: tuple[Mode, ...], mode: Mode
):
    limiter, limits = in_modes(modes)
    for tick in range(200):  # measured at 0.5 rad/s
        limiter.observe(np.array([0.5 * tick * DT]), None, tick * 2_000_000)
        pushed = limiter.step([0.0], DT, rates={0: JointRate("effort", 9.0)})
    assert pushed.efforts is not None
    assert (pushed.modes, pushed.efforts.tolist(), pushed.limited) == (("effort",), [5.0], ("elbow",))
    assert pushed.velocities[0] == pytest.approx(0.5, abs=1e-3)  # after ten time constants of the filter
    resting = limiter.brake(DT)
    assert resting.modes == (mode,)
    if mode == "effort":
        assert resting.efforts is not None
        assert resting.efforts.tolist() == [0.0]
    else:
        assert resting.efforts is None
        assert resting.velocities[0] == pytest.approx(pushed.velocities[0] - limits.acceleration[0] * DT)
        assert abs(resting.positions[0] - 0.5 * 199 * DT) <= limits.velocity[0] * DT


def test_without_new_readings_a_pushed_joint_is_held_where_it_is_expected():
    limiter, limits = in_modes()
    pushing = {0: JointRate("effort", 1.0)}
    limiter.step([0.0], DT, rates=pushing)
    limiter.observe(np.array([0.1]), np.array([0.8]), 0)
    for _ in range(100):  # such as of a device that is slower than the loop
        limiter.step([0.0], DT, rates=pushing)
    held = limiter.brake(DT)
    assert held.modes == ("position",)
    assert abs(held.positions[0] - (0.1 + 0.8 * 100 * DT)) <= limits.velocity[0] * DT * (1 + EXACT)


@pytest.mark.parametrize(
    ("at", "speed", "reason"),
    [
        (2.01, 0.0, "is at 2.01 rad, outside -2 to 2"),
        (-2.01, 0.0, "is at -2.01 rad, outside -2 to 2"),
        (0.0, 1.1, "moves at 1.1 rad/s, above 1"),
        (0.0, -1.1, "moves at -1.1 rad/s, above 1"),
    ],
)
def test_a_joint_that_leaves_its_range_or_is_too_fast_in_mode_effort_is_held_until_its_efforts_end(
    at: float, speed: float, reason: str
):
    limiter, _ = in_modes()
    pushing = {0: JointRate("effort", 1.0)}
    assert limiter.step([0.0], DT, rates=pushing).modes == ("effort",)
    limiter.observe(np.array([at]), np.array([speed]), 0)
    (text,) = (held := limiter.step([0.0], DT, rates=pushing)).braked
    assert text == f"'elbow' in mode effort {reason}: it is held until its efforts end"
    assert (held.modes, held.limited) == (("position",), ("elbow",))
    still = [limiter.step([0.0], DT, rates=pushing) for _ in range(300)]
    assert {one.modes for one in still} == {("position",)}
    assert still[-1].velocities[0] == 0.0
    assert not any(one.braked for one in still)
    assert limiter.step([0.0], DT, rates={0: None}).modes == ("position",)
    again = limiter.step([0.0], DT, rates=pushing)
    assert again.modes == (("position",) if abs(at) > 2.0 else ("effort",))


def test_a_driver_with_efforts_only_gets_them_inwards_and_against_the_motion():
    limiter, _ = in_modes(("effort",))

    def effort(at: float, speed: float, asked: float) -> float:
        limiter.observe(np.array([at]), np.array([speed]), 0)
        limited = limiter.step([0.0], DT, rates={0: JointRate("effort", asked)})
        assert limited.efforts is not None
        return limited.efforts[0]

    assert [effort(2.1, 0.0, asked) for asked in (1.0, -1.0)] == [0.0, -1.0]
    assert [effort(-2.1, 0.0, asked) for asked in (1.0, -1.0)] == [1.0, 0.0]
    assert [effort(0.0, 1.1, asked) for asked in (1.0, -1.0)] == [0.0, -1.0]
    assert [effort(0.0, 0.0, asked) for asked in (9.0, -9.0)] == [5.0, -5.0]


@pytest.mark.parametrize("effort", [0.0, math.inf])
def test_efforts_of_joints_without_an_effort_limit_are_refused(effort: float):
    limiter = SetpointLimiter(replace(limits_of_elbow(), effort=np.array([effort])), ALL_MODES)
    with pytest.raises(InvalidInput, match=rf"have none: 'elbow' \({effort:g}\); start the driver with"):
        limiter.check_rates({0: JointRate("effort", 1.0)})
    limiter.check_rates({0: JointRate("velocity", 1.0)})
