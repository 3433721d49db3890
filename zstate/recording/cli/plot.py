"""zstate plot: joint positions, or the path of a frame, over time, from live data or a recording."""

# pyright: reportUnknownMemberType=false
# Matplotlib's annotations leave keyword arguments out

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from zstate._util.format import did_you_mean
from zstate.cli import options
from zstate.cli.output.console import count_text, fail, print_status, print_wrapped
from zstate.cli.output.wire_text import default_stream, messages_for
from zstate.cli.robot_directory import RobotDirectory, only_robot
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput, LibraryMissing

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from zstate.buffer.buffer import TransformBuffer
    from zstate.cli.output.joint_state_text import Document
    from zstate.cli.stream_reader import TimedSample
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session

_LOG = logging.getLogger("zstate")
_FORMATS = (".png", ".svg", ".pdf")
_WAIT_S, _LIVE_S = 10.0, 5.0
_MIN_POSES, _MAX_POSES, _POSES_PER_S = 200, 5000, 200
# Joint types whose position is one length or one angle.
_UNITS = {"revolute": "rad", "continuous": "rad", "prismatic": "m"}
# Stamps before 1973 are those of a simulation or a log.
_NO_DATE_NS = 10**17

_WIDTH, _HEIGHT, _PANEL = 10.0, 4.5, 3.2
_LABELS = {"rad": "position [rad]", "m": "position [m]", "": "position"}
_LEGEND_ROWS, _COLORS = 16, 10
_STYLES = ("solid", "dashed", "dotted", "dashdot")


def plot_file(file: str) -> Path:
    """The file of a figure. Raises InvalidInput for other formats."""
    if Path(file).suffix.lower() not in _FORMATS:
        raise InvalidInput(f"{file!r} ends with none of {', '.join(_FORMATS)}")
    return Path(file)


@click.command("plot")
@click.argument("robot", required=False)
@click.option("--joint", "joints", multiple=True, metavar="NAME", help="Only this joint; may be repeated.")
@click.option("--path", "frames", nargs=2, metavar="A B", help="The path of frame B in frame A instead.")
@click.option("--file", metavar="RECORDING", help="From a recording, or a window of an archive.")
@click.option("--start", type=options.SECONDS, help="Where to start in a recording [s]; default: 0.")
@click.option(
    "--seconds", type=options.SECONDS, metavar="N", help="Duration [s]; default: 5, or the whole recording."
)
@click.option(
    "--output",
    type=options.Checked("FILE", plot_file),
    help="PNG, SVG or PDF; default: ROBOT.png or B.png.",
)
@options.window_options
@options.placer_option
@options.wire_option
@options.session_options
def plot_command(
    *,
    network: SessionOptions,
    robot: str | None,
    joints: tuple[str, ...],
    frames: tuple[str, str] | None,
    file: str | None,
    start: float | None,
    seconds: float | None,
    output: Path | None,
    window: tuple[int, int] | None,
    placers: tuple[str, ...] | None,
    wire: str,
) -> None:
    """Draw the joint positions of ROBOT over time, or the path of a frame, into a file.

    Plots live data of the next seconds, or a recording. ROBOT may be left out if there is only one robot.
    Needs Matplotlib: pip install 'zstate[plot]'.

    \b
    zstate plot panda                                  # panda.png
    zstate plot panda --joint panda_joint1 --seconds 20 --output joint1.svg
    zstate plot --path panda_link0 panda_hand          # panda_hand.png
    zstate plot --file run.mcap --start 60 --seconds 10
    zstate plot robot17 --file s3://plant/fleet --at 2026-11-20T14:03    # a minute of an archive
    """
    new_figure("", 1.0)  # reports a missing Matplotlib before it collects data
    if joints and frames:
        raise click.UsageError("--joint and --path exclude each other: they are different plots")
    if file is None and (start is not None or window is not None):
        raise click.UsageError("--start, --at, --from and --to need --file RECORDING")
    if placers is not None and (file is not None or not frames):
        raise click.UsageError("--placer is for --path A B of live robots")
    if file is not None:
        from zstate.recording.recording import Recording
        from zstate.recording.stores import opened_path

        name, start_s = robot or Path(file).stem, start or 0.0
        with opened_path(file, robot, window) as opened:
            if frames:
                with Recording(opened.path, robot) as recording:
                    series = path_series(recording.buffer(), *frames, start_s=start_s, seconds=seconds)
            else:
                series = _recorded_joints(opened.path, robot, start_s, seconds)
    else:
        with open_session(network, (wire,)) as session:
            name = robot or messages_for(wire).robot or ("*" if frames else only_robot(session))
            if frames:
                series = _live_path(session, name, wire, frames, seconds or _LIVE_S, placers=placers)
            else:
                series = _live_joints(session, name, wire, seconds or _LIVE_S)
    series = series.select(joints)
    if len(series.stamps) < 2:
        fail("fewer than two samples arrived, so there is no curve; use a longer --seconds")
    path = output or Path(f"{(frames[1] if frames else name).replace('/', '_')}.png")
    if frames:
        figure = _path_figure(series, f"{frames[1]} in {frames[0]}")
    else:
        figure = _joint_figure(series, f"{name}: joint positions")
    save_figure(figure, path)
    content = "the path" if frames else count_text(len(series.names), "curve")
    samples = count_text(len(series.stamps), "sample")
    print_wrapped(f"wrote {path}: {content}, {samples} in {series.seconds[-1]:.1f} s")


def save_figure(figure: Figure, path: Path) -> None:
    """Write ``figure`` to a file. Raises InvalidInput if that cannot be written."""
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise InvalidInput(f"cannot write {str(path)!r}: {error.strerror or error}") from None


@dataclass(frozen=True)
class TimeSeries:
    """Column i of ``values`` (T, n) is called ``names[i]`` and has the unit ``units[i]``, "" if they differ.

    ``stamps`` [ns] ascend, (T,); a missing value is NaN.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    stamps: NDArray[np.int64]
    values: NDArray[np.float64]

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time since the first stamp [s]."""
        return (self.stamps - self.stamps[0]) * 1e-9

    def with_unit(self, unit: str) -> TimeSeries:
        """The columns with this unit."""
        return self._columns([column for column, one in enumerate(self.units) if one == unit])

    def select(self, joints: Sequence[str]) -> TimeSeries:
        """The columns of these joints, in that order; all for none. Raises InvalidInput if one is unknown."""
        columns: list[int] = []
        for joint in joints:
            found = [n for n, name in enumerate(self.names) if name == joint or name.startswith(f"{joint}.")]
            if not found:
                hint, known = did_you_mean(joint, self.names), ", ".join(self.names)
                raise InvalidInput(f"this robot has no joint {joint!r}{hint} (joints: {known})")
            columns += found
        return self._columns(columns) if joints else self

    def _columns(self, columns: Sequence[int]) -> TimeSeries:
        names = tuple(self.names[column] for column in columns)
        units = tuple(self.units[column] for column in columns)
        return replace(self, names=names, units=units, values=self.values[:, list(columns)])


def joint_series(documents: Sequence[Document], model: RobotModel | None) -> TimeSeries:
    """The positions of at least one document, sorted by stamp."""
    import numpy as np

    from zstate.cli.output.joint_state_text import flatten

    rows = [(cast(int, document["stamp"]), flatten(document["positions"])) for document in documents]
    rows.sort(key=lambda row: row[0])
    names = tuple(dict.fromkeys(name for _, row in rows for name in row))
    values = np.array([[row.get(name, np.nan) for name in names] for _, row in rows])
    types = {} if model is None else {joint.name: joint.type for joint in model.joints}
    units = tuple(_UNITS.get(types.get(name, "revolute" if model is None else ""), "") for name in names)
    return TimeSeries(names, units, np.array([stamp for stamp, _ in rows], dtype=np.int64), values)


def path_series(
    buffer: TransformBuffer, target: str, source: str, *, start_s: float = 0.0, seconds: float | None = None
) -> TimeSeries:
    """The translation of ``source`` in ``target`` over the history of ``buffer``.

    Begins ``start_s`` after the first instant and lasts ``seconds``, or to the end. Raises LookupFailed, and
    InvalidInput if nothing is left.
    """
    import numpy as np

    newest = buffer.latest(target, source)
    edges = [edge for _, edge in buffer.path_frames(target, source)]
    # The first instant that every moving edge of the path covers.
    oldest = max((edge.oldest for edge in edges if edge and edge.oldest is not None), default=newest)
    begin = oldest + round(start_s * 1e9)
    end = newest if seconds is None else min(newest, begin + round(seconds * 1e9))
    if end <= begin:
        length_s = (newest - oldest) * 1e-9
        raise InvalidInput(
            f"{source!r} in {target!r} covers {length_s:.3f} s; nothing is left after the first {start_s:g} s"
        )
    count = int(np.clip((end - begin) * 1e-9 * _POSES_PER_S, _MIN_POSES, _MAX_POSES))
    stamps = np.linspace(begin, end, count).astype(np.int64)
    poses, valid = buffer.lookup_many(target, source, stamps)
    return TimeSeries(("x", "y", "z"), ("m", "m", "m"), stamps[valid], poses[valid, :3])


def _live_joints(session: Session, robot: str, wire: str, seconds: float) -> TimeSeries:
    """The joints of ``robot`` for ``seconds`` from now on. Fails if no sample arrives within 10 s."""
    from zstate.cli.output.joint_state_text import DescribedJointStates
    from zstate.cli.stream_reader import StreamReader
    from zstate.wire.messages import JointState

    with (
        DescribedJointStates(session, robot, wire) as states,
        StreamReader(session, robot, "joint_states", wire) as reader,
    ):
        documents: list[Document] = []

        def add(timed: TimedSample | None) -> None:
            if timed is not None and isinstance(timed.sample, JointState):
                documents.append(states.document(timed.sample))

        add(reader.first(_WAIT_S))
        print_status(f"listening to {robot} for {seconds:g} s ...")
        deadline = time.monotonic() + seconds
        while (left_s := deadline - time.monotonic()) > 0.0:
            add(reader.next(left_s))
        return joint_series(documents, states.model)


def _live_path(
    session: Session,
    robot: str,
    wire: str,
    frames: tuple[str, str],
    seconds: float,
    *,
    placers: tuple[str, ...] | None,
) -> TimeSeries:
    """The path of frame B in frame A for ``seconds`` from now on. Fails if no pose is known within 10 s."""
    from zstate.cli.waiting import PoseWaiter
    from zstate.clock import wait_interruptible
    from zstate.nodes.listener import TransformListener

    follow, history_s = default_stream(wire), seconds + 1.0
    with (
        RobotDirectory(session, robot, wire) as directory,
        TransformListener(
            session,
            robot,
            wire=wire,
            follow=follow,
            history_s=history_s,
            history_on_join=False,
            placers=placers,
        ) as listener,
    ):
        PoseWaiter(listener, directory, *frames).wait(timeout_s=_WAIT_S)
        print_status(f"listening for {seconds:g} s ...")
        wait_interruptible(threading.Event(), seconds)
        return path_series(listener.buffer, *frames)


def _recorded_joints(path: Path, robot: str | None, start_s: float, seconds: float | None) -> TimeSeries:
    """The joints of ``robot``, or of the only robot, in a recording. Raises RecordingError, InvalidInput."""
    from zstate.cli.output.joint_state_text import JointStateFormatter
    from zstate.recording.decode import (
        DecodedRecording,
        check_has_robot,
        first_descriptions,
        robot_with_joint_states,
    )
    from zstate.recording.reader import RecordingReader
    from zstate.wire.messages import JointState, RobotDescription

    with RecordingReader(path) as reader:
        decoded = DecodedRecording(reader, partial(_LOG.warning, "left out (%s): %s"))
        name = robot_with_joint_states(decoded, None) if robot is None else check_has_robot(decoded, robot)
        formatter = JointStateFormatter()
        for described in first_descriptions(decoded, (name,)).values():
            if isinstance(described.message, RobotDescription):
                formatter.set_description(described.message)
        first, _ = reader.span or (0, 0)
        begin = first + round(start_s * 1e9)
        end = None if seconds is None else begin + round(seconds * 1e9)
        documents = [
            formatter.document(one.message)
            for one in decoded.messages((name,), ("joint_states",), begin, end)
            if isinstance(one.message, JointState)
        ]
    if not documents:
        fail(f"{path}: no joint state of {name!r}{' in that time' if start_s or seconds else ''}")
    return joint_series(documents, formatter.model)


def new_figure(title: str, height: float) -> Figure:
    """An empty figure, ``height`` [inch]. Raises LibraryMissing without Matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise LibraryMissing(
            f"plots need Matplotlib, which cannot be loaded ({error}): pip install 'zstate[plot]'"
        ) from None
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    figure.suptitle(title, fontweight="bold")
    return figure


def _joint_figure(series: TimeSeries, title: str) -> Figure:
    """Each joint over time, with a panel for each unit."""
    units = [unit for unit in _LABELS if unit in series.units]
    figure = new_figure(title, _HEIGHT if len(units) == 1 else _PANEL * len(units))
    panels = cast("list[Axes]", figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0].tolist())
    for unit, panel in zip(units, panels, strict=True):
        _plot(panel, series.with_unit(unit), _LABELS[unit])
    panels[-1].set_xlabel(_time_label(series))
    return figure


def _path_figure(series: TimeSeries, title: str) -> Figure:
    """The three coordinates over time, and the path seen from above."""
    figure = new_figure(title, _HEIGHT)
    over_time, above = cast("tuple[Axes, Axes]", tuple(figure.subplots(1, 2, width_ratios=[3, 2])))
    _plot(over_time, series, _LABELS["m"])
    over_time.set_xlabel(_time_label(series))
    x, y = series.values[:, 0], series.values[:, 1]
    above.plot(x, y, color="0.4", linewidth=1.0)
    above.plot(x[:1], y[:1], "o", color="tab:green", label="first")
    above.plot(x[-1:], y[-1:], "s", color="tab:red", label="last")
    above.set_title("from above", fontsize="medium")
    above.set(xlabel="x [m]", ylabel="y [m]")
    above.set_aspect("equal", adjustable="datalim")
    above.legend(fontsize="small")
    above.grid(visible=True, alpha=0.3)
    return figure


def _plot(panel: Axes, series: TimeSeries, label: str) -> None:
    for number, name in enumerate(series.names):
        panel.plot(
            series.seconds,
            series.values[:, number],
            label=name,
            color=f"C{number % _COLORS}",
            linestyle=_STYLES[number // _COLORS % len(_STYLES)],
            linewidth=1.3,
        )
    panel.set_ylabel(label)
    panel.grid(visible=True, alpha=0.3)
    panel.margins(x=0.01)
    columns = -(-len(series.names) // _LEGEND_ROWS)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", ncols=columns, frameon=False)


def _time_label(series: TimeSeries) -> str:
    first = int(series.stamps[0])
    if first < _NO_DATE_NS:
        return f"time since {first * 1e-9:.3f} s [s]"
    start = datetime.fromtimestamp(first // 1_000_000_000).astimezone()
    return f"time since {start:%Y-%m-%d %H:%M:%S %Z} [s]"
