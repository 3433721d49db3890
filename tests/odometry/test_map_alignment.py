"""Alignment in a map on simulated fixes, whose errors are white and of Gauss and Markov."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from zstate.odometry.health import chi_square_quantile
from zstate.odometry.invariant_filter import Floats
from zstate.odometry.map_alignment import Fixes, MapAlignment, align_in_map, turn

TAU_S, SIGMA, WHITE = 20.0, 1.0, 0.1
SPEED, FIX_S = 1.0, 0.4
STARTS = 300


class Start(NamedTuple):
    """A start of a drive at any place and ``yaw`` in a map, with its fixes; ``there`` is its true path."""

    yaw: float
    there: Floats
    fixes: Fixes


def path(t: Floats, speed: float, bend: float) -> Floats:
    """x, y [m] with a curvature [1/m], away from the origin of odom."""
    way, start = speed * t, np.array((7.0, -3.0))
    if bend:
        return start + np.column_stack((np.sin(bend * way), 1.0 - np.cos(bend * way))) / bend
    return start + np.column_stack((way, np.zeros_like(way)))


def wander(t: Floats, random: np.random.Generator) -> Floats:
    """Errors of Gauss and Markov in both axes, (N, 2)."""
    kept = np.exp(-np.abs(t[:, None] - t) / TAU_S)
    return SIGMA * np.linalg.cholesky(kept + 1e-12 * np.eye(len(t))) @ random.normal(0.0, 1.0, (len(t), 2))


def starts(way: float, bend: float = 0.0, speed: float = SPEED) -> list[Start]:
    random = np.random.default_rng(0)
    t = np.arange(0.0, way / abs(speed) + 1e-9, FIX_S)
    here, found = path(t, speed, bend), list[Start]()
    for _ in range(STARTS):
        yaw = random.uniform(-math.pi, math.pi)
        there = here @ turn(yaw).T + random.uniform(-1e3, 1e3, 2)
        measured = there + wander(t, random) + random.normal(0.0, WHITE * SIGMA, there.shape)
        found.append(Start(yaw, there, Fixes(t, measured, here, np.full(len(t), SIGMA**2))))
    return found


def aligned(start: Start) -> MapAlignment:
    return align_in_map(start.fixes, TAU_S)


def yaw_errors(found: list[Start]) -> tuple[Floats, Floats]:
    """Errors and sigmas of the yaw [rad]."""
    alignments = [aligned(start) for start in found]
    errors = [
        math.remainder(one.yaw - start.yaw, math.tau) for one, start in zip(alignments, found, strict=True)
    ]
    return np.array(errors), np.sqrt([one.yaw_variance for one in alignments])


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("speed", [SPEED, -SPEED], ids=["forwards", "in reverse"])
@pytest.mark.parametrize("bend", [0.0, 0.1, -0.2], ids=["straight", "a wide curve", "a narrow curve"])
@pytest.mark.parametrize("way", [5.0, 10.0, 20.0])
def test_the_yaw_is_as_uncertain_as_it_says_from_any_heading(way: float, bend: float, speed: float):
    errors, sigmas = yaw_errors(starts(way, bend, speed))
    assert np.mean(np.abs(errors) > 3.0 * sigmas) <= 0.02
    assert 0.7 < rms(errors / sigmas) < 1.3
    if way == 20.0:
        assert rms(errors) < math.radians(6.0)


def test_errors_taken_as_white_would_claim_too_much():
    """The reason for the covariance between fixes: without it, a third of the yaws is outside 3 sigma."""
    found = starts(20.0)
    alignments = [align_in_map(start.fixes, 1e-6) for start in found]
    errors = [
        math.remainder(one.yaw - start.yaw, math.tau) for one, start in zip(alignments, found, strict=True)
    ]
    sigmas = np.sqrt([one.yaw_variance for one in alignments])
    assert np.mean(np.abs(errors) > 3.0 * sigmas) > 0.2


def test_the_covariance_of_a_placed_point_is_that_of_samples():
    """At the end of the way, where errors of the yaw and of the position are correlated."""
    found = starts(10.0, 0.1)
    squares = list[float]()
    samples = list[Floats]()
    for start in found:
        alignment, point = aligned(start), start.fixes.here[-1]
        yaw = math.remainder(alignment.yaw - start.yaw, math.tau)
        error = np.append(alignment.place(point) - start.there[-1], yaw)
        covariance = alignment.covariance(point)
        squares.append(float(error @ np.linalg.solve(covariance, error)))
        back = np.eye(3)
        back[:2, :2] = turn(-start.yaw)
        samples.append(back @ error)
    # 3 +- 4 sigma of the mean of so many chi-square variables of variance 6.
    assert np.mean(squares) == pytest.approx(3.0, abs=4.0 * math.sqrt(6.0 / STARTS))
    level = np.eye(3)
    level[:2, :2] = turn(-aligned(found[0]).yaw)
    claimed = level @ aligned(found[0]).covariance(found[0].fixes.here[-1]) @ level.T
    sampled = np.cov(np.array(samples).T)
    scale = np.sqrt(np.outer(claimed.diagonal(), claimed.diagonal()))
    np.testing.assert_allclose(sampled / scale, claimed / scale, atol=0.25)


def first(start: Start, count: int) -> Fixes:
    return Fixes(*(row[:count] for row in start.fixes))


def test_one_fix_shows_where_and_no_yaw():
    for start in starts(5.0)[:20]:
        alignment = align_in_map(first(start, 1), TAU_S)
        assert alignment.yaw_variance == math.inf
        np.testing.assert_allclose(alignment.place(start.fixes.here[0]), start.fixes.there[0])
        assert alignment.variance == pytest.approx((1.0 + WHITE**2) * SIGMA**2)


def test_fixes_at_rest_show_no_yaw_however_many_they_are():
    random = np.random.default_rng(1)
    t = np.arange(0.0, 60.0, 1.0)
    there, here = wander(t, random), np.tile((1e5, -2e5), (len(t), 1))
    alignment = align_in_map(Fixes(t, there, here, np.ones(len(t))), TAU_S)
    assert alignment.yaw_variance > math.pi**2
    assert alignment.variance > 0.2 * SIGMA**2  # 60 independent ones would leave a sixtieth


def test_two_fixes_at_one_instant_are_of_use():
    t, here = np.zeros(2), np.array(((0.0, 0.0), (0.0, 0.0)))
    alignment = align_in_map(Fixes(t, here + 5.0, here, np.ones(2)), TAU_S)
    np.testing.assert_allclose(alignment.place(here[0]), (5.0, 5.0))


def test_origins_that_are_far_away_change_nothing():
    """A map of a country, and an odometry that has driven for days: 1e6 m, to 1e-6 rad."""
    start = starts(10.0, 0.1)[0]
    t, there, here, variances = start.fixes
    near, far = aligned(start), align_in_map(Fixes(t, there + 1e6, here - 1e6, variances * 1e-4), TAU_S)
    assert far.yaw == pytest.approx(near.yaw, abs=1e-6)
    assert far.yaw_variance == pytest.approx(1e-4 * near.yaw_variance, rel=1e-5)


def test_honest_fixes_fit_the_way_and_a_jump_among_them_does_not():
    found = starts(10.0)
    limit = chi_square_quantile(0.999, aligned(found[0]).freedom)
    misfits = np.array([aligned(start).misfit for start in found])
    assert np.mean(misfits > limit) <= 0.01
    assert misfits.mean() == pytest.approx(aligned(found[0]).freedom, rel=0.1)
    for start in found[:20]:
        start.fixes.there[-5:] += (5.0, 0.0)
        assert aligned(start).misfit > limit


def test_wheels_that_measure_a_way_too_long_fit_as_the_yaw_does_not_change():
    for start in starts(20.0, 0.1)[:20]:
        t, there, here, variances = start.fixes
        alignment = align_in_map(Fixes(t, there, 1.1 * here, variances), TAU_S)
        assert alignment.yaw == pytest.approx(aligned(start).yaw, abs=1e-9)
        assert alignment.misfit < chi_square_quantile(0.999, alignment.freedom)


def test_the_yaw_is_known_to_17_degrees_after_4_5_metres_with_fixes_that_state_a_metre():
    """As the guide says; stated variances count four times before they were seen."""
    x = np.arange(0.0, 10.0, 0.5)
    way = np.column_stack((x, np.zeros_like(x)))
    sigmas = {
        x[size - 1]: align_in_map(
            Fixes(x[:size], way[:size], way[:size], np.full(size, 4.0)), 20.0
        ).yaw_variance
        ** 0.5
        for size in range(2, len(x))
    }
    assert min(length for length, sigma in sigmas.items() if sigma < 0.3) == 4.5
