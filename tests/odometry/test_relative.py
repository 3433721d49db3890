"""Another odometry as a source: its displacements, scale and jumps, and what its covariances are worth."""

from __future__ import annotations

import math
import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers import recordings
from helpers.base_motion import stamp_at, tilted_mount
from helpers.drives import (
    Call,
    Run,
    copy_of,
    imu_calls,
    joint_calls,
    merged,
    new_estimator,
    other_odometry_calls,
    run,
    wandering,
)
from helpers.recordings import (
    HUSKY_REST_S,
    Recording,
    Score,
    calls_of,
    driver_path,
    error_of,
    played,
    score,
)

from zstate import InvalidInput, Transform
from zstate.odometry import BaseEstimator, DiffDrive, SourceHealth
from zstate.odometry.health import chi_square_quantile
from zstate.odometry.relative import RelativePose, moved_between
from zstate.odometry.rotations import rotation_exp
from zstate.odometry.source_noise import RelativeNoise

WHEELS = DiffDrive("left", "right", 0.1, 0.5)
NOISE = RelativeNoise(sigma=0.02, sigma_deg=0.3, floor=0.002, floor_deg=0.05)
"""That of ``other_odometry_calls``."""


DRIVE_S = 21.0


def calls_on(seed: int, seconds: float, *, has_wheels: bool = True, **options: Any) -> list[Call]:
    """An IMU, another odometry, and wheels on a drive from rest."""
    random, drive = np.random.default_rng(seed), wandering(seed, seconds)
    wheels = joint_calls(drive, WHEELS, random) if has_wheels else []
    others = other_odometry_calls(drive, random, **{"noise": NOISE, **options})
    return merged(imu_calls(drive, tilted_mount(), random)[::2], wheels, others)  # at 50 Hz, for speed


@cache
def driven(
    seed: int, seconds: float = DRIVE_S, *, has_wheels: bool = True, **options: Any
) -> tuple[Run, BaseEstimator]:
    """What became of a drive, and its estimator, which is fed no more."""
    base = new_estimator(wheels=WHEELS if has_wheels else None)
    calls = calls_on(seed, seconds, has_wheels=has_wheels, **options)
    return run(base, wandering(seed, seconds), calls), base


def camera_of(base: BaseEstimator) -> SourceHealth:
    return next(source for source in base.health() if source.name == "camera")


@pytest.mark.long
@pytest.mark.parametrize(("runs", "seconds"), [(3, 20.0), pytest.param(20, 40.0, marks=pytest.mark.soak)])
@pytest.mark.parametrize("has_wheels", [False, True])
def test_errors_are_as_large_as_their_covariances(has_wheels: bool, runs: int, seconds: float):
    """Constant errors that are part of the claim are an upper limit of the errors."""
    ends = [driven(seed, seconds, has_wheels=has_wheels)[0].end for seed in range(runs)]
    squares = np.mean([end.squares for end in ends], axis=0)
    for square in squares[:3]:
        assert square < chi_square_quantile(0.999, 3 * len(ends)) / len(ends)
    assert max(end.sigmas for end in ends) < math.sqrt(chi_square_quantile(0.999, 2))


def test_with_an_imu_it_is_enough_to_know_where_the_base_is():
    """An IMU alone would be off by hundreds of metres."""
    found, base = driven(1, has_wheels=False)
    assert wandering(1, DRIVE_S).way > 10.0
    assert found.end.plane < 1.0
    assert found.end.claim < 1.0
    assert camera_of(base).rejected == 0
    assert camera_of(base).sentence == ""


@pytest.mark.long
@pytest.mark.parametrize("scale", [0.7, 1.3])
def test_a_scale_that_is_off_is_found_by_the_wheels_and_named(scale: float):
    found, base = driven(1, scale=scale)
    kind = "short" if scale < 1.0 else "long"
    words = re.search(
        r"displacements are (.*) times as long as .*: they are too (\w*)", camera_of(base).sentence
    )
    assert words
    assert float(words[1]) == pytest.approx(scale, abs=0.03)
    assert words[2] == kind
    assert found.end.sigmas < 3.0
    right, _ = driven(1)
    assert found.end.plane < right.end.plane + 0.1


def test_a_scale_that_nothing_shows_is_a_part_of_the_claim():
    """Displacements that are 30 % too long, of a device whose scale is known to 30 %, and an IMU."""
    found, base = driven(1, has_wheels=False, scale=1.3, noise=RelativeNoise(scale=0.3))
    assert found.end.plane > 0.5
    assert found.end.sigmas < 3.0
    assert "times as long" not in camera_of(base).sentence


@pytest.mark.parametrize("has_wheels", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_jump_is_rejected_and_named_and_the_way_goes_on_from_there(has_wheels: bool):
    jumps = ((10.0, 2.0, 1.0), (14.0, -5.0, 0.0))
    right, _ = driven(1, has_wheels=has_wheels)
    found, base = driven(1, has_wheels=has_wheels, jumps=jumps)
    assert camera_of(base).rejected == 2
    assert (
        "2 of its last 200 readings could not be used: it moved by 5 m in 0.1 s" in camera_of(base).sentence
    )
    assert found.end.plane < right.end.plane + 0.1
    assert found.end.sigmas < 3.0


def test_a_turn_that_was_none_is_named_as_a_turn_wherever_the_base_is():
    """One pose that is turned by 30 degrees on the spot, 300 m from the origin of the odometry frame."""
    start = Transform.from_rpy("odom", "base_link", (300.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    base, calls = new_estimator(wheels=WHEELS, initial_pose=start), calls_on(1, 6.0)
    turned = next(n for n, call in enumerate(calls) if call.kind == "relative_pose" and call.t > 5.0)
    (pose,) = calls[turned].values
    turn = Transform.from_rpy(pose.source, "turned", (0.0, 0.0, 0.0), (0.0, 0.0, math.radians(30.0)))
    wrong = Transform.from_pose7(pose.target, pose.source, (pose @ turn).pose7)
    calls[turned] = calls[turned]._replace(values=(wrong,))
    run(base, wandering(1, 6.0), calls)
    words = re.search(r"s, (\S+) m and (\S+) degrees away from", camera_of(base).sentence)
    assert words
    assert float(words[1]) < 0.1
    assert float(words[2]) == pytest.approx(30.0, abs=1.0)


def frozen(calls: list[Call]) -> list[Call]:
    """The other odometry repeats its first pose, with new stamps."""
    first = next(call for call in calls if call.kind == "relative_pose")
    return [call._replace(values=first.values) if call.kind == first.kind else call for call in calls]


@pytest.mark.long
def test_one_that_lies_steadily_is_not_followed_beside_wheels_that_nothing_contradicts():
    base = new_estimator(wheels=WHEELS)
    found = run(base, wandering(1, DRIVE_S), frozen(calls_on(1, DRIVE_S)))
    camera = camera_of(base)
    assert (camera.reacquired, camera.rejected > 100) == (0, True)
    assert "readings could not be used: it moved by 0 m" in camera.sentence
    assert max(error.sigmas for error in found.errors) < 3.0


def test_the_order_of_arrival_does_not_matter():
    """Poses of the other odometry 0.3 s late, states read all the time."""
    calls = calls_on(2, 8.0)
    late = sorted(calls, key=lambda call: call.t + 0.3 * (call.kind == "relative_pose"))
    one, other = new_estimator(wheels=WHEELS), new_estimator(wheels=WHEELS)
    run(one, wandering(2, 8.0), calls, every_s=10.0)
    run(other, wandering(2, 8.0), late, every_s=0.5)
    first, second = one.state(stamp_at(7.5)), other.state(stamp_at(7.5))
    np.testing.assert_allclose(first.odom_from_base.pose7, second.odom_from_base.pose7, atol=1e-9)
    np.testing.assert_allclose(first.covariance.pose, second.covariance.pose, atol=1e-9)


def test_poses_of_one_stamp_that_differ_in_their_covariance_have_one_order():
    noise, first = RelativeNoise(covariance="independent"), calls_on(2, 5.0)
    poses = [Transform("camera_odom", "base_link", (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) for x in (0.0, 0.3)]
    found = list[np.ndarray]()
    for covariances in ((1e-4, 0.4), (0.4, 1e-4)):
        base = new_estimator(wheels=WHEELS)
        for call in first:
            if call.kind != "relative_pose":
                getattr(base, call.kind)(stamp_at(call.t), *call.values, **call.options)
        base.relative_pose(stamp_at(4.5), poses[0], 1e-4 * np.eye(6), source="camera", noise=noise)
        for variance in covariances:
            base.relative_pose(stamp_at(4.7), poses[1], variance * np.eye(6), source="camera", noise=noise)
        found.append(base.state().odom_from_base.pose7)
    np.testing.assert_array_equal(*found)


def test_a_base_that_is_placed_stays_there_whatever_its_other_odometry_says():
    base = copy_of(driven(2, 10.0)[1])
    there = Transform.from_rpy("odom", "base_link", (20.0, 5.0, 0.0), (0.0, 0.0, 1.0))
    base.set_pose(there)
    after = [call for call in calls_on(2, 12.0) if call.t > 10.0]
    for call in after[:60]:
        getattr(base, call.kind)(stamp_at(call.t), *call.values, **call.options)
    moved = there.inverse() @ base.state().odom_from_base
    assert np.hypot(*moved.translation[:2]) < 1.0


def test_a_world_of_another_name_is_another_odometry():
    """As after a restart that says so: no displacement leads from one to the other."""
    base = copy_of(driven(2, 10.0)[1])
    pose = Transform.from_rpy("camera_odom_2", "base_link", (100.0, 0.0, 0.0), (0.0, 0.0, 3.0))
    before = base.state().odom_from_base.translation
    base.relative_pose(base.newest, pose, source="camera", noise=NOISE)
    assert camera_of(base).rejected == 0
    np.testing.assert_allclose(base.state().odom_from_base.translation, before, atol=1e-9)


def with_mirrored_yaw(pose: Transform) -> Transform:
    """As of axes with z down."""
    return Transform.from_rpy(pose.target, pose.source, pose.translation, (0.0, 0.0, -pose.rpy[2]))


def test_turns_that_contradict_the_gyro_do_not_move_a_base_that_is_far_from_the_origin():
    """Yaws of the wrong sign, 1000 m away: 4 degrees about the origin would be 70 m."""
    base = copy_of(driven(1, 10.0)[1])
    base.set_pose(Transform.from_rpy("odom", "base_link", (1000.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    for call in calls_on(1, 20.0):
        values = map(with_mirrored_yaw, call.values) if call.kind == "relative_pose" else call.values
        if call.t > 10.0:
            getattr(base, call.kind)(stamp_at(call.t), *values, **call.options)
    words = re.search(r" s, (\S*) m and (\S*) degrees away", camera_of(base).sentence)
    assert words
    assert float(words[1]) < 2.0
    assert float(words[2]) > 1.0
    way = np.linalg.norm(base.state().odom_from_base.translation - np.array((1000.0, 0.0, 0.0)))
    assert way < 12.0


def pose_of(
    number: int, covariance: np.ndarray | None, kind: str, *, way: float = 0.5, turn: float = 0.1
) -> RelativePose:
    """The pose ``number`` on an arc."""
    step, pose = np.eye(4), np.eye(4)
    step[:3, :3], step[:3, 3] = rotation_exp(np.array([0.0, 0.0, turn])), (way, 0.0, 0.0)
    for _ in range(number):
        pose = pose @ step
    noise = RelativeNoise(covariance=kind)  # pyright: ignore[reportArgumentType]
    return RelativePose(number, "camera_odom", pose, covariance, noise, np.eye(4))


def adjoint_of(pose: np.ndarray) -> np.ndarray:
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = pose[:3, :3]
    matrix[3:, :3] = np.cross(pose[:3, 3], np.eye(3)).T @ pose[:3, :3]
    return matrix


def test_covariances_of_dead_reckoning_grow_by_that_of_the_displacement():
    """``exp(e) T`` of a pose is ``exp(e) T exp(n) Z`` one displacement later: its error has grown by Ad n."""
    step = np.diag([1e-6, 2e-6, 3e-6, 4e-4, 5e-4, 6e-4])  # rotation first, in the axes of the base
    errors, known = np.zeros((6, 6)), list[np.ndarray]()
    for number in range(32):
        pose = pose_of(number, None, "dependent").pose
        plain_from_error = np.eye(6)
        plain_from_error[3:, :3] = -np.cross(pose[:3, 3], np.eye(3)).T
        plain = plain_from_error @ errors @ plain_from_error.T
        known.append(np.roll(plain, (3, 3), axis=(0, 1)))
        errors = errors + adjoint_of(pose) @ step @ adjoint_of(pose).T
    found = moved_between(pose_of(30, known[30], "dependent"), pose_of(31, known[31], "dependent"))
    assert not found.is_stated
    np.testing.assert_allclose(found.walk, step, atol=1e-12)


def test_covariances_of_poses_that_were_measured_one_by_one_are_their_noise():
    covariance = np.diag([0.01, 0.04, 0.09, 1e-4, 4e-4, 9e-4])
    first, second = (pose_of(number, covariance, "independent", turn=0.5 * math.pi) for number in (0, 1))
    found = moved_between(first, second)
    floor = np.repeat((math.radians(0.1) ** 2, 0.005**2), 3)
    # A quarter of a turn: x of the world is -y of the base.
    expected = np.array([4e-4, 1e-4, 9e-4, 0.04, 0.01, 0.09])
    np.testing.assert_allclose(found.spread, np.diag(floor + expected), atol=1e-12)
    assert not found.walk.any()


@pytest.mark.parametrize("kind", ["dependent", "independent"])
@pytest.mark.parametrize("covariance", [None, np.zeros((6, 6)), np.diag([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])])
def test_covariances_that_are_none_leave_the_stated_sigmas(kind: str, covariance: np.ndarray | None):
    found = moved_between(pose_of(2, covariance, kind), pose_of(3, covariance, kind))
    stated = moved_between(pose_of(2, None, "stated"), pose_of(3, None, "stated"))
    assert found.is_stated
    np.testing.assert_array_equal(found.walk, stated.walk)
    # 0.05 m and 0.5 degrees a root of a metre, and 2 % of the turn of 0.1 rad.
    turned = math.radians(0.5) ** 2 * 0.5 + (0.02 * 0.1) ** 2
    np.testing.assert_allclose(np.diag(found.walk), np.repeat((turned, 0.05**2 * 0.5), 3), rtol=1e-6)


def test_covariances_of_no_use_are_named():
    """A driver that sends a constant for what its poses are off by, as many do."""
    constant = {"noise": RelativeNoise(covariance="dependent")}
    calls = [
        call._replace(values=(*call.values, 0.01 * np.eye(6))) if call.kind == "relative_pose" else call
        for call in calls_on(1, 10.0, **constant)
    ]
    base = new_estimator(wheels=WHEELS)
    run(base, wandering(1, 10.0), calls)
    assert "its covariances do not grow as dependent ones do" in camera_of(base).sentence


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"sigma": 0.0}, "sigma of a relative source is above zero"),
        ({"scale": math.inf}, "scale of a relative source"),
        ({"covariance": "diagonal"}, "one of stated, dependent, independent; got 'diagonal'"),
    ],
)
def test_noise_that_cannot_be_is_refused(changed: dict[str, Any], why: str):
    with pytest.raises(InvalidInput, match=why):
        RelativeNoise(**changed)


def test_a_covariance_of_another_shape_is_refused_with_the_name_of_its_source():
    pose = Transform("camera_odom", "base_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with pytest.raises(InvalidInput, match=r"covariance of source 'camera' is finite, \(6, 6\)"):
        new_estimator().relative_pose(stamp_at(1.0), pose, np.eye(3), source="camera")


@cache
def husky() -> Recording:
    return recordings.load("husky")


def driver_calls(start: float) -> list[Call]:
    """The dead reckoning of the Husky's own driver, which has no gyro."""
    calls = list[Call]()
    for t, x, y, yaw in driver_path(husky()).tolist():
        pose = Transform.from_rpy("wheel_odom", "base_link", (x, y, 0.0), (0.0, 0.0, yaw))
        calls.append(Call(t, "relative_pose", (pose,), {"source": "driver"}))
    return [call for call in calls if call.t >= start]


def scored(sources: str, start: float, end: float = math.inf) -> Score:
    """Of the IMU and some of "wheels", as velocities, and "driver", its odometry; from ``start`` [s] on."""
    calls = [call for call in calls_of(husky(), start=start) if call.kind == "imu" or "wheels" in sources]
    calls = merged(calls, driver_calls(start) if "driver" in sources else [])
    return score(husky(), played(husky(), [call for call in calls if call.t < end]))


@pytest.mark.long
def test_a_real_drivers_odometry_is_inside_its_claim_and_beside_wheels_makes_a_drive_no_worse():
    """From rest, for 60 s. The errors of the fixes are 0.8 to 1.7 m."""
    driver, wheels, both = (
        scored(sources, HUSKY_REST_S, HUSKY_REST_S + 60.0)
        for sources in ("driver", "wheels", "wheels, driver")
    )
    assert driver.error < 4.0
    assert driver.nees < 2.0
    assert driver.end_sigmas < 3.0
    assert both.error < 1.1 * wheels.error
    assert both.nees < 2.0


@pytest.mark.long
@pytest.mark.soak
@pytest.mark.parametrize(
    ("sources", "start", "error", "nees"),
    [
        ("driver", HUSKY_REST_S, 2.7, 0.6),
        ("wheels", HUSKY_REST_S, 2.2, 1.2),
        ("wheels, driver", HUSKY_REST_S, 2.3, 1.5),
        ("driver", 0.0, 8.4, 2.7),
        ("wheels", 0.0, 2.9, 0.5),
        ("wheels, driver", 0.0, 7.7, 2.1),
    ],
)
def test_errors_on_a_real_drive_are_those_in_the_guide(sources: str, start: float, error: float, nees: float):
    found = scored(sources, start)
    assert (found.error, found.nees) == pytest.approx((error, nees), abs=0.1)


@pytest.mark.parametrize(("start", "error"), [(HUSKY_REST_S, 2.5), (0.0, 6.9)])
def test_errors_of_a_real_drivers_odometry_are_those_in_the_guide(start: float, error: float):
    path = driver_path(husky())
    path = path[path[:, 0] >= start]
    assert error_of(husky(), path[:, 0], path[:, 1:3]) == pytest.approx(error, abs=0.1)
