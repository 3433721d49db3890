"""Heights by a barometer: what they correct, what they never claim, and how pressures become heights."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from helpers.base_motion import stamp_at
from helpers.drives import (
    Call,
    Drive,
    copy_of,
    imu_calls,
    legs_of,
    merged,
    new_estimator,
    tilted_mount,
    velocity_calls,
)
from numpy.typing import NDArray

from zstate.errors import InvalidInput
from zstate.odometry import BarometerNoise, BaseEstimator, ImuNoise
from zstate.odometry.fusion import Estimate, Fusion, Height, started
from zstate.odometry.invariant_filter import (
    POSITION,
    initial_state,
    innovation,
    plain_covariance,
    with_contact,
    with_tracked,
)
from zstate.odometry.measurements import contact, tracking
from zstate.odometry.messages import Pressure
from zstate.odometry.rotations import rotation_exp
from zstate.odometry.sensors import Estimators, sensor
from zstate.transform import Transform

S = 1_000_000_000
FUSION = Fusion(ImuNoise(gyro=1e-3, accel=1e-2, gyro_bias=1e-5, accel_bias=1e-4))
UP = POSITION.start + 2
MOUNT = np.eye(4)
ROOT = np.random.default_rng(2).normal(0.0, 0.01, (15, 15))
SIGMA, WANDER, TAU_S = 0.2, 3.0, 100.0


def standing(stamp: int = 0, z: float = 0.0, sigma: float = 0.01, before: Estimate | None = None) -> Estimate:
    """An estimate far from the origin, whose z has a ``sigma`` [m], with what ``before`` knows."""
    covariance = ROOT @ ROOT.T
    covariance[UP], covariance[:, UP] = 0.0, 0.0
    covariance[UP, UP] = sigma**2
    state = initial_state(
        rotation=rotation_exp(np.array([0.1, -0.2, 0.7])),
        velocity=np.array([1.0, 0.5, 0.1]),
        position=np.array([300.0, -200.0, z]),
        gyro_bias=np.zeros(3),
        accel_bias=np.zeros(3),
        covariance=covariance,
    )
    estimate = started(stamp, state)
    if before is None:
        return estimate
    return estimate._replace(altimeters=before.altimeters, runs=before.runs)


def read(estimate: Estimate, height: float, *, sigma: float = SIGMA) -> tuple[Estimate, str]:
    """The estimate after a height at its own stamp, and what became of that."""
    reading = Height(estimate.stamp, height, sigma**2, WANDER**2, TAU_S, MOUNT)
    after, outcome = FUSION.after_height(estimate, "bmp", reading, None)
    return after, outcome.fate


def z_sigma(estimate: Estimate) -> float:
    return math.sqrt(float(plain_covariance(estimate.state)[UP, UP]))


def claimed(seconds: float) -> float:
    """What a barometer may be off by since its first reading, with the height then, and its noise twice."""
    wandered = 2.0 * WANDER**2 * (1.0 - math.exp(-seconds / TAU_S))
    return math.sqrt(0.01**2 + 2.0 * SIGMA**2 + wandered)


@pytest.mark.parametrize("level", [0.0, 431.0])
def test_the_first_height_of_a_barometer_is_its_level(level: float):
    before = standing(z=5.0)
    after, fate = read(before, level)
    assert fate == "accepted"
    assert after.state is before.state
    later, _ = read(standing(S, 5.0, 50.0, after), level + 2.0)
    assert later.state.position[2] == pytest.approx(7.0, abs=0.01)


@pytest.mark.parametrize("seconds", [1, 30, 1000])
def test_the_height_is_known_as_well_as_a_barometer_that_wanders_and_no_better(seconds: int):
    first, _ = read(standing(), 0.0)
    estimate, _ = read(standing(seconds * S, 0.0, 50.0, first), 2.0)
    for _ in range(100):
        estimate, _ = read(estimate, 2.0)
    assert claimed(seconds) < z_sigma(estimate) < 1.01 * claimed(seconds)
    assert estimate.state.position[2] == pytest.approx(2.0, abs=0.05)
    better = standing(seconds * S, 0.0, 0.9 * claimed(seconds), first)
    assert read(better, 2.0)[0].state is better.state


@pytest.mark.long
@pytest.mark.parametrize("growth", [0.02, 0.2, 2.0])
@pytest.mark.parametrize("drives", [20, pytest.param(40, marks=pytest.mark.soak)])
def test_errors_of_many_drives_are_as_they_are_claimed_with_weather_that_wanders(growth: float, drives: int):
    """The odometry loses its height by ``growth`` [m^2/s], and reads the barometer twice a second."""
    random = np.random.default_rng(4)
    squares = list[float]()
    for _ in range(drives):
        z, weather, estimate = 0.0, random.normal(0.0, WANDER), standing()
        estimate, _ = read(estimate, weather)
        for half in range(1, 200):
            z += random.normal(0.0, math.sqrt(0.5 * growth))
            kept = math.exp(-0.5 / TAU_S)
            weather = kept * weather + random.normal(0.0, WANDER * math.sqrt(1.0 - kept**2))
            sigma = math.sqrt(z_sigma(estimate) ** 2 + 0.5 * growth)
            estimate = standing(half * S // 2, float(estimate.state.position[2]), sigma, estimate)
            estimate, _ = read(estimate, z + weather + random.normal(0.0, SIGMA))
        squares.append(((estimate.state.position[2] - z) / z_sigma(estimate)) ** 2)
    assert 0.4 < np.mean(squares) < 1.4


def test_nothing_but_the_height_learns_from_a_barometer():
    first, _ = read(standing(), 0.0)
    before = standing(S, 0.0, 50.0, first)
    after, _ = read(before, 10.0)
    for part in ("rotation", "velocity", "gyro_bias", "accel_bias"):
        found, expected = getattr(after.state, part), getattr(before.state, part)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(after.state.position[:2], before.state.position[:2], rtol=0, atol=1e-9)
    others = [row for row in range(15) if row != UP]
    kept = np.ix_(others, others)
    np.testing.assert_allclose(
        plain_covariance(after.state)[kept], plain_covariance(before.state)[kept], rtol=1e-9, atol=1e-12
    )


def test_feet_on_the_ground_are_raised_with_the_base():
    foot = "foot", np.array((0.2, 0.0, -0.3)), 1e-4 * np.eye(3)
    first, _ = read(standing(), 0.0)
    before = standing(S, 0.0, 50.0, first)
    before = before._replace(state=with_contact(before.state, *foot))
    after, _ = read(before, 10.0)
    raised = after.state.position - before.state.position
    assert raised[2] == pytest.approx(10.0, abs=0.01)
    np.testing.assert_allclose(after.state.contacts - before.state.contacts, [raised], atol=1e-9)
    found, expected = (contact(one.state, *foot) for one in (after, before))
    np.testing.assert_allclose(found.residual, 0.0, atol=1e-9)
    spreads = [innovation(*pair).covariance for pair in ((after.state, found), (before.state, expected))]
    np.testing.assert_allclose(*spreads, atol=1e-8)


def test_a_gust_is_rejected_and_one_that_stays_for_two_seconds_is_a_new_level():
    """60 m in a second, where the height is known to a few metres; it is none in either case."""
    estimate, _ = read(standing(), 0.0)
    fates = list[str]()
    for tenth in range(10, 40):
        estimate = standing(tenth * S // 10, 0.0, 0.01, estimate)
        estimate, fate = read(estimate, 60.0)
        fates.append(fate)
    assert fates == [*["rejected"] * 20, "reacquired", *["accepted"] * 9]
    assert estimate.state.position[2] == 0.0
    back = standing(5 * S, 0.0, 50.0, estimate)
    assert read(back, 61.0)[0].state.position[2] == pytest.approx(1.0, abs=0.05)


def test_the_pose_by_another_odometry_is_raised_with_the_base_and_its_feet():
    """Else the next displacement would pull the base back down, or turn what the barometer has raised."""
    foot = "foot", np.array((0.2, 0.0, -0.3)), 1e-4 * np.eye(3)
    first, _ = read(standing(), 0.0)
    before = standing(S, 0.0, 50.0, first)
    before = before._replace(
        state=with_contact(with_tracked(before.state, "camera", 0.05), *foot), altimeters=first.altimeters
    )
    after, _ = read(before, 10.0)
    raised = after.state.position - before.state.position
    assert raised[2] == pytest.approx(10.0, abs=0.01)
    np.testing.assert_allclose(after.state.contacts - before.state.contacts, [raised], atol=1e-9)
    found = tracking(after.state, "camera", 1e-6 * np.eye(6), MOUNT)
    np.testing.assert_allclose(found.residual, 0.0, atol=1e-9)
    spread = found.jacobian @ after.state.covariance @ found.jacobian.T
    np.testing.assert_allclose(spread, 0.0, atol=1e-8)


# With an IMU


def lifted(t: float) -> float:
    """The height of a base that is carried to the next floor while all data pause, of 6 to 12 s."""
    return 8.0 if t > 9.0 else 0.0


@cache
def carried(*, has_barometer: bool) -> BaseEstimator:
    """It is copied, and fed no more."""
    drive = Drive(30.0, legs_of([(30.0, 0.0)]), legs_of([(30.0, 0.0)]))
    random = np.random.default_rng(3)
    calls = merged(
        imu_calls(drive, tilted_mount(), random)[::2], velocity_calls(drive, random, sigma=0.02, hertz=10)
    )
    heights = [
        Call(t, "height", (70.0 + lifted(t) + random.normal(0.0, 0.1), 0.1), {"source": "bmp", "wander": 0.3})
        for t in np.arange(0.0, 30.0, 0.1).tolist()
    ]
    base = new_estimator()
    for call in merged(calls, heights if has_barometer else []):
        if not 6.0 < call.t < 12.0:
            getattr(base, call.kind)(stamp_at(call.t), *call.values, **call.options)
            base.state() if call.t > 2.0 and call.kind != "imu" else None
    return base


def test_a_base_that_was_carried_upstairs_during_a_pause_finds_its_height():
    without, base = carried(has_barometer=False).state(), carried(has_barometer=True)
    state = base.state()
    assert abs(without.odom_from_base.translation[2]) < 0.5
    assert without.covariance.pose[2, 2] > 8.0**2
    error = state.odom_from_base.translation[2] - 8.0
    assert error**2 < 9.0 * state.covariance.pose[2, 2]
    assert math.sqrt(state.covariance.pose[2, 2]) < 8.5
    (bmp,) = [one for one in base.health() if one.name == "bmp"]
    assert (bmp.rejected, bmp.sentence) == (0, "")


def test_the_pose_in_odom_rises_at_no_more_than_a_fifth_of_a_metre_per_second():
    base = carried(has_barometer=True)
    stamps = [stamp_at(t) for t in np.arange(29.1, 30.0, 0.1)]
    heights = np.array([base.state(stamp).odom_from_base.translation[2] for stamp in stamps])
    assert heights[-1] > 3.0
    assert np.abs(np.diff(heights)).max() < 0.2 * 0.1 + 0.005


def test_a_base_that_is_set_to_another_height_stays_there():
    base = copy_of(carried(has_barometer=True))
    base.set_pose(Transform("odom", "base_link", (1.0, 2.0, 50.0), (0.0, 0.0, 0.0, 1.0)))
    for n in range(100):
        t = 30.0 + 0.01 * n
        base.imu(stamp_at(t), (0.0, 0.0, 0.0), tilted_mount().matrix[:3, :3].T @ (0.0, 0.0, 9.80665))
        base.height(stamp_at(t), 78.0, 0.1, source="bmp", wander=0.3)
    assert base.state().odom_from_base.translation[2] == pytest.approx(50.0, abs=0.3)


@pytest.mark.parametrize(
    ("height", "options"),
    [
        (math.nan, {}),
        (1.1e8, {}),
        (0.0, {"sigma": 0.0}),
        (0.0, {"wander": -1.0}),
        (0.0, {"correlated_s": 0.0}),
        (0.0, {"correlated_s": math.inf}),
    ],
)
def test_a_height_that_is_none_is_refused_by_the_name_of_its_source(height: float, options: dict[str, float]):
    given = {"sigma": 0.1, **options}
    with pytest.raises(InvalidInput, match="a height of source 'bmp' is at most"):
        new_estimator().height(stamp_at(0.0), height, source="bmp", **given)


# Pressures


class Recorder:
    """In place of an estimator: its calls of ``height``."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, float, float, dict[str, object]]] = []

    def height(self, stamp: int, height: float, sigma: float, **options: object) -> None:
        self.calls.append((stamp, height, sigma, options))


def test_a_pressure_is_a_height_by_the_density_of_the_air():
    """At 15 degrees and 101325 Pa, air has 1.225 kg/m^3 (ISO 2533): 100 Pa are 8.32 m."""
    noise = BarometerNoise()
    assert noise.height(101275.0) - noise.height(101375.0) == pytest.approx(
        100.0 / (1.225 * 9.80665), rel=1e-3
    )
    cold = BarometerNoise(temperature_c=-15.0)
    assert cold.height(9e4) / noise.height(9e4) == pytest.approx(258.15 / 288.15)
    heights: NDArray[np.float64] = np.diff([noise.height(pressure) for pressure in (1.0e5, 9.0e4, 8.1e4)])
    np.testing.assert_allclose(heights[0], heights[1])  # of equal parts of the pressure


def test_a_barometer_is_a_source_of_heights_with_a_noise_that_is_stated_or_its_own():
    base = Recorder()
    one = sensor("bmp", BarometerNoise(sigma=0.4, wander=2.0, correlated_s=60.0))
    assert (one.kind.name, one.stream) == ("barometer", "pressure")
    message = Pressure(5, 0, 1, "r1/mast", 101225.0, 36.0)
    one.add(Estimators(base), message)  # pyright: ignore[reportArgumentType]
    sensor("bmp", BarometerNoise()).add(Estimators(base), message)  # pyright: ignore[reportArgumentType]
    (stamp, height, sigma, options), (_, _, own, _) = base.calls
    assert (stamp, sigma) == (5, 0.4)
    assert height == pytest.approx(8.33, abs=0.01)
    assert options == {
        **{"source": "bmp", "frame": "r1/mast", "wander": 2.0, "correlated_s": 60.0, "gate": 0.999}
    }
    assert own == pytest.approx(0.5, abs=0.01)  # 6 Pa
    unknown = Pressure(5, 0, 1, "r1/mast", 101225.0)
    with pytest.raises(
        InvalidInput, match=r"`--barometer bmp:sigma=0.5`, or sigma = 0.5 .m. in .barometer.bmp"
    ):
        sensor("bmp", BarometerNoise()).add(Estimators(base), unknown)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"sigma": 0.0}, "sigma of a barometer is above zero"),
        ({"wander": math.nan}, "wander of a barometer"),
        ({"correlated_s": -1.0}, "correlated_s of a barometer"),
        ({"temperature_c": 288.15}, "below 100 degrees Celsius; got 288.15"),
    ],
)
def test_a_noise_that_is_none_is_refused(options: dict[str, float], text: str):
    with pytest.raises(InvalidInput, match=text):
        BarometerNoise(**options)
