"""Plots of joint positions or of a frame's path over time, from live data or a recording."""

# pyright: reportUnknownMemberType=false
# Matplotlib's annotations leave keyword arguments out

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from zstate._util.format import did_you_mean
from zstate.cli.output.console import fail, print_status
from zstate.cli.output.joint_state_text import DescribedJointStates, Document, JointStateFormatter, flatten
from zstate.cli.output.wire_text import default_stream
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.stream_reader import StreamReader
from zstate.cli.waiting import PoseWaiter
from zstate.errors import InvalidInput, LibraryMissing
from zstate.nodes.listener import TransformListener
from zstate.recording.decode import DecodedRecording, check_has_robot, first_descriptions
from zstate.recording.reader import RecordingReader
from zstate.recording.recording import Recording
from zstate.wire.messages import JointState, RobotDescription

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from zstate.buffer.buffer import TransformBuffer
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session

_LOG = logging.getLogger("zstate")
_WAIT_S = 10.0
_MIN_POSES, _MAX_POSES, _POSES_PER_S = 200, 5000, 200
# Joint types whose position is one length or one angle.
_UNITS = {"revolute": "rad", "continuous": "rad", "prismatic": "m"}
# Stamps before 1973 are those of a simulation or a log.
_NO_DATE_NS = 10**17

_WIDTH, _HEIGHT, _PANEL = 10.0, 4.5, 3.2
_LABELS = {"rad": "position [rad]", "m": "position [m]", "": "position"}
_LEGEND_ROWS, _COLORS = 16, 10
_STYLES = ("solid", "dashed", "dotted", "dashdot")


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
                hint = did_you_mean(joint, self.names)
                raise InvalidInput(
                    f"this robot has no joint {joint!r}{hint} (joints: {', '.join(self.names)})"
                )
            columns += found
        return self._columns(columns) if joints else self

    def _columns(self, columns: Sequence[int]) -> TimeSeries:
        names = tuple(self.names[column] for column in columns)
        units = tuple(self.units[column] for column in columns)
        return replace(self, names=names, units=units, values=self.values[:, list(columns)])


def joint_series(documents: Sequence[Document], model: RobotModel | None) -> TimeSeries:
    """The positions of at least one document, sorted by stamp."""
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


def live_joints(session: Session, robot: str, wire: str, seconds: float) -> TimeSeries:
    """The joints of ``robot`` for ``seconds`` from now on. Fails if no sample arrives within 10 s."""
    with (
        DescribedJointStates(session, robot, wire) as states,
        StreamReader(session, robot, "joint_states", wire) as reader,
    ):
        samples = [reader.first(_WAIT_S).sample]
        documents = [states.document(sample) for sample in samples if isinstance(sample, JointState)]
        print_status(f"listening to {robot} for {seconds:g} s ...")
        deadline = time.monotonic() + seconds
        while (left_s := deadline - time.monotonic()) > 0.0:
            timed = reader.next(left_s)
            if timed is not None and isinstance(timed.sample, JointState):
                documents.append(states.document(timed.sample))
        return joint_series(documents, states.model)


def live_path(session: Session, robot: str, wire: str, frames: tuple[str, str], seconds: float) -> TimeSeries:
    """The path of frame B in frame A for ``seconds`` from now on. Fails if no pose is known within 10 s."""
    with (
        RobotDirectory(session, robot, wire) as directory,
        TransformListener(
            session,
            robot,
            wire=wire,
            follow=default_stream(wire),
            history_s=seconds + 1.0,
            history_on_join=False,
        ) as listener,
    ):
        PoseWaiter(listener, directory, *frames).wait(timeout_s=_WAIT_S)
        print_status(f"listening for {seconds:g} s ...")
        time.sleep(seconds)
        return path_series(listener.buffer, *frames)


def recorded_joints(path: str, robot: str | None, start_s: float, seconds: float | None) -> TimeSeries:
    """The joints of ``robot``, or of the only robot, in a recording. Raises RecordingError, InvalidInput."""
    with RecordingReader(path) as reader:
        decoded = DecodedRecording(
            reader, lambda reason, text: _LOG.warning("left out (%s): %s", reason, text)
        )
        robots = decoded.robots
        if robot is None and len(robots) != 1:
            content = f"robots {', '.join(robots)}: name one of them" if robots else "no robot"
            fail(f"the recording has {content}")
        name = robots[0] if robot is None else check_has_robot(decoded, robot)
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


def recorded_path(
    path: str, robot: str | None, frames: tuple[str, str], start_s: float, seconds: float | None
) -> TimeSeries:
    """The path of frame B in frame A in a recording. Raises RecordingError, InvalidInput, LookupFailed."""
    with Recording(path, robot) as recording:
        return path_series(recording.buffer(), *frames, start_s=start_s, seconds=seconds)


def new_figure(title: str, height: float) -> Figure:
    """An empty figure. Raises LibraryMissing without Matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise LibraryMissing(
            f"plots need Matplotlib, which cannot be loaded ({error}): pip install 'zstate[plot]'"
        ) from None
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    figure.suptitle(title, fontweight="bold")
    return figure


def draw_joints(series: TimeSeries, title: str, path: Path) -> None:
    """Draw each joint over time into ``path``, with a panel for each unit."""
    units = [unit for unit in _LABELS if unit in series.units]
    figure = new_figure(title, _HEIGHT if len(units) == 1 else _PANEL * len(units))
    panels = cast("list[Axes]", figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0].tolist())
    for unit, panel in zip(units, panels, strict=True):
        _plot(panel, series.with_unit(unit))
        panel.set_ylabel(_LABELS[unit])
    panels[-1].set_xlabel(_time_label(series))
    _save(figure, path)


def draw_path(series: TimeSeries, title: str, path: Path) -> None:
    """Draw the three coordinates over time, and the path seen from above, into ``path``."""
    figure = new_figure(title, _HEIGHT)
    over_time, above = cast("tuple[Axes, Axes]", tuple(figure.subplots(1, 2, width_ratios=[3, 2])))
    _plot(over_time, series)
    over_time.set_xlabel(_time_label(series))
    over_time.set_ylabel(_LABELS["m"])
    x, y = series.values[:, 0], series.values[:, 1]
    above.plot(x, y, color="0.4", linewidth=1.0)
    above.plot(x[:1], y[:1], "o", color="tab:green", label="first")
    above.plot(x[-1:], y[-1:], "s", color="tab:red", label="last")
    above.set_title("from above", fontsize="medium")
    above.set_xlabel("x [m]")
    above.set_ylabel("y [m]")
    above.set_aspect("equal", adjustable="datalim")
    above.legend(fontsize="small")
    above.grid(visible=True, alpha=0.3)
    _save(figure, path)


def _plot(panel: Axes, series: TimeSeries) -> None:
    for number, name in enumerate(series.names):
        panel.plot(
            series.seconds,
            series.values[:, number],
            label=name,
            color=f"C{number % _COLORS}",
            linestyle=_STYLES[number // _COLORS % len(_STYLES)],
            linewidth=1.3,
        )
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


def _save(figure: Figure, path: Path) -> None:
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise InvalidInput(f"cannot write {str(path)!r}: {error.strerror or error}") from None
