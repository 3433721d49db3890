"""Recordings of wheeled robots in tests/odometry/data, as calls of an estimator, and their scores.

Frames and times are those of the recordings: t = 0 is the first sample of the IMU.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from helpers.drives import Call, copy_of, new_estimator
from helpers.plaza import aligned_error, best_turn

from zstate import InFuture, InPast, NoData, Transform
from zstate.odometry import BaseEstimator, DiffDrive
from zstate.odometry.geodesy import Datum
from zstate.odometry.invariant_filter import Floats
from zstate.odometry.map_estimator import MapEstimator, MapState

FOLDER = Path(__file__).parents[1] / "odometry/data"
WHEELS = DiffDrive("left", "right", radius=0.165, track=0.55)
"""Any such geometry: joints are integrated from the speed and the yaw rate of the recording with it."""

HUSKY_MOUNT = Transform.from_rpy("base_link", "imu_link", (0.0, -0.3, 0.52), (math.pi / 2, 0.0, -math.pi / 2))
JACKAL_MOUNT = Transform("base_link", "imu_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
HUSKY_REST_S = 236.7
VELOCITY_VARIANCE, COMPASS_SIGMA = 0.001, 0.035
"""[m^2/s^2], [rad]: what the messages state."""

HUSKY_DATUM = Datum(42.375812, -71.14739467)
"""The first fix of the Husky."""

Change = Callable[[list[Call]], list[Call]]


@dataclass(frozen=True)
class Recording:
    """Samples in their order; ``imu`` has t, rate (3,) and force (3,), ``wheels`` t, speed, yaw rate.

    ``compass`` has t and yaw. ``gps`` has t, x, y [m] and the variance [m^2]; none for a
    simulator.
    """

    name: str
    start: int
    mount: Transform
    imu: Floats
    wheels: Floats
    compass: Floats
    gps: Floats

    def stamp(self, t: float) -> int:
        """The stamp at the time ``t`` [s]."""
        return self.start + round(t * 1e9)


def load(name: str) -> Recording:
    """The recording ``husky`` or ``jackal``."""
    with np.load(FOLDER / f"{name}.npz") as data:
        imu_t, wheels_t = data["imu_us"] * 1e-6, data["wheels_us"] * 1e-6
        imu = np.column_stack((imu_t, data["gyro"] / 5e3, data["accel"] / 1e3))
        wheels = np.column_stack((wheels_t, data["wheels"] / 1e4))
        gps = np.zeros((0, 4))
        if "gps" in data:
            gps = np.column_stack((data["gps_us"] * 1e-6, data["gps"] / 1e3, data["gps_variance"]))
        mount = HUSKY_MOUNT if name == "husky" else JACKAL_MOUNT
        compass = np.column_stack((imu_t, data["yaw"] / 1e4))
        return Recording(name, int(data["start"]), mount, imu, wheels, compass, gps)


def calls_of(
    recording: Recording,
    *,
    as_joints: bool = False,
    has_compass: bool = False,
    start: float = 0.0,
    imu_step: int = 1,
    wheel_step: int = 1,
) -> list[Call]:
    """Calls from ``start`` [s] on, of each so many samples, in the order of their stamps."""
    calls = [Call(row[0], "imu", (row[1:4], row[4:7])) for row in recording.imu[::imu_step]]
    angles, before = np.zeros(2), None
    for t, speed, rate in recording.wheels[::wheel_step].tolist():
        if as_joints:
            across = 0.5 * WHEELS.track * rate
            dt = 0.0 if before is None else t - before
            angles = angles + dt / WHEELS.radius * np.array((speed - across, speed + across))
            before = t
            calls.append(Call(t, "joints", (dict(zip(("left", "right"), angles.tolist(), strict=True)),)))
        else:
            options: dict[str, Any] = {
                "covariance": VELOCITY_VARIANCE * np.eye(3),
                "angular": (0.0, 0.0, rate),
            }
            calls.append(Call(t, "velocity", ((speed, 0.0, 0.0),), options))
    if has_compass:
        for t, yaw in recording.compass[::imu_step].tolist():  # that of the IMU
            calls.append(Call(t, "heading", (yaw, COMPASS_SIGMA), {"source": "compass"}))
    return sorted((call for call in calls if call.t >= start), key=lambda call: call.t)


def fix_calls(
    recording: Recording,
    *,
    start: float = 0.0,
    end: float = math.inf,
    angle: float = 0.0,
    shift: Callable[[float], tuple[float, float]] = lambda _: (0.0, 0.0),
) -> list[Call]:
    """Calls of a MapEstimator from ``start`` to ``end`` [s], without heights, which the recording has not.

    The fixes are turned about the datum by ``angle`` [rad], and moved by ``shift`` [m] at their times [s].
    """
    calls = list[Call]()
    for t, x, y, variance in recording.gps.tolist():
        if start <= t < end:
            east, north = _turn(angle) @ (x, y) + shift(t)
            latitude, longitude, _ = HUSKY_DATUM.geodetic((east, north, 0.0))
            options = {"covariance": variance * np.eye(3), "frame": "base_link"}
            calls.append(Call(t, "fix", (latitude, longitude), options))
    return calls


class MapTrack(NamedTuple):
    """What a MapEstimator made of a recording.

    ``t`` [s], ``places`` x, y, yaw in the map, (N, 3), their ``covariances``, (N, 3, 3); ``sentences`` of its
    health with their times [s].
    """

    t: Floats
    places: Floats
    covariances: Floats
    sentences: dict[str, float]

    def at(self, t: float) -> int:
        """The row of the first state at or after ``t`` [s]."""
        return int(np.searchsorted(self.t, t))

    def first_told(self, text: str, since: float = 0.0) -> float:
        """When a sentence with ``text`` was first read after ``since`` [s]; infinite if it was not."""
        times = (t for sentence, t in self.sentences.items() if text in sentence and t >= since)
        return min(times, default=math.inf)


def new_map_estimator(base: BaseEstimator, datum: Datum | None = HUSKY_DATUM) -> MapEstimator:
    """An estimator of a map, with the mounts that ``base`` knows."""
    return MapEstimator(base, map="map", buffer=base._buffer, datum=datum)


class MapPlayer:
    """A MapEstimator that is fed a recording, with the states at ``times`` [s], read 0.4 s after them."""

    def __init__(self, recording: Recording, times: Floats) -> None:
        self._recording, self._times = recording, times
        self._estimator = new_map_estimator(new_estimator(recording.mount))
        self._states, self._sentences, self._due = list[MapState](), dict[str, float](), 0

    def copied(self) -> MapPlayer:
        """One that has been fed the same, and goes on by itself."""
        other = copy(self)
        other._estimator = copy_of(self._estimator)
        other._states, other._sentences = list(self._states), dict(self._sentences)
        return other

    def feed(self, calls: Iterable[Call]) -> None:
        """Calls of both estimators, in their order of arrival."""
        for call in calls:
            to = self._estimator if call.kind == "fix" else self._estimator.odometry
            getattr(to, call.kind)(self._recording.stamp(call.t), *call.values, **call.options)
            while call.kind != "fix" and self._due < len(self._times):
                due = float(self._times[self._due])
                if due > call.t - 0.4:
                    break
                self._due += 1
                with suppress(NoData, InPast):
                    self._states.append(self._estimator.state(self._recording.stamp(due)))
                for source in self._estimator.health():
                    if source.sentence:
                        self._sentences.setdefault(source.sentence, call.t)

    @property
    def track(self) -> MapTrack:
        """What it has made of its calls so far."""
        states, rows = self._states, np.ix_((0, 1, 5), (0, 1, 5))
        places = [(*one.map_from_base.translation[:2].tolist(), one.map_from_base.rpy[2]) for one in states]
        return MapTrack(
            np.array([(one.stamp - self._recording.start) * 1e-9 for one in states]),
            np.array(places),
            np.array([one.covariance[rows] for one in states]),
            dict(self._sentences),
        )


def played_in_map(recording: Recording, calls: Iterable[Call], times: Floats) -> MapTrack:
    """The track of a ``MapPlayer`` of ``calls``."""
    player = MapPlayer(recording, times)
    player.feed(calls)
    return player.track


def dead_reckoned(recording: Recording, *, start: float = 0.0) -> tuple[Floats, Floats]:
    """Times [s], (T,), and x, y, yaw by the speed of the wheels and the gyro as they are, (T, 3)."""
    imu = recording.imu[recording.imu[:, 0] >= start]
    t, rate = imu[:, 0], (imu[:, 1:4] @ recording.mount.matrix[:3, :3].T)[:, 2]
    dt = np.diff(t)
    yaw = np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt)))
    speed = np.interp(t, recording.wheels[:, 0], recording.wheels[:, 1])
    middle, ways = 0.5 * (yaw[1:] + yaw[:-1]), 0.5 * (speed[1:] + speed[:-1]) * dt
    steps = ways[:, None] * np.stack((np.cos(middle), np.sin(middle)), axis=1)
    return t, np.column_stack((np.vstack((np.zeros(2), np.cumsum(steps, axis=0))), yaw))


def driver_path(recording: Recording) -> Floats:
    """t [s], x, y, yaw of the dead reckoning of the robot's own driver, by its wheels alone: (T, 4)."""
    rows, (x, y, yaw), before = list[tuple[float, ...]](), (0.0, 0.0, 0.0), None
    for t, speed, rate in recording.wheels.tolist():
        dt_s = 0.0 if before is None else t - before
        x, y = x + speed * math.cos(yaw) * dt_s, y + speed * math.sin(yaw) * dt_s
        yaw, before = math.remainder(yaw + rate * dt_s, math.tau), t
        rows.append((t, x, y, yaw))
    return np.array(rows)


class Track(NamedTuple):
    """What an estimator made of a recording.

    Rows are instants of the GPS, or 0.2 s apart: ``t`` [s], ``poses`` x, y, z, yaw, with the covariances of
    the pose, (N, 6, 6). ``live`` are states read as readings of the wheels arrived, if they were read: t, x,
    y, z, and the velocity in odom.
    """

    t: Floats
    poses: Floats
    covariances: Floats
    live: Floats
    sentences: dict[str, str]
    base: BaseEstimator

    @property
    def longest_jump(self) -> float:
        """The longest step [m] between live states beyond what their velocities explain."""
        dt = np.diff(self.live[:, 0])[:, None]
        steps = np.diff(self.live[:, 1:4], axis=0) - 0.5 * dt * (self.live[1:, 4:] + self.live[:-1, 4:])
        return float(np.hypot(steps[:, 0], steps[:, 1]).max())

    @property
    def way(self) -> float:
        """The length of the live path [m]."""
        return float(np.hypot(*np.diff(self.live[:, 1:3], axis=0).T).sum())


def played(
    recording: Recording,
    calls: Sequence[Call],
    *,
    mount: Transform | None = None,
    wheels: DiffDrive | None = None,
    reads_live: bool = False,
) -> Track:
    """Feed ``calls`` in their order; states of instants are read 0.4 s after them.

    ``reads_live`` reads the state after each reading of the wheels as well: that takes half as long again.
    """
    base = new_estimator(mount or recording.mount, wheels=wheels)
    times = recording.gps[:, 0] if len(recording.gps) else np.arange(0.0, recording.imu[-1, 0], 0.2)
    times = times[(times >= min(call.t for call in calls))]
    due, rows, live, sentences = 0, list[tuple[float, Floats, Floats]](), list[Floats](), dict[str, str]()

    def read(until: float) -> None:
        nonlocal due
        while due < len(times) and times[due] <= until:
            try:
                state = base.state(recording.stamp(times[due]))
            except (NoData, InPast, InFuture):
                pass
            else:
                place = np.append(state.odom_from_base.translation, state.odom_from_base.rpy[2])
                rows.append((float(times[due]), place, state.covariance.pose))
            due += 1

    next_health = 0.0
    for call in calls:
        read(call.t - 0.4)
        getattr(base, call.kind)(recording.stamp(call.t), *call.values, **call.options)
        if reads_live and call.kind in {"velocity", "joints"}:
            try:
                state = base.state()
            except NoData:
                continue
            velocity = state.odom_from_base.matrix[:3, :3] @ state.twist.linear
            t = (state.stamp - recording.start) * 1e-9
            live.append(np.concatenate(([t], state.odom_from_base.translation, velocity)))
        if call.t > next_health:
            next_health = call.t + 2.0
            sentences.update((source.name, source.sentence) for source in base.health() if source.sentence)
    read(math.inf if not calls else calls[-1].t)
    t, places, covariances = zip(*rows, strict=True)
    return Track(np.array(t), np.array(places), np.array(covariances), np.array(live), sentences, base)


class Score(NamedTuple):
    """Against the GPS: ``error`` [m] rms after the best alignment; the mean ``nees`` of x and y, expected 2;
    ``end_sigmas`` of the mean of the last 25 fixes, which count as 4, as their errors are correlated."""

    error: float
    nees: float
    end_sigmas: float


def error_of(recording: Recording, t: Floats, path: Floats) -> float:
    """The root mean square distance [m] of x, y at ``t`` from the GPS after the best planar alignment."""
    at = (recording.gps[:, 0] >= t[0]) & (recording.gps[:, 0] <= t[-1])
    fixes = recording.gps[at]
    found = np.stack([np.interp(fixes[:, 0], t, path[:, axis]) for axis in range(2)], axis=1)
    return aligned_error(found, fixes[:, 1:3])


def score(recording: Recording, track: Track) -> Score:
    """Scores of a track with states at the GPS fixes.

    odom is placed in the plane of the GPS where it is most likely under both covariances.
    """
    rows = np.searchsorted(recording.gps[:, 0], track.t - 1e-9)
    truth, variance = recording.gps[rows, 1:3], recording.gps[rows, 3]
    path, covariances = track.poses[:, :2], track.covariances[:, :2, :2]
    weights = np.linalg.inv(covariances + variance[:, None, None] * np.eye(2))
    errors = _most_likely(path, truth, weights)
    nees = float(np.einsum("ni,nij,nj->n", errors, weights, errors).mean())
    last = errors[-25:].mean(axis=0)
    end = covariances[-1] + variance[-25:].mean() / 4.0 * np.eye(2)
    sigmas = math.sqrt(float(last @ np.linalg.solve(end, last)))
    return Score(aligned_error(path, truth), nees, sigmas)


def _most_likely(path: Floats, truth: Floats, weights: Floats) -> Floats:
    """The errors of ``path`` in its own axes, with x, y and yaw of odom by Levenberg and Marquardt."""

    def errors_of(x: float, y: float, yaw: float) -> Floats:
        return (truth - (x, y)) @ _turn(yaw) - path

    def cost_of(values: Floats) -> float:
        errors = errors_of(*values.tolist())
        return float(np.einsum("ni,nij,nj", errors, weights, errors))

    best: Floats | None = None
    turn = best_turn(truth - truth.mean(axis=0), path - path.mean(axis=0))
    found = math.atan2(turn[1, 0], turn[0, 0])
    for offset in (0.0, 0.5, -0.5, 1.5, -1.5, math.pi):
        yaw = found + offset
        values = np.append(truth.mean(axis=0) - _turn(yaw) @ path.mean(axis=0), yaw)
        damping = 1e-3
        for _ in range(100):
            errors, cost = errors_of(*values.tolist()), cost_of(values)
            jacobian = np.zeros((len(path), 2, 3))
            jacobian[:, :, :2] = -_turn(values[2]).T
            away = errors + path
            jacobian[:, 0, 2], jacobian[:, 1, 2] = away[:, 1], -away[:, 0]
            normal = np.einsum("nij,nik,nkl->jl", jacobian, weights, jacobian)
            slope = np.einsum("nij,nik,nk->j", jacobian, weights, errors)
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), slope)
            if cost_of(values - step) <= cost:
                values, damping = values - step, 0.3 * damping
                if np.abs(step).max() < 1e-9:
                    break
            else:
                damping *= 5.0
        if best is None or cost_of(values) < cost_of(best):
            best = values
    assert best is not None
    return errors_of(*best.tolist())


def _turn(yaw: float) -> Floats:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array(((cosine, -sine), (sine, cosine)))
