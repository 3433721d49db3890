"""Odometry from a recording: a table of its sources, the path with its covariances, and their plot."""

# pyright: reportUnknownMemberType=false
# Matplotlib's annotations leave keyword arguments out

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from zstate.buffer.buffer import RECORDING_HISTORY_S, TransformBuffer
from zstate.checks import Floats
from zstate.cli.output.text_layout import Table
from zstate.errors import InvalidInput, LookupFailed, NoData, UnknownFrame
from zstate.model.joint_history import JointHistory
from zstate.model.urdf import parse_urdf
from zstate.odometry import BaseEstimator, BaseState, Datum, MapState, SourceHealth
from zstate.odometry.cli.delay import Delay, Motions
from zstate.odometry.cli.heard import recorded_names
from zstate.odometry.cli.reference import (
    Comparison,
    PlanarTrajectory,
    ReferenceName,
    compared,
    reference_trajectory,
)
from zstate.odometry.cli.settings_file import WHEEL_KINDS, OdometrySettings, others_text, table_name
from zstate.odometry.estimator import WHEELS
from zstate.odometry.fusion import STANDSTILL
from zstate.odometry.health import WINDOW
from zstate.odometry.messages import Fix, Odometry, Pose
from zstate.odometry.planar import in_plane, map_in_plane
from zstate.odometry.sensors import Estimators, add_imu
from zstate.recording.cli.plot import new_figure
from zstate.recording.recording import Recording
from zstate.streams import StreamName
from zstate.wire.keys import full_name
from zstate.wire.messages import RobotDescription

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HEALTH_NS = 500_000_000
"""Interval of the points of the NIS."""

_WIDTH = 80
"""The width of the table [letters]."""
_LEGEND = (
    "NIS: mean square of the innovations in sigmas, by number; 1 is right. sigma: the factor on the "
    "sigmas of the source that would make it so. delay: how much later its stamps are than those of the IMU, "
    "less its delay_s, where the motion shows it."
)
_NEAR = 1.5
"""Factors of sigmas between this and its inverse are right: real noise is not white."""

_LEAST_DELAY_S, _DELAY_SIGMAS = 0.01, 3.0
"""A delay is to be stated if it is longer [s], and than so many of its standard deviations."""

_UNSTEADY = 10.0
"""The 90 % quantile of the NIS over its median, if it was not noise that was wrong but a part of the run."""

_ELLIPSES = 40
_RADIUS_95 = math.sqrt(-2.0 * math.log(0.05))
"""The radius of an ellipse that has 95 % of a normal distribution in the plane, in standard deviations."""

_PATH, _PANEL = 6.0, 2.0
"""Heights of the path and of each source [inch]."""
_FEW_LABELS = 1000.0
"""The range of a logarithmic axis up to which 2 and 5 have labels as well."""

_REST_S = 5.0
"""A robot that was at rest at its start was found to stand by then: alignment takes 0.5 s of it."""

Event = tuple[int, bool, Callable[[], None]]
"""A stamp, whether it is that of a reading of the IMU, and what passes the data to the estimators."""


@dataclass
class ReplayedOdometry:
    """The odometry of a recording: states after each reading of the IMU, and the health of the sources.

    ``health`` is the last one, ``nis`` by source the points of those in between: seconds since the first
    state, mean NIS, and its band from low to high. ``delays`` are those of sources whose stamps the motion
    determines, less the stated ones, and ``fitting_delays`` the keys that would state the sum, where it is to
    be corrected [s]. ``sigmas`` are the medians of the standard deviations of velocities and poses: x y z
    [m/s], or x y z [m] and the rotation [rad]. ``in_map`` is the last state in the map with the origin
    ``datum``, if fixes gave one, and ``refused_jumps`` those of ``MapEstimator``.
    """

    base: str
    states: list[BaseState] = field(default_factory=list[BaseState])
    health: tuple[SourceHealth, ...] = ()
    nis: dict[str, list[tuple[float, float, float, float]]] = field(
        default_factory=dict[str, list[tuple[float, float, float, float]]]
    )
    delays: dict[str, Delay] = field(default_factory=dict[str, Delay])
    fitting_delays: dict[str, float] = field(default_factory=dict[str, float])
    sigmas: dict[str, Floats] = field(default_factory=dict[str, Floats])
    reference: Comparison | None = None
    in_map: MapState | None = None
    datum: Datum | None = None
    refused_jumps: dict[str, float] = field(default_factory=dict[str, float])

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


def replay(
    path: str, robot: str, settings: OdometrySettings, reference: ReferenceName | None = None
) -> ReplayedOdometry:
    """The odometry of ``robot`` in a recording, from all data in the order of its stamps.

    Without a state, ``ReplayedOdometry.states`` is empty. Raises RecordingError, and InvalidInput for unknown
    mounts, for a sensor or reference without messages, and for one without noise.
    """
    mounts, model = TransformBuffer(RECORDING_HISTORY_S), None
    if reference is not None and reference.stream == "pose" and reference.sensor in settings.pose:
        raise InvalidInput(f"{reference} is a source: it would judge itself; leave one of the two out")
    with Recording(path, robot) as recording:
        for _, message, _ in recording.fill(mounts):
            if isinstance(message, RobotDescription) and model is None:
                model = parse_urdf(message.urdf, f"the URDF of {robot!r}")
        readings = _messages(recording, robot, "imu", settings.imu)
        recorded = [(one, _messages(recording, robot, one.stream, one.writer)) for one in settings.sensors]
        joints = recording.joint_states(robot) if settings.has_joints else None
        truth = None if reference is None else _messages(recording, robot, reference.stream, reference.sensor)
    base = settings.base or (None if model is None else model.root)
    if base is None:
        raise InvalidInput(f"{path} has no model of {robot!r}, whose root would be the base; give --base")
    try:
        estimator = settings.estimator(robot, base, readings[0].frame, mounts, model)
        in_map = settings.map_estimator(robot, estimator, mounts)
    except LookupFailed as failure:
        is_empty = isinstance(failure, UnknownFrame) and not failure.frame_count
        raise InvalidInput(
            f"{path} does not have the mounts of the sensors of {robot!r}: "
            f"{'it has no model and no static transforms' if is_empty else failure}; record "
            "robot_description or tf_static with them (`zstate info` shows what it has)"
        ) from None
    estimators = Estimators(estimator, in_map)
    events: list[Event] = [(one.stamp, True, partial(add_imu, estimator, one)) for one in readings]
    motions = Motions(mounts, full_name(robot, base), readings)
    sigmas: dict[str, Floats] = {}
    delays: list[tuple[str, str, float, Delay | None]] = []
    """The name of a source, the key of its delay, what is stated [s], and that of its stamps."""
    for one, messages in recorded:
        covariances = [known for message in messages if (known := one.covariance(message)) is not None]
        if covariances:
            variances = [np.maximum(np.diag(known), 0.0) for known in covariances]  # -1 is not known
            sigmas[one.name] = np.sqrt(np.median(variances, axis=0))
        key, delay = f"[{table_name(one.kind, one.name)}] delay_s", motions.delay_of(one.kind, messages)
        delays.append((one.name, key, one.noise.delay_s, delay))
        events += [(message.stamp, False, partial(one.add, estimators, message)) for message in messages]
    if joints is not None:
        events += [
            (stamp, False, partial(_add_joints, estimator, joints, row))
            for row, stamp in enumerate(joints.stamps.tolist())
        ]
    events.sort(key=itemgetter(0))
    replayed = _run(estimators, base, events, planar=settings.planar)  # checks the joints of the wheels
    wheels = settings.wheels
    if joints is not None and wheels is not None:
        table = next(kind for kind in WHEEL_KINDS if getattr(settings, kind) is not None)
        delay = motions.delay(*motions.of_wheels(wheels, joints))
        delays.append((WHEELS, f"[{table}] noise.delay_s", wheels.noise.delay_s, delay))
    replayed.sigmas = sigmas
    for name, key, stated_s, delay in delays:
        if delay is not None:
            _add_delay(replayed, name, key, stated_s, delay)
    if reference is not None and truth is not None and replayed.states:
        replayed.reference = _against(reference, truth, replayed, mounts)
    return replayed


def _add_delay(replayed: ReplayedOdometry, name: str, key: str, stated_s: float, delay: Delay) -> None:
    """Add what is left of the delay of a source, and what ``key`` should be instead of ``stated_s``."""
    left_s = delay.delay_s - stated_s
    replayed.delays[name] = Delay(left_s, delay.sigma_s)
    if abs(left_s) > max(_LEAST_DELAY_S, _DELAY_SIGMAS * delay.sigma_s):
        replayed.fitting_delays[key] = delay.delay_s


def _messages(recording: Recording, robot: str, stream: StreamName, sensor: str) -> list[Any]:
    """The messages of one sensor, by their stamps; fixes without a position are none.

    Raises InvalidInput, with near misses, for a sensor without any.
    """
    messages = recording.sensor_messages(stream, robot, sensor)
    found = [one for one in messages if not isinstance(one, Fix) or one.status >= 0]
    if found:
        return sorted(found, key=attrgetter("stamp"))
    known = recorded_names(recording.info, robot, stream)
    raise InvalidInput(
        f"{recording.info.path} has no message on {stream}/{sensor} of {robot!r}{others_text(sensor, known)}"
    )


def _against(
    name: ReferenceName,
    messages: Sequence[Pose | Odometry],
    replayed: ReplayedOdometry,
    mounts: TransformBuffer,
) -> Comparison:
    """The comparison with a reference, at the frame that it measures."""
    states, first = replayed.states, messages[0]
    point = np.zeros(3)
    if isinstance(first, Pose) and first.child:
        point = mounts.lookup(states[0].odom_from_base.source, first.child).translation
    poses = [one.odom_from_base for one in states]
    odometry = PlanarTrajectory(
        np.array([one.stamp for one in states], dtype=np.int64),
        np.array([(pose.matrix[:3, :3] @ point + pose.translation)[:2] for pose in poses]),
        np.array([one.covariance.pose[:2, :2] for one in states]),
    )
    return compared(str(name), odometry, reference_trajectory(name, messages))


def _add_joints(base: BaseEstimator, joints: JointHistory, row: int) -> None:
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


def _run(estimators: Estimators, frame: str, events: Sequence[Event], *, planar: bool) -> ReplayedOdometry:
    base, in_map = estimators
    replayed = ReplayedOdometry(frame)
    due = 0
    for stamp, is_imu, add in events:
        add()
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
    if in_map is not None:
        replayed.health += in_map.health()
        replayed.datum = in_map.datum
        replayed.refused_jumps = in_map.refused_jumps()
        with suppress(NoData):
            replayed.in_map = in_map.state()
    if planar:
        replayed.states = list(map(in_plane, replayed.states))
        replayed.in_map = None if replayed.in_map is None else map_in_plane(replayed.in_map)
    return replayed


def report_lines(replayed: ReplayedOdometry) -> Iterator[str]:
    """The table of the sources, what to change of them, the path, its end, and the reference."""
    yield from source_table(replayed).lines(_WIDTH)
    yield _LEGEND
    yield from (f"would fit: {key} = {delay_s:.3f}" for key, delay_s in replayed.fitting_delays.items())
    yield from _sigma_lines(replayed)
    yield from (one.sentence for one in replayed.health if one.sentence)
    if sentence := _rest_text(replayed):
        yield sentence
    last = replayed.states[-1]
    x, y, z = last.odom_from_base.translation.tolist()
    sigmas = np.sqrt(np.diag(last.covariance.pose))
    yield (
        f"{replayed.way_m:.2f} m in {replayed.seconds[-1]:.1f} s; {replayed.base} ends at "
        f"x {x:.3f} m (sigma {sigmas[0]:.3f}), y {y:.3f} m ({sigmas[1]:.3f}), z {z:.3f} m ({sigmas[2]:.3f}), "
        f"yaw {math.degrees(last.odom_from_base.rpy[2]):.1f} deg ({math.degrees(sigmas[5]):.1f})"
    )
    yield from _map_lines(replayed)
    drift = float(np.hypot(sigmas[0], sigmas[1]))
    yield f"drift by its own claim: {drift:.3f} m{_part_text(drift, replayed.way_m)}"
    if replayed.reference is not None:
        yield from _reference_lines(replayed.reference, replayed.way_m)


def _map_lines(replayed: ReplayedOdometry) -> Iterator[str]:
    """Where the base ends in the map and on the Earth."""
    state, datum = replayed.in_map, replayed.datum
    if state is None or datum is None:
        return
    x, y, z = state.map_from_base.translation.tolist()
    sigmas = np.sqrt(np.diag(state.covariance))
    latitude, longitude, _ = datum.geodetic((x, y, z))
    yield (
        f"in {state.map_from_base.target!r}, x east and y north of {datum.latitude:.7f} "
        f"{datum.longitude:.7f}, it ends at x {x:.2f} m (sigma {sigmas[0]:.2f}), y {y:.2f} m "
        f"({sigmas[1]:.2f}), yaw {math.degrees(state.map_from_base.rpy[2]):.1f} deg "
        f"({math.degrees(sigmas[5]):.1f}): {latitude:.7f} {longitude:.7f}"
    )
    yield from jump_lines(replayed.refused_jumps)


def jump_lines(refused_jumps: Mapping[str, float]) -> Iterator[str]:
    """From which jump on the fixes of each receiver are refused."""
    for name, jump in refused_jumps.items():
        yield f"{name}: at its last fix, one that jumps by more than {jump:.2g} m would be refused"


def source_table(replayed: ReplayedOdometry) -> Table:
    """A row for each source."""
    rows = [
        (
            one.name,
            f"{one.rate_hz:.1f}",
            str(one.accepted) if one.dimension else "-",
            str(one.rejected) if one.dimension else "-",
            str(one.too_late),
            "-" if factor is None else f"{factor**2:.2f}",
            "-" if factor is None else f"x {factor:.2f}",
            _delay_text(replayed.delays.get(one.name)),
        )
        for one in replayed.health
        for factor in (sigma_factor(replayed, one),)
    ]
    headings = ("source", "rate [Hz]", "used", "rejected", "too late", "NIS", "sigma", "delay [ms]")
    return Table(headings, rows, optional=("too late", "rate [Hz]"))


def sigma_factor(replayed: ReplayedOdometry, health: SourceHealth) -> float | None:
    """By what the sigmas of a source have to be multiplied for a NIS of 1 a number; None without a NIS.

    It is that of the median of the means, so that a fault for a part of the run does not count.
    """
    means = [mean for _, mean, _, _ in replayed.nis.get(health.name, ())]
    if not means or not health.dimension:
        return None
    return math.sqrt(float(np.median(means)) / health.dimension)


def _delay_text(delay: Delay | None) -> str:
    if delay is None:
        return "-"
    return f"{round(1e3 * delay.delay_s)} +- {max(1, round(1e3 * delay.sigma_s))}"


def _sigma_lines(replayed: ReplayedOdometry) -> Iterator[str]:
    """The sigmas to state for sources of velocities and poses whose NIS is far from right.

    None if the NIS is not steady: what contradicts for a part of the run, as a lost estimate, is no noise.
    """
    for one in replayed.health:
        factor, sigmas = sigma_factor(replayed, one), replayed.sigmas.get(one.name)
        if factor is None or sigmas is None or 1.0 / _NEAR < factor < _NEAR:
            continue
        means = [mean for _, mean, _, _ in replayed.nis[one.name]]
        if np.quantile(means, 0.9) > _UNSTEADY * np.median(means):
            continue
        fitting = factor * sigmas
        fitting = np.where(fitting > 0.0, fitting, fitting.max())  # others are not used
        metres = ", ".join(f"{value:.2g}" for value in fitting[:3])
        if len(fitting) == 3:
            yield f"would fit: [velocity.{one.name}] sigma = [{metres}]"
        elif len(fitting) == 6:
            degrees = ", ".join(f"{math.degrees(value):.2g}" for value in fitting[3:])
            yield f"would fit: [pose.{one.name}] sigma = [{metres}], sigma_deg = [{degrees}]"


def _part_text(error_m: float, way_m: float) -> str:
    return f", {100.0 * error_m / way_m:.1f} % of the way" if way_m > 0.0 else ""


def _reference_lines(found: Comparison, way_m: float) -> Iterator[str]:
    yield (
        f"against {found.count} readings of {found.name}: ATE {found.ate_m:.3f} m, error at the end "
        f"{found.end_m:.3f} m{_part_text(found.end_m, way_m)}"
    )
    if found.nees is None or found.end_sigmas is None:
        yield f"errors in sigmas need the noise of the reference: --reference {found.name}:sigma=METRES"
        return
    yield (
        f"error at the end {found.end_sigmas:.1f} sigma (95 % are below 2.4); NEES of x y {found.nees:.2f} "
        "(2 is right; above it, the odometry claims too much)"
    )


def _rest_text(replayed: ReplayedOdometry) -> str:
    """Why the yaw is uncertain, if the robot did not stand at the start; empty if it did."""
    stood = replayed.nis.get(STANDSTILL)
    first_s = stood[0][0] if stood else math.inf
    if first_s <= _REST_S:
        return ""
    found = f"it was first found to stand after {first_s:.1f} s" if stood else "it was never found to stand"
    return (
        f"no rest at the start: {found}, so the bias of its gyro is not known, and the sigma of "
        "the yaw grows; begin a recording with 3 s at rest"
    )


def health_text(health: SourceHealth) -> str:
    """One source on one line, as at the end of live odometry."""
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
    if replayed.reference is not None:
        found = replayed.reference
        panel.plot(*found.positions.T, ".", color="tab:orange", markersize=3.0, label=found.name)
    panel.plot(x[:1], y[:1], "o", color="tab:green", label="first")
    panel.plot(x[-1:], y[-1:], "s", color="tab:red", label="last")
    panel.set(xlabel="x [m]", ylabel="y [m]")
    panel.set_title(f"{replayed.base} in the frame of the odometry, from above", fontsize="medium")
    panel.set_aspect("equal", adjustable="datalim")
    panel.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    panel.grid(visible=True, alpha=0.3)
