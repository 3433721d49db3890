"""Trajectory: the curves through timed points, their extrema against limits, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.driving.limits import Limits
from zstate.driving.trajectory import Trajectory
from zstate.errors import InvalidInput

KINDS = ("positions", "velocities", "accelerations")
NAMES = ("shoulder", "elbow")


def limits(
    velocity: float = math.inf, acceleration: float = math.inf, reach: float = 2.0, joints: Any = NAMES
) -> Limits:
    count = len(joints)
    return Limits(
        joints,
        np.full(count, -reach),
        np.full(count, reach),
        np.full(count, velocity),
        np.full(count, acceleration),
    )


def elbow(points: list[float], times: list[float], *rates: list[float]) -> Trajectory:
    return Trajectory(
        ("elbow",), np.array(points)[:, None], times, *(np.array(column)[:, None] for column in rates)
    )


def of_elbow(**bounds: float) -> Limits:
    return limits(joints=("elbow",), **bounds)


def random_trajectory(kind: str, seed: int) -> tuple[Trajectory, np.ndarray]:
    """Points as far as 1.5, 0.05 to 2 s apart, with random rates, at rest at both ends; and their times."""
    generator = np.random.default_rng(seed)
    count = int(generator.integers(2, 12))
    shape = count, len(NAMES)
    times = generator.choice([0.0, 0.3]) + np.append(0.0, generator.uniform(0.05, 2.0, count - 1).cumsum())
    points = generator.uniform(-1.5, 1.5, shape) * generator.choice([1.0, 1e-3])
    rates = [generator.normal(size=shape) * size for size in (0.5, 2.0)][: KINDS.index(kind)]
    for rate in rates:
        rate[[0, -1]] = 0.0
    return Trajectory(NAMES, points, times, *rates), times


def largest(trajectory: Trajectory, times: np.ndarray) -> list[float]:
    """The largest absolute position, velocity and acceleration at 500 instants of each segment."""
    along = np.linspace(1e-9, 1.0 - 1e-9, 500)
    samples = trajectory.sample((times[:-1, None] + along * np.diff(times)[:, None]).ravel())
    return [float(np.abs(values).max()) for values in samples]


# Curves


def test_two_positions_are_joined_by_the_cubic_that_rests_at_both_ends():
    # q = d (3 s^2 - 2 s^3), s = t / h: half way at 1.5 d / h, and 6 d / h^2 at the start
    trajectory = elbow([0.0, 0.8], [0.0, 2.0])
    positions, velocities, accelerations = trajectory.sample([0.0, 1.0, 2.0])
    assert positions[:, 0] == pytest.approx([0.0, 0.4, 0.8], abs=1e-12)
    assert velocities[:, 0] == pytest.approx([0.0, 0.6, 0.0], abs=1e-12)
    assert accelerations[:, 0] == pytest.approx([1.2, 0.0, -1.2], abs=1e-12)
    assert trajectory.duration_s == 2.0


def test_three_positions_at_unequal_times_have_the_velocity_of_the_spline_equation():
    # h = 1, 2; slopes 1, -0.5: 2 (1 + 2) m = 3 (2 * 1 + 1 * -0.5), so m = 0.75
    trajectory = elbow([0.0, 1.0, 0.0], [0.0, 1.0, 3.0])
    assert trajectory.sample(1.0)[1].tolist() == pytest.approx([0.75])


def test_a_spline_equals_the_solution_of_the_whole_linear_system():
    generator = np.random.default_rng(5)
    times = generator.uniform(0.1, 3.0, 40).cumsum()
    points = generator.normal(size=(40, 2))
    steps = np.diff(times)
    matrix, right = np.eye(40), np.zeros((40, 2))
    for row in range(1, 39):
        before, after = steps[row - 1], steps[row]
        matrix[row, row - 1 : row + 2] = after, 2.0 * (before + after), before
        right[row] = 3.0 * (
            after * (points[row] - points[row - 1]) / before
            + before * (points[row + 1] - points[row]) / after
        )
    velocities = Trajectory(NAMES, points, times).sample(times)[1]
    assert velocities == pytest.approx(np.linalg.solve(matrix, right), abs=1e-12)


def test_positions_alone_may_start_with_a_velocity():
    one = Trajectory(("elbow",), [[0.0], [1.0]], [0.0, 2.0], start_velocities=[0.5])
    # h v s + (3 d - 2 h v) s^2 + (h v - 2 d) s^3 at s = 1/2 is d / 2 + h v / 8, with d = 1, h = 2, v = 0.5.
    positions, velocities, _ = one.sample([0.0, 1.0, 2.0])
    np.testing.assert_allclose(positions[:, 0], [0.0, 0.625, 1.0], atol=1e-15)
    np.testing.assert_allclose(velocities[[0, 2], 0], [0.5, 0.0], atol=1e-15)
    two = Trajectory(("elbow",), [[0.0], [1.0], [0.0]], [0.0, 2.0, 3.0], start_velocities=[0.5])
    before, after = two.sample([2.0 - 1e-9, 2.0 + 1e-9])[2]
    np.testing.assert_allclose(before, after, atol=1e-6)
    slower = one.stretched(of_elbow(velocity=0.4))
    assert slower.sample(0.0)[1].tolist() == pytest.approx([0.5 * 2.0 / slower.duration_s])
    with pytest.raises(InvalidInput, match="pass one of the two"):
        Trajectory(("elbow",), [[0.0], [1.0]], [0.0, 2.0], [[0.5], [0.0]], start_velocities=[0.5])
    with pytest.raises(InvalidInput, match="a finite number for each joint"):
        Trajectory(("elbow",), [[0.0], [1.0]], [0.0, 2.0], start_velocities=[np.nan])


def test_velocities_and_accelerations_at_the_points_are_kept():
    generator = np.random.default_rng(6)
    times = np.array([0.0, 0.7, 1.1, 3.0])
    points, velocities, accelerations = generator.normal(size=(3, 4, 2))
    cubic = Trajectory(NAMES, points, times, velocities).sample(times)
    assert cubic[0] == pytest.approx(points, abs=1e-12)
    assert cubic[1] == pytest.approx(velocities, abs=1e-12)
    quintic = Trajectory(NAMES, points, times, velocities, accelerations).sample(times)
    assert quintic[0] == pytest.approx(points, abs=1e-12)
    assert quintic[1] == pytest.approx(velocities, abs=1e-11)
    assert quintic[2] == pytest.approx(accelerations, abs=1e-10)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_a_cubic_and_a_quintic_reproduce_polynomials_of_their_degree(kind: str):
    coefficients = [0.3, -0.2, 0.5, -0.1] + [0.04, -0.02] * (kind == "accelerations")
    curve = np.polynomial.Polynomial(coefficients)
    derivatives = [curve, curve.deriv(1), curve.deriv(2)]
    times = np.array([0.0, 0.4, 1.5, 2.0])
    points, *rates = (derivative(times)[:, None] for derivative in derivatives[: 1 + KINDS.index(kind)])
    trajectory = Trajectory(["elbow"], points, times, *rates)
    inner = np.linspace(0.0, 2.0, 50)
    for derivative, values in zip(derivatives, trajectory.sample(inner), strict=True):
        assert values[:, 0] == pytest.approx(derivative(inner), abs=1e-11)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 10**9))
def test_curves_are_as_smooth_at_the_points_as_promised(kind: str, seed: int):
    trajectory, times = random_trajectory(kind, seed)
    steps = np.diff(times)
    before = trajectory.sample(times[1:-1] - 1e-9 * steps[:-1])
    after = trajectory.sample(times[1:-1])
    scale = 1.0 + largest(trajectory, times)[2] / steps.min()
    for order in range(2 if kind == "velocities" else 3):
        assert np.abs(after[order] - before[order]).max(initial=0.0) < 1e-7 * scale
    if kind == "positions":
        assert trajectory.sample(times[[0, -1]])[1] == pytest.approx(0.0, abs=1e-12 * scale)


def test_joints_rest_before_the_first_and_after_the_last_point():
    trajectory = elbow([0.2, 0.8], [1.0, 2.0], [0.0, 0.5])
    positions, velocities, accelerations = trajectory.sample([0.0, 0.999, 2.001, 100.0])
    assert positions[:, 0].tolist() == pytest.approx([0.2, 0.2, 0.8, 0.8])
    assert not velocities.any()
    assert not accelerations.any()


def test_samples_have_a_row_for_each_time_and_none_for_one_time():
    trajectory = Trajectory(NAMES, [[0.0, 0.0], [1.0, -1.0]], [0.0, 1.0])
    assert [values.shape for values in trajectory.sample(0.5)] == [(2,)] * 3
    assert [values.shape for values in trajectory.sample([0.1, 0.2, 0.3])] == [(3, 2)] * 3


# Limits


def test_velocities_and_accelerations_of_a_cubic_are_found_between_the_points():
    # 0.8 rad in 2 s: 1.5 * 0.8 / 2 = 0.6 rad/s half way, 6 * 0.8 / 2^2 = 1.2 rad/s^2 at the start
    trajectory = elbow([0.0, 0.8], [0.0, 2.0])
    assert trajectory.findings(of_elbow(velocity=0.6, acceleration=1.2)) == ()
    assert trajectory.findings(of_elbow(velocity=0.5, acceleration=1.0)) == (
        "'elbow' moves at 0.6 rad/s, above 0.5, 1 s after the start",
        "'elbow' accelerates at 1.2 rad/s^2, above 1, 0 s after the start",
    )


def test_velocities_and_accelerations_of_a_quintic_are_found_between_the_points():
    # From rest to rest 10 s^3 - 15 s^4 + 6 s^5: velocity 15/8 d/h at s = 1/2, acceleration 10/sqrt(3) d/h^2
    # at s = 1/2 - sqrt(3)/6
    trajectory = elbow([0.0, 1.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0])
    speed, acceleration = 15.0 / 8.0, 10.0 / math.sqrt(3.0)
    assert trajectory.findings(of_elbow(velocity=speed, acceleration=acceleration)) == ()
    moves, accelerates = trajectory.findings(of_elbow(velocity=1.875 - 1e-6, acceleration=5.0))
    assert moves == "'elbow' moves at 1.875 rad/s, above 1.874999, 0.5 s after the start"
    # At s = 1/2 + sqrt(3)/6 it is as large, and negative.
    before, after = 0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0
    assert accelerates in {
        f"'elbow' accelerates at {acceleration:.9g} rad/s^2, above 5, {before:.6g} s after the start",
        f"'elbow' accelerates at {-acceleration:.9g} rad/s^2, above 5, {after:.6g} s after the start",
    }


def test_a_position_between_points_within_the_limits_is_found():
    # Both points at 1.9, leaving at 1 rad/s and coming back: 1.9 + s (1 - s), 0.25 more half way
    trajectory = elbow([1.9, 1.9], [0.0, 1.0], [1.0, -1.0])
    position, end = trajectory.findings(of_elbow())
    assert position == "'elbow' at 2.15 rad is outside -2 to 2, 0.5 s after the start"
    assert end == "'elbow' moves at -1 rad/s at the last point, where it must rest, 1 s after the start"


def test_a_position_that_exceeds_a_rounded_limit_is_shown_with_its_digits():
    (finding,) = elbow([0.0, math.pi], [0.0, 9.0]).findings(of_elbow(reach=3.14159))
    assert finding == "'elbow' at 3.14159265 rad is outside -3.14159 to 3.14159, 9 s after the start"


def test_a_robot_outside_its_limits_may_move_inwards():
    inwards = elbow([2.1, 1.5], [0.0, 1.0])
    assert len(inwards.findings(of_elbow())) == 1
    assert inwards.findings(of_elbow().containing([2.1])) == ()
    assert len(elbow([2.1, 2.2], [0.0, 1.0]).findings(of_elbow().containing([2.1]))) == 1


def test_joints_are_matched_by_name():
    trajectory = Trajectory(("elbow", "shoulder"), [[0.0, 0.0], [1.0, 0.1]], [0.0, 1.0])
    slow_shoulder = Limits(NAMES, np.full(2, -2.0), np.full(2, 2.0), np.array([0.2, 2.0]), np.full(2, np.inf))
    assert trajectory.findings(slow_shoulder) == ()
    slow_elbow = Limits(NAMES, np.full(2, -2.0), np.full(2, 2.0), np.array([2.0, 0.2]), np.full(2, np.inf))
    assert len(trajectory.findings(slow_elbow)) == 1


@pytest.mark.parametrize(
    ("velocity", "acceleration", "factor"),
    [
        (0.6, 1.2, 1.0),
        (0.3, 100.0, 2.0),  # 0.6 / 0.3
        (100.0, 0.3, 2.0),  # sqrt(1.2 / 0.3)
        (0.2, 0.3, 3.0),
    ],
)
def test_stretching_takes_the_least_factor_that_fits(velocity: float, acceleration: float, factor: float):
    # As above: at most 0.6 rad/s and 1.2 rad/s^2.
    trajectory = elbow([0.0, 0.8], [0.0, 2.0])
    bounds = of_elbow(velocity=velocity, acceleration=acceleration)
    stretched = trajectory.stretched(bounds)
    assert stretched.duration_s == pytest.approx(2.0 * factor)
    assert stretched.findings(bounds) == ()
    assert (stretched is trajectory) == (factor == 1.0)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10**9), velocity=st.floats(0.05, 3.0), acceleration=st.floats(0.1, 20.0))
def test_an_accepted_trajectory_never_leaves_the_limits(
    kind: str, seed: int, velocity: float, acceleration: float
):
    trajectory, times = random_trajectory(kind, seed)
    bounds = limits(velocity, acceleration)
    stretched = trajectory.stretched(bounds)
    factor = stretched.duration_s / trajectory.duration_s
    for motion, its_times in ((trajectory, times), (stretched, factor * times)):
        if not motion.findings(bounds):
            position, speed, change = largest(motion, its_times)
            assert position <= 2.0 + 2e-9
            assert speed <= velocity * (1.0 + 2e-9)
            assert change <= acceleration * (1.0 + 2e-9)
    # Stretching keeps the path: it may leave position findings, and nothing else.
    assert all(" is outside " in text for text in stretched.findings(bounds))
    path = trajectory.sample(times)[0]
    assert stretched.sample(factor * times)[0] == pytest.approx(path, abs=1e-9)


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10**9))
def test_findings_appear_at_the_extrema_of_dense_samples(kind: str, seed: int):
    trajectory, times = random_trajectory(kind, seed)
    position, velocity, acceleration = largest(trajectory, times)
    assert trajectory.findings(limits(velocity * 1.001, acceleration * 1.001, position * 1.001)) == ()
    below = trajectory.findings(limits(velocity * 0.999, acceleration * 0.999, position * 0.999))
    for verb in (" is outside ", " moves at ", " accelerates at "):
        assert any(verb in finding for finding in below)


# Bad input


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (([], [[], []], [0, 1]), r"joint names are a sequence of names, at least one; got \[\]"),
        (("elbow", [[0.0], [1.0]], [0, 1]), "joint names are a sequence of names, at least one; got 'elbow'"),
        ((["a", "a"], [[0.0, 0.0]] * 2, [0, 1]), "joints given twice: 'a'"),
        (
            (["a"], [[0.0]], [0.0]),
            r"a trajectory has two points or more, with a time each; got times \[0.0\]",
        ),
        (
            (["a"], [[0.0], [1.0]], 1.0),
            "a trajectory has two points or more, with a time each; got times 1.0",
        ),
        (
            (["a"], [[0.0]] * 3, [0, 1, 1]),
            "times of a trajectory must ascend; point 2 at 1 s follows point 1 at 1",
        ),
        (
            (["a"], [[0.0]] * 2, [-1, 1]),
            r"times of a trajectory are finite and from zero on; got \[-1.0, 1.0\]",
        ),
        ((["a"], [[0.0]] * 2, [0, math.nan]), r"times of a trajectory are finite .* got \[0.0, nan\]"),
        (
            (["a"], [0.0, 1.0], [0, 1]),
            r"points have shape \(2, 1\): a row for each of 2 times, .* got \(2,\)",
        ),
        ((["a"], [[0.0], [math.nan]], [0, 2]), "points must be finite; that of 'a' is nan at point 1, 2 s"),
        ((["a"], [["0"], ["1"]], [0, 2]), "points of a trajectory must be real numbers, not text"),
        ((["a"], [[0.0]] * 2, [0, 1], [[0.0]]), r"velocities have shape \(2, 1\)"),
        (
            (["a"], [[0.0]] * 2, [0, 1], None, [[0.0]] * 2),
            "accelerations at the points need velocities as well",
        ),
        ((["a"], [[0.0], [1.0]], [0, 1e-200]), "the points are too far apart for times as close as 1e-200 s"),
        ((["a"], [[1e308], [-1e308]], [0, 1]), "velocities or accelerations exceed the largest number"),
    ],
)
def test_unusable_points_are_refused_with_the_values(arguments: tuple[Any, ...], text: str):
    with pytest.raises(InvalidInput, match=text):
        Trajectory(*arguments)


def test_unknown_and_missing_joints_are_named():
    trajectory = Trajectory(("shoulder", "elbw"), [[0.0, 0.0]] * 2, [0.0, 1.0])
    for method in (trajectory.findings, trajectory.stretched):
        with pytest.raises(
            InvalidInput, match=r"unknown joint 'elbw'; did you mean 'elbow'\?; missing: 'elbow'"
        ):
            method(limits())


def test_samples_at_times_that_are_not_finite_are_refused():
    with pytest.raises(InvalidInput, match="times of samples must be finite; got nan"):
        elbow([0.0, 1.0], [0.0, 1.0]).sample(math.nan)


def test_a_trajectory_keeps_copies_of_its_arguments():
    points = np.array([[0.0], [1.0]])
    trajectory = Trajectory(["elbow"], points, [0.0, 1.0])
    points[1] = 5.0
    assert trajectory.stretched(of_elbow(velocity=0.1)).sample(100.0)[0].tolist() == [1.0]
