"""Output of `zstate demo`: a live table on a terminal, one line per second otherwise."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from math import degrees
from typing import TYPE_CHECKING, NamedTuple

from zstate.cli.output.console import (
    count_text,
    duration_or_dash,
    is_terminal,
    print_result,
    rate_text,
    terminal_width,
)
from zstate.clock import wait_interruptible
from zstate.errors import LookupFailed, format_duration
from zstate.metrics.buffer import MeteredBuffer
from zstate.nodes.listener import TransformListener

if TYPE_CHECKING:
    from rich.table import Table

    from zstate.transform import Transform

_REFRESH_S = 0.1
# Rate and latency shown are those of the last second.
_RECENT_NS = 1_000_000_000
# The least terminal width that has room for angles.
_WIDTH_WITH_ANGLES = 72


class _TransformRow(NamedTuple):
    """One transform and its age [ns]."""

    transform: Transform
    age: int


class DemoTable:
    """A few transforms of ``robot`` with their rate, latency and age."""

    def __init__(
        self, listener: TransformListener, buffer: MeteredBuffer, robot: str, root: str, links: Sequence[str]
    ) -> None:
        self._listener = listener
        self._buffer = buffer
        self._statistics = buffer.statistics_of(robot)
        self._robot = robot
        self._root = root
        self._links = links
        self._begun = time.monotonic_ns(), self._statistics.count

    def show(self, ended: threading.Event, seconds: float | None) -> None:
        """Update until ``ended`` is set, or for ``seconds``."""
        from rich.live import Live

        until = float("inf") if seconds is None else time.monotonic() + seconds
        if not is_terminal():
            while not _is_over(ended, until, 1.0):
                print_result(self.line())
            return
        with Live(self.table(), auto_refresh=False) as live:
            while not _is_over(ended, until, _REFRESH_S):
                live.update(self.table(), refresh=True)

    def summary(self) -> str:
        """What was received since the beginning."""
        stats, (began, before) = self._listener.stats, self._begun
        count, now = self._statistics.count - before, time.monotonic_ns()
        seconds = (now - began) * 1e-9
        return (
            # With as many digits as agree: so many samples in so long make that rate.
            f"{count_text(count, 'sample')} received in {seconds:.2f} s: {count / seconds:.1f} Hz, "
            f"{stats.missed + stats.dropped} missed, median latency {self._latency(now - began)}"
        )

    @property
    def _freshness(self) -> str:
        window = self._statistics.recent(_RECENT_NS)
        rate_hz = None if window is None else window.rate_hz
        rate = "silent" if self._statistics.is_stale() else rate_text(rate_hz)
        return f"{rate}, {self._latency(_RECENT_NS)}"

    def _latency(self, within_ns: int) -> str:
        latency_s = self._buffer.measure(self._robot, within_ns).latency_s
        text = duration_or_dash(None if latency_s is None else round(latency_s * 1e9))
        return f"{text} from stamp to lookup"

    def rows(self) -> list[_TransformRow]:
        """The transforms now, without those that cannot be looked up yet."""
        rows: list[_TransformRow] = []
        for link in self._links:
            try:
                transform = self._buffer.lookup(f"{self._robot}/{self._root}", f"{self._robot}/{link}")
            except LookupFailed:
                continue
            assert transform.stamp is not None
            rows.append(_TransformRow(transform, time.time_ns() - transform.stamp))
        return rows

    def table(self) -> Table:
        """The transforms for a terminal."""
        from rich import box
        from rich.table import Table

        # At most 80 columns; figures for all rows are in the caption.
        table = Table(
            box=box.SIMPLE_HEAD,
            pad_edge=False,
            caption=self._freshness,
            caption_style="",
            caption_justify="left",
        )
        table.add_column(f"pose in {self._root}", style="bold", overflow="fold")
        with_angles = terminal_width() >= _WIDTH_WITH_ANGLES
        angles = (r"roll   pitch  yaw \[deg]",) if with_angles else ()
        for title in (r"x       y       z \[m]", *angles, "age"):
            table.add_column(title, justify="right", no_wrap=True)
        for row in self.rows():
            xyz = " ".join(f"{value:7.3f}" for value in row.transform.translation)
            rpy = (" ".join(f"{degrees(angle):6.1f}" for angle in row.transform.rpy),) if with_angles else ()
            table.add_row(_link(row), xyz, *rpy, format_duration(row.age))
        return table

    def line(self) -> str:
        """The first transform on one line."""
        text = self._freshness
        for row in self.rows()[:1]:
            # Adding zero turns -0 into 0.
            xyz = ", ".join(f"{round(value, 3) + 0.0:.3f}" for value in row.transform.translation.tolist())
            rpy = ", ".join(f"{round(degrees(angle), 1) + 0.0:.1f}" for angle in row.transform.rpy)
            text += f"; {_link(row)} in {self._root}: xyz [{xyz}] m, rpy [{rpy}] deg"
        return text


def _link(row: _TransformRow) -> str:
    return row.transform.source.partition("/")[2]


def _is_over(ended: threading.Event, until: float, pause_s: float) -> bool:
    """Wait ``pause_s``, then return whether the table has ended."""
    pause_s = min(pause_s, max(0.0, until - time.monotonic()))
    return wait_interruptible(ended, pause_s) or time.monotonic() >= until
