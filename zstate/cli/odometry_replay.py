"""Odometry from a recording: the path with its covariances, the NIS of each source, and their plot."""

# pyright: reportUnknownMemberType=false
# Matplotlib's annotations leave keyword arguments out

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.cli.commands.plot import new_figure
from zstate.cli.odometry_file import OdometrySettings
from zstate.errors import InvalidInput, NoData
from zstate.model.joint_trajectory import JointTrajectory
from zstate.model.urdf import parse_urdf
from zstate.odometry import BaseEstimator, BaseState, SourceHealth
from zstate.odometry.fusion import STANDSTILL
from zstate.odometry.health import WINDOW
from zstate.odometry.node import add_imu, add_pose, add_velocity
from zstate.recording.recording import HISTORY_S, Recording
from zstate.wire.messages import RobotDescription

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

_HEALTH_NS = 500_000_000
"""Interval of the points of the NIS."""

_ELLIPSES = 40
_RADIUS_95 = math.sqrt(-2.0 * math.log(0.05))
"""Of an ellipse that has 95 % of a normal distribution in the plane, in standard deviations."""

_PATH, _PANEL = 6.0, 2.0
"""Heights of the path and of each source [inch]."""
_FEW_LABELS = 1000.0
"""The range of a logarithmic axis up to which 2 and 5 have labels as well."""

_REST_S = 5.0
"""A robot that was at rest at its start was found to stand by then: alignment takes 0.5 s of it."""

Event = tuple[int, bool, Callable[[BaseEstimator], None]]
"""A stamp, whether it is that of a reading of the IMU, and what passes the data to an estimator."""


@dataclass
class ReplayedOdometry:
    """The odometry of a recording: states after each reading of the IMU, and the health of the sources.

    ``health`` is the last one, ``nis`` by source the points of those in between: seconds since the first
    state, mean NIS, and its band from low to high.
    """

    base: str
    states: list[BaseState] = field(default_factory=list[BaseState])
    health: tuple[SourceHealth, ...] = ()
    nis: dict[str, list[tuple[float, float, float, float]]] = field(
        default_factory=dict[str, list[tuple[float, float, float, float]]]
    )

    @property
    def positions(self) -> Floats:
        """x y z [m] of each state: (n, 3)."""
        return np.array([state.odom_from_base.translation for state in self.states])

    @property
    def seconds(self) -> Floats:
        """The time of each state since the first [s]: (n,)."""
        stamps = np.array([state.stamp for state in self.states], dtype=np.int64)
        return (stamps - stamps[0]) * 1e-9

    @property
    def way_m(self) -> float:
        """The length of the path [m]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())


def replay(path: str, robot: str, settings: OdometrySettings) -> ReplayedOdometry:
    """The odometry of ``robot`` in a recording, from all data in the order of its stamps.

    Raises RecordingError, LookupFailed for unknown mounts, and InvalidInput without readings of the IMU.
    """
    mounts, model = TransformBuffer(HISTORY_S), None
    with Recording(path, robot) as recording:
        for _, message, _ in recording.fill(mounts):
            if isinstance(message, RobotDescription) and model is None:
                model = parse_urdf(message.urdf, f"the URDF of {robot!r}")
        readings = list(recording.imu(robot, settings.imu))
        events: list[Event] = [(one.stamp, True, partial(add_imu, message=one)) for one in readings]
        for sensor in settings.velocities:
            events += [
                (one.stamp, False, partial(add_velocity, sensor=sensor, message=one))
                for one in recording.velocities(robot, sensor)
            ]
        for sensor in settings.poses:
            events += [
                (one.stamp, False, partial(add_pose, sensor=sensor, message=one))
                for one in recording.poses(robot, sensor)
            ]
        joints = recording.joint_states(robot) if settings.has_joints else None
    if not readings:
        raise InvalidInput(
            f"{path} has no reading of the IMU {settings.imu!r} of {robot!r}; `zstate info` shows its streams"
        )
    if joints is not None:
        events += [
            (stamp, False, partial(_add_joints, joints=joints, row=row))
            for row, stamp in enumerate(joints.stamps.tolist())
        ]
    base = settings.base or ("" if model is None else model.root)
    estimator = settings.estimator(robot, base, readings[0].frame, mounts, model)
    return _run(estimator, base, sorted(events, key=itemgetter(0)))


def _add_joints(base: BaseEstimator, joints: JointTrajectory, row: int) -> None:
    names = joints.velocity_coordinates
    base.joints(
        int(joints.stamps[row]),
        dict(zip(joints.coordinates, joints.positions[row].tolist(), strict=True)),
        velocities=_by_name_if_known(names, joints.velocities, row),
        efforts=_by_name_if_known(names, joints.efforts, row),
    )


def _by_name_if_known(names: Sequence[str], block: Floats | None, row: int) -> dict[str, float] | None:
    if block is None or np.isnan(block[row]).any():
        return None
    return dict(zip(names, block[row].tolist(), strict=True))


def _run(base: BaseEstimator, frame: str, events: Sequence[Event]) -> ReplayedOdometry:
    replayed = ReplayedOdometry(frame)
    due = 0
    for stamp, is_imu, add in events:
        add(base)
        if not is_imu:
            continue
        try:
            replayed.states.append(base.state())
        except NoData:  # not aligned yet
            continue
        if stamp >= due:
            due = stamp + _HEALTH_NS
            second = (stamp - replayed.states[0].stamp) * 1e-9
            for one in base.health():
                if one.dimension:
                    replayed.nis.setdefault(one.name, []).append((second, one.nis_mean, *one.nis_band))
    replayed.health = base.health()
    return replayed


def report_lines(replayed: ReplayedOdometry) -> Iterator[str]:
    """The path, its end with one standard deviation, and each source."""
    last = replayed.states[-1]
    x, y, z = last.odom_from_base.translation.tolist()
    sigmas = np.sqrt(np.diag(last.covariance.pose))
    yield (
        f"{replayed.way_m:.2f} m in {replayed.seconds[-1]:.1f} s; {replayed.base} ends at "
        f"x {x:.3f} m (sigma {sigmas[0]:.3f}), y {y:.3f} m ({sigmas[1]:.3f}), z {z:.3f} m ({sigmas[2]:.3f}), "
        f"yaw {math.degrees(last.odom_from_base.rpy[2]):.1f} deg ({math.degrees(sigmas[5]):.1f})"
    )
    if sentence := _rest_text(replayed):
        yield sentence
    for one in replayed.health:
        yield health_text(one)


def _rest_text(replayed: ReplayedOdometry) -> str:
    """Why the yaw is uncertain, if the robot did not stand at the start; empty if it did."""
    stood = replayed.nis.get(STANDSTILL)
    first_s = stood[0][0] if stood else math.inf
    if first_s <= _REST_S:
        return ""
    found = f"it was first found to stand after {first_s:.1f} s" if stood else "it was never found to stand"
    return (
        f"no rest at the start: {found}, so the bias of its gyro is not known, and the sigma of "
        "the yaw grows; begin a recording with 3 s at rest, which wheels or velocities show, and feet do not"
    )


def health_text(health: SourceHealth) -> str:
    """One source on one line."""
    text = f"{health.name}: {health.rate_hz:.1f} Hz"
    if health.dimension:
        low, high = health.nis_band
        text += (
            f", NIS {health.nis_mean:.2f} for {health.dimension} numbers "
            f"({low:.2f} to {high:.2f} if its sigmas are exact), "
            f"{health.accepted} accepted, {health.rejected} rejected, {health.too_late} too late"
        )
    return f"{text}; {health.sentence}" if health.sentence else text


def odometry_figure(replayed: ReplayedOdometry, title: str) -> Figure:
    """The path from above with ellipses of 95 %, and the mean NIS of each source over time with its band.

    Raises LibraryMissing without Matplotlib.
    """
    figure = new_figure(title, _PATH + _PANEL * len(replayed.nis))
    ratios = [_PATH, *[_PANEL] * len(replayed.nis)]
    axes = figure.subplots(len(ratios), 1, squeeze=False, height_ratios=ratios)[:, 0]
    above, *panels = cast("list[Axes]", axes.tolist())
    _draw_path(above, replayed)
    for panel, (name, points) in zip(panels, replayed.nis.items(), strict=True):
        seconds, mean, low, high = np.array(points).T
        panel.fill_between(
            seconds, low, high, color="tab:green", alpha=0.2, label="95 % of means,\nif sigmas are exact"
        )
        panel.plot(
            seconds, mean, color="tab:blue", linewidth=1.3, label=f"mean of the last\n{WINDOW} readings"
        )
        panel.set(ylabel="NIS", xlim=(0.0, replayed.seconds[-1]))
        panel.set_title(f"NIS of {name}", fontsize="medium")
        _set_log_scale(panel, float(min(mean.min(), low.min())), float(max(mean.max(), high.max())))
        panel.grid(visible=True, which="both", alpha=0.3)
        panel.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    if panels:
        panels[-1].set_xlabel("time since the first state [s]")
    return figure


def _set_log_scale(panel: Axes, least: float, greatest: float) -> None:
    """A logarithmic axis with plain numbers at 1, 2 and 5, or at powers of ten if it has many."""
    bottom, top = 0.5 * max(least, 1e-6), 2.0 * greatest
    subs = [2, 5] if top < _FEW_LABELS * bottom else []
    panel.set_yscale("log", subs=subs)
    panel.set_ylim(bottom, top)
    panel.yaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_minor_formatter("{x:g}")


def _draw_path(panel: Axes, replayed: ReplayedOdometry) -> None:
    x, y = replayed.positions[:, :2].T
    panel.plot(x, y, color="0.4", linewidth=1.0, label="path")
    turn = np.linspace(0.0, math.tau, 60)
    circle = _RADIUS_95 * np.stack((np.cos(turn), np.sin(turn)))
    step = max(1, len(x) // _ELLIPSES)
    for number, state in enumerate(replayed.states):
        if number % step:
            continue
        covariance: Floats = state.covariance.pose[:2, :2]
        values, vectors = np.linalg.eigh(covariance)
        ellipse = (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle
        label = None if number else "95 % of positions"
        panel.plot(
            x[number] + ellipse[0], y[number] + ellipse[1], color="tab:blue", linewidth=0.6, label=label
        )
    panel.plot(x[:1], y[:1], "o", color="tab:green", label="first")
    panel.plot(x[-1:], y[-1:], "s", color="tab:red", label="last")
    panel.set(xlabel="x [m]", ylabel="y [m]")
    panel.set_title(f"{replayed.base} in the frame of the odometry, from above", fontsize="medium")
    panel.set_aspect("equal", adjustable="datalim")
    panel.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    panel.grid(visible=True, alpha=0.3)
