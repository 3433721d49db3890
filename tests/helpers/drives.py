"""Drives on a level floor with their truth, and what wheels, feet and an IMU on the base measure of them.

A drive has arrays over instants 2 ms apart, which the integrals of position and yaw use as well. Sensors are
read as lists of ``Call``: the time [s], the method of BaseEstimator, its arguments and options. A fault of a
sensor is then a function from one such list to another one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
from helpers.base_motion import mounted, stamp_at, tilted_mount

from zstate import InFuture, InPast, InvalidInput, NoData, Transform
from zstate.model.urdf import parse_urdf
from zstate.odometry import BaseEstimator, BaseState, ImuNoise, LegNoise, Legs, WheelNoise, Wheels
from zstate.odometry.invariant_filter import GRAVITY, Floats
from zstate.odometry.map_estimator import MapEstimator

STEP_S = 0.002
IMU_HZ, JOINTS_HZ = 100, 20
NOISE = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
"""What `zstate odometry` takes by default."""


class Call(NamedTuple):
    """A call of an estimator: the time of the measurement [s], the method, its arguments, its options."""

    t: float
    kind: str
    values: tuple[Any, ...]
    options: dict[str, Any] = {}  # noqa: RUF012 - replaced, never written to


Profile = Callable[[Floats], Floats]
EstimatorT = TypeVar("EstimatorT", BaseEstimator, MapEstimator)


@dataclass
class Drive:
    """A base with the velocity ``along``, ``across`` [m/s] and ``turning`` [rad/s], at x = y = yaw = 0 first.

    Each is a function of instants [s]; it is smoothed over 0.4 s.
    """

    seconds: float
    along: Profile
    turning: Profile
    across: Profile = np.zeros_like
    t: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.t = np.arange(-0.2, self.seconds + 0.2, STEP_S)
        smooth = np.hanning(round(0.4 / STEP_S) + 1)
        smooth /= smooth.sum()
        half = len(smooth) // 2
        rows = [np.pad(part(self.t), half, mode="edge") for part in (self.along, self.across, self.turning)]
        self.vx, self.vy, self.rate = (np.convolve(row, smooth, "valid") for row in rows)
        yaw = _integral(self.rate)
        self.yaw = yaw - np.interp(0.0, self.t, yaw)
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        x, y = _integral(self.vx * cosine - self.vy * sine), _integral(self.vx * sine + self.vy * cosine)
        self.x, self.y = x - np.interp(0.0, self.t, x), y - np.interp(0.0, self.t, y)

    def at(self, row: Floats, t: Floats | float) -> Floats:
        """A row such as ``yaw`` at the instants ``t`` [s]."""
        return np.interp(t, self.t, row)

    def forces(self, mount: Transform) -> Floats:
        """The specific force at the IMU in the axes of the base, of a point of a rigid body: (T, 3)."""
        lx, ly, _ = mount.translation.tolist()
        turned = np.gradient(self.rate, STEP_S)
        ax = np.gradient(self.vx, STEP_S) - self.rate * self.vy - self.rate**2 * lx - turned * ly
        ay = np.gradient(self.vy, STEP_S) + self.rate * self.vx - self.rate**2 * ly + turned * lx
        return np.stack((ax, ay, np.full_like(ax, -GRAVITY[2])), axis=1)

    @property
    def way(self) -> float:
        """The length of the path [m]."""
        return float(np.hypot(self.vx, self.vy).sum() * STEP_S)


def legs_of(
    values: Sequence[tuple[float, float]], *, else_: float = 0.0
) -> Profile:  # (until, value), one after the other
    """A profile that has each value until its instant [s], and ``else_`` after the last."""
    ends, levels = np.array([end for end, _ in values]), np.array([*(level for _, level in values), else_])
    return lambda t: levels[np.searchsorted(ends, t, side="right")]


def wandering(
    seed: int, seconds: float, *, rest_s: float = 3.0, sideways: bool = False, steered: bool = False
) -> Drive:
    """A drive whose velocity is drawn each 4 s: up to 1 m/s, 0.6 rad/s; it stands in an eighth of them.

    ``steered``: it turns only as it drives, with a curvature of up to 0.5 per metre.
    """
    random, count = np.random.default_rng(seed), math.ceil(seconds / 4.0) + 1
    ends = rest_s + 4.0 * np.arange(count)
    moves = random.random(count) > 0.125
    moves[0] = rest_s == 0.0
    speed, aside = random.uniform(0.3, 1.0, count) * moves, random.uniform(-0.4, 0.4, count) * moves
    bend = random.uniform(-0.5, 0.5, count)
    rate = bend * speed if steered else random.uniform(-0.6, 0.6, count) * moves

    def profile(levels: Floats) -> Profile:
        return legs_of(list(zip(ends.tolist(), levels.tolist(), strict=True)))

    return Drive(seconds, profile(speed), profile(rate), profile(aside if sideways else np.zeros(count)))


@dataclass(frozen=True)
class Vibration:
    """What a rough floor adds to an IMU in motion: standard deviations [m/s^2] and [rad/s] of a sample.

    ``is_banded``: a sum of 16 sines from 15 to 40 Hz in each axis, whose integral is bounded; else white from
    sample to sample.
    """

    force: float
    rate: float
    is_banded: bool = False

    def samples(self, t: Floats, moves: Floats, random: np.random.Generator) -> tuple[Floats, Floats]:
        """What is added to rate and force, (T, 3) each; ``moves`` is 1 in motion and 0 at rest."""
        if self.is_banded:
            hertz, phase = random.uniform(15.0, 40.0, (6, 16)), random.uniform(0.0, math.tau, (6, 16))
            waves = np.sin(math.tau * t[:, None, None] * hertz + phase).sum(axis=2) / math.sqrt(8.0)
        else:
            waves = random.standard_normal((len(t), 6))
        waves = waves * moves[:, None]
        return waves[:, :3] * self.rate, waves[:, 3:] * self.force


def imu_calls(
    drive: Drive,
    mount: Transform,
    random: np.random.Generator,
    *,
    noise: ImuNoise = NOISE,
    vibration: Vibration | None = None,
    biases: tuple[float, float] = (0.01, 0.05),
) -> list[Call]:
    """The samples of an IMU with ``noise``; its biases have the standard deviations ``biases`` at first."""
    t = np.arange(0.0, drive.seconds, 1.0 / IMU_HZ)
    forces = drive.forces(mount)
    rate = np.stack((np.zeros_like(t), np.zeros_like(t), drive.at(drive.rate, t)), axis=1)
    force = np.stack([drive.at(forces[:, axis], t) for axis in range(3)], axis=1)
    added = np.zeros((2, len(t), 3))
    if vibration is not None:
        moves = np.clip(np.hypot(drive.at(drive.vx, t), drive.at(drive.vy, t)) / 0.1, 0.0, 1.0)
        added = np.array(vibration.samples(t, moves, random))
    turn = mount.matrix[:3, :3]
    shift, scale = random.normal(0.0, noise.gyro_bias_shift, 3), random.normal(0.0, noise.gyro_scale)
    moves = np.abs(drive.at(drive.vx, t)) + np.abs(drive.at(drive.vy, t)) + np.abs(rate[:, 2]) > 1e-6
    rate = rate * (1.0 + scale)
    measured: list[Floats] = []
    for ideal, extra, white, walk, first in (
        (rate, added[0], noise.gyro, noise.gyro_bias, biases[0]),
        (force, added[1], noise.accel, noise.accel_bias, biases[1]),
    ):
        bias = random.normal(0.0, first, 3) + np.cumsum(
            random.normal(0.0, walk / math.sqrt(IMU_HZ), ideal.shape), 0
        )
        spread = random.normal(0.0, white * math.sqrt(IMU_HZ), ideal.shape)
        measured.append(ideal @ turn + extra + bias + spread)
    measured[0] += moves[:, None] * shift
    return [Call(at, "imu", (gyro, accel)) for at, gyro, accel in zip(t.tolist(), *measured, strict=True)]


def measured_motion(
    drive: Drive, times: Floats, random: np.random.Generator, noise: WheelNoise, *, track_error: float
) -> tuple[Floats, Floats]:
    """The mean velocities between ``times`` as wheels with ``noise`` measure them: linear, angular, (N, 3).

    The radius is wrong by a constant, the yaw rate by another one, of ``track_error``.
    """
    dt = np.diff(times)
    part, rows = [_integral(row) for row in (drive.vx, drive.vy, drive.rate)], np.zeros((6, len(dt)))
    for place, row in zip((0, 1, 5), part, strict=True):
        rows[place] = np.diff(drive.at(row, times)) / dt
    speed = np.hypot(rows[0], rows[1])
    sideways = bool(np.any(drive.vy))
    scale = 1.0 + random.normal(0.0, noise.scale)
    for place in (0, 1) if sideways else (0,):
        spread = np.hypot(noise.speed, noise.slip * speed) * (speed > 1e-6)
        rows[place] = rows[place] * scale + random.normal(0.0, 1.0, len(dt)) * spread
    rows[5] = rows[5] * (1.0 + random.normal(0.0, track_error))
    return rows[:3].T, rows[3:].T


def joint_calls(
    drive: Drive,
    wheels: Wheels,
    random: np.random.Generator,
    *,
    hertz: float = JOINTS_HZ,
    track_error: float = 0.05,
    distort: Callable[[float, Floats, Floats], None] | None = None,
) -> list[Call]:
    """The joints of ``wheels``, with the noise that they state.

    ``distort(t, linear, angular)`` changes the motion that the wheels make before ``t``, as by slip.
    """
    times = np.arange(0.0025, drive.seconds, 1.0 / hertz)
    linear, angular = measured_motion(drive, times, random, wheels.noise, track_error=track_error)
    steering = getattr(wheels, "steering_angles", None)
    positions = dict.fromkeys(wheels.joint_names, 0.0)
    calls = [Call(float(times[0]), "joints", (dict(positions),))]
    for row, t in enumerate(times[1:].tolist()):
        velocity, rate = linear[row].copy(), angular[row].copy()
        if distort is not None:
            distort(t, velocity, rate)
        if steering is not None and abs(velocity[0]) < 0.02:
            rate[:] = 0.0
        for name, value in wheels.joint_velocities(velocity, rate).items():
            positions[name] += value * (t - times[row])
        if steering is not None:
            positions.update(steering(velocity, rate))
        calls.append(Call(t, "joints", (dict(positions),)))
    return calls


def velocity_calls(
    drive: Drive,
    random: np.random.Generator,
    *,
    sigma: float,
    scale: float = 0.0,
    hertz: float = JOINTS_HZ,
    stated: float | None = None,
    has_rate: bool = True,
) -> list[Call]:
    """Velocities with white noise of ``sigma``, stated as ``stated``, and a constant relative error."""
    times = np.arange(0.0025, drive.seconds, 1.0 / hertz)
    factor = 1.0 + random.normal(0.0, scale)
    calls: list[Call] = []
    for t in times.tolist():
        ideal = np.array((float(drive.at(drive.vx, t)), float(drive.at(drive.vy, t)), 0.0))
        linear = ideal * factor + random.normal(0.0, 1.0, 3) * sigma
        options: dict[str, Any] = {"sigma": [sigma if stated is None else stated] * 3}
        if has_rate:
            options["angular"] = (0.0, 0.0, float(drive.at(drive.rate, t)))
        calls.append(Call(t, "velocity", (linear,), options))
    return calls


_FEET = ("front_left", "rear_right", "front_right", "rear_left")
_STANCES = np.array(((0.3, 0.2, -0.5), (-0.3, -0.2, -0.5), (0.3, -0.2, -0.5), (-0.3, 0.2, -0.5)))
_SWING_S = 0.25


def sliding_legs(noise: LegNoise | None = None) -> Legs:
    """Four legs of sliding joints along x, y and z: the joints of a foot are where it is in the base.

    The model has no IMU: the first link is where ``foot_calls`` has it.
    """
    parts = ['<link name="imu_link"/><link name="base_link"/>', _fixed("imu", "base_link", "imu_link")]
    for foot in _FEET:
        ends = ("base_link", f"{foot}_x", f"{foot}_y", foot)
        for axis, parent, child, vector in zip("xyz", ends[:-1], ends[1:], np.eye(3), strict=True):
            direction = " ".join(f"{part:g}" for part in vector)
            parts.append(
                f'<link name="{child}"/><joint name="{foot}_{axis}" type="prismatic">'
                f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{direction}"/>'
                '<limit lower="-2" upper="2" velocity="9" effort="9"/></joint>'
            )
    model = parse_urdf(f'<robot name="slider">{"".join(parts)}</robot>', "slider.urdf")
    return Legs(model, _FEET, imu="imu_link", noise=noise)


def _fixed(name: str, parent: str, child: str) -> str:
    mount = tilted_mount()
    xyz, rpy = (" ".join(str(float(part)) for part in row) for row in (mount.translation, mount.rpy))
    return (
        f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/></joint>'
    )


def foot_calls(drive: Drive, legs: Legs, random: np.random.Generator, *, hertz: float = 50.0) -> list[Call]:
    """Joints and contacts of a trot: the feet of one diagonal swing for 0.25 s, then those of the other."""
    times, noise = np.arange(0.0025, drive.seconds, 1.0 / hertz), legs.noise
    points, calls, before = np.zeros((4, 3)), list[Call](), -1
    for t in times.tolist():
        yaw = float(drive.at(drive.yaw, t))
        turn = np.array(
            ((math.cos(yaw), -math.sin(yaw), 0.0), (math.sin(yaw), math.cos(yaw), 0.0), (0.0, 0.0, 1.0))
        )
        place = np.array((float(drive.at(drive.x, t)), float(drive.at(drive.y, t)), 0.0))
        step = math.floor(t / _SWING_S)
        swinging = slice(0, 2) if step % 2 else slice(2, 4)
        if before < 0:
            points = place + _STANCES @ turn.T
        points[swinging] = place + _STANCES[swinging] @ turn.T
        points += random.normal(0.0, noise.slip / math.sqrt(hertz), (4, 3))
        if step != before:
            touching = {foot: not (swinging.start <= row < swinging.stop) for row, foot in enumerate(_FEET)}
            calls.append(Call(t - 1e-6, "contacts", (touching,)))
            before = step
        in_base = (points - place) @ turn
        measured = in_base + random.normal(0.0, math.hypot(noise.foot, noise.joint), (4, 3))
        positions = {
            f"{foot}_{axis}": float(value)
            for foot, row in zip(_FEET, measured, strict=True)
            for axis, value in zip("xyz", row, strict=True)
        }
        calls.append(Call(t, "joints", (positions,)))
    return calls


def compass_calls(
    drive: Drive,
    random: np.random.Generator,
    *,
    hard_iron: float = 0.0,
    sigma: float = 0.035,
    hertz: float = 10,
) -> list[Call]:
    """Headings from a north that odom has not; ``hard_iron`` [rad] is the amplitude of their error."""
    calls: list[Call] = []
    for t in np.arange(0.004, drive.seconds, 1.0 / hertz).tolist():
        yaw = float(drive.at(drive.yaw, t))
        measured = yaw + 1.0 + hard_iron * math.sin(yaw + 0.5) + random.normal(0.0, sigma)
        calls.append(Call(t, "heading", (math.remainder(measured, math.tau), sigma), {"source": "compass"}))
    return calls


class OtherErrors(NamedTuple):
    """Of another odometry, by its way [m and degrees per root of a metre], and of each pose [m, degrees]."""

    sigma: float = 0.02
    sigma_deg: float = 0.3
    floor: float = 0.002
    floor_deg: float = 0.05


OTHER_ERRORS = OtherErrors()


def other_odometry_calls(
    drive: Drive,
    random: np.random.Generator,
    *,
    errors: OtherErrors = OTHER_ERRORS,
    scale: float = 1.0,
    jumps: Sequence[tuple[float, float, float]] = (),  # from when [s], and by how much in x and y
    hertz: float = 10.0,
    **options: Any,
) -> list[Call]:
    """Poses of the base in a world of its own, by dead reckoning of ``scale`` times the true ways."""
    times, place = np.arange(0.005, drive.seconds, 1.0 / hertz), np.array((5.0, -3.0, 0.4))
    truth = np.stack([drive.at(row, times) for row in (drive.x, drive.y, drive.yaw)], axis=1)
    calls, sigmas = list[Call](), np.array((errors.sigma, errors.sigma, math.radians(errors.sigma_deg)))
    white = np.repeat((errors.floor, math.radians(errors.floor_deg)), 3)
    for row, t in enumerate(times.tolist()):
        before = truth[max(row - 1, 0)]
        way, turn = _turned(truth[row, :2] - before[:2], -before[2]), truth[row, 2] - before[2]
        step = np.append(way * scale, turn) + random.normal(0.0, 1.0, 3) * sigmas * math.sqrt(np.hypot(*way))
        place = place + np.append(_turned(step[:2], place[2]), step[2])
        for at, x, y in jumps:
            if t - 1.0 / hertz < at <= t:
                place += (x, y, 0.0)
        x, y, z, roll, pitch, yaw = random.normal(0.0, 1.0, 6) * white
        pose = Transform.from_rpy(
            "camera_odom",
            "base_link",
            (place[0] + x, place[1] + y, z),
            (roll, pitch, math.remainder(place[2] + yaw, math.tau)),
        )
        calls.append(Call(t, "relative_pose", (pose,), {"source": "camera", **options}))
    return calls


def _turned(vector: Floats, yaw: float) -> Floats:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array((cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]))


def merged(*lists: Iterable[Call]) -> list[Call]:
    """All calls in the order of their stamps."""
    return sorted((call for calls in lists for call in calls), key=lambda call: call.t)


class Errors(NamedTuple):
    """The state of an estimator against the truth at ``t`` [s].

    ``plane`` is the distance [m] in x and y, ``yaw`` its error [rad]; ``sigmas`` the larger one of the
    Mahalanobis distances of both; ``claim`` and ``yaw_claim`` their standard deviations. ``squares`` are the
    normalised squared errors of position (3), attitude (3), velocity (3) and yaw (1).
    """

    t: float
    plane: float
    yaw: float
    claim: float
    yaw_claim: float
    sigmas: float
    squares: tuple[float, float, float, float]


def errors_of(drive: Drive, state: BaseState, first_t: float = 0.0) -> Errors:
    """``state`` against the truth; odom is where the base was at ``first_t`` [s]."""
    t = (state.stamp - stamp_at(0.0)) * 1e-9
    dx, dy = (float(drive.at(row, t) - drive.at(row, first_t)) for row in (drive.x, drive.y))
    first = float(drive.at(drive.yaw, first_t))
    cosine, sine = math.cos(first), math.sin(first)
    place = np.array((cosine * dx + sine * dy, cosine * dy - sine * dx, 0.0))
    yaw = float(drive.at(drive.yaw, t)) - first
    velocity = np.array((float(drive.at(drive.vx, t)), float(drive.at(drive.vy, t)), 0.0))
    position = np.array(state.odom_from_base.translation) - place
    truth = np.array(
        ((math.cos(yaw), -math.sin(yaw), 0.0), (math.sin(yaw), math.cos(yaw), 0.0), (0.0, 0.0, 1.0))
    )
    turn = state.odom_from_base.matrix[:3, :3] @ truth.T
    angle = np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])) / 2.0
    yaw_error = math.remainder(state.odom_from_base.rpy[2] - yaw, math.tau)
    pose, twist = state.covariance
    squares = (
        float(position @ np.linalg.solve(pose[:3, :3], position)),
        float(angle @ np.linalg.solve(pose[3:, 3:], angle)),
        _square(state.twist.linear - velocity, twist[:3, :3]),
        yaw_error**2 / float(pose[5, 5]),
    )
    level = position[:2]
    mahalanobis = math.sqrt(float(level @ np.linalg.solve(pose[:2, :2], level)))
    claim = math.sqrt(float(np.linalg.eigvalsh(pose[:2, :2]).max()))
    sigmas = max(mahalanobis, math.sqrt(squares[3]))
    return Errors(t, float(np.hypot(*level)), yaw_error, claim, math.sqrt(float(pose[5, 5])), sigmas, squares)


class Run(NamedTuple):
    """What an estimator made of calls.

    ``errors`` are those every ``every_s`` and at the end. ``sentences`` are all that health() returned, by
    their source, with the times of the first and the last one; ``last`` those at the end. ``refused`` are
    messages of InvalidInput by calls, ``missing`` the times without a state.
    """

    errors: list[Errors]
    sentences: dict[str, tuple[float, float, str]]
    last: list[str]
    refused: list[str]
    missing: list[float]

    @property
    def end(self) -> Errors:
        """The errors at the end."""
        return self.errors[-1]


def run(
    base: BaseEstimator,
    drive: Drive,
    calls: Sequence[Call],
    *,
    every_s: float = 1.0,
    first_t: float = 0.0,
    stamp_of: Callable[[Call], int] | None = None,
) -> Run:
    """Feed ``calls`` in their order of arrival, and read states and health."""
    errors, missing, refused = list[Errors](), list[float](), list[str]()
    sentences = dict[str, tuple[float, float, str]]()
    due, last_t = every_s, 0.0

    def read(t: float) -> None:
        try:
            errors.append(errors_of(drive, base.state(stamp_at(t)), first_t))
        except (NoData, InFuture, InPast):
            missing.append(t)
        for source in base.health():
            if source.sentence:
                begin = sentences.get(source.name, (t, t, ""))[0]
                sentences[source.name] = (begin, t, source.sentence)

    for call in calls:
        while call.t >= due + 0.1 and call.t < drive.seconds:
            read(due)
            due += every_s
        stamp = stamp_at(call.t) if stamp_of is None else stamp_of(call)
        try:
            getattr(base, call.kind)(stamp, *call.values, **call.options)
        except InvalidInput as error:
            refused.append(f"{call.kind}: {error}")
        last_t = call.t
    read(min(last_t, drive.seconds - 0.05))
    return Run(errors, sentences, [one.sentence for one in base.health() if one.sentence], refused, missing)


def new_estimator(mount: Transform | None = None, **options: Any) -> BaseEstimator:
    """An estimator as `zstate odometry` makes it by default, with an IMU at ``mount``."""
    return BaseEstimator(
        odom="odom",
        base="base_link",
        imu="imu_link",
        buffer=mounted(mount or tilted_mount()),
        imu_noise=options.pop("imu_noise", NOISE),
        **options,
    )


def copy_of(estimator: EstimatorT) -> EstimatorT:
    """An estimator that knows the same, and goes on by itself with the same mounts."""
    base = estimator if isinstance(estimator, BaseEstimator) else estimator.odometry
    return deepcopy(estimator, {id(base._buffer): base._buffer})


def _integral(row: Floats) -> Floats:
    return np.concatenate(([0.0], np.cumsum(0.5 * (row[1:] + row[:-1])) * STEP_S))


def _square(error: Floats, covariance: Floats) -> float:
    return float(error @ np.linalg.solve(covariance, error))
