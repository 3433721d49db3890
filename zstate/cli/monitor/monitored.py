"""Monitored: what is watched, every edge that is heard or the edges on the way to one pose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NoReturn

from zstate.buffer.frame_tree import FrameInfo
from zstate.cli.monitor.meter import EdgeStatistics
from zstate.cli.monitor.overview import overview_text
from zstate.cli.monitor.path import path_between
from zstate.cli.monitor.report import Row, report_text
from zstate.cli.output.console import (
    fail,
    keep_showing,
    output_width,
    print_json,
    print_result,
    terminal_width,
)
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.waiting import ConditionWaiter, PoseWaiter
from zstate.errors import duration_text
from zstate.nodes.listener import TransformListener
from zstate.transform import Transform


class Monitored(ABC):
    """Edges that are heard, and what is measured of them."""

    def __init__(self, listener: TransformListener, meter: EdgeStatistics) -> None:
        self._listener = listener
        self._meter = meter

    @abstractmethod
    def wait(self, timeout_s: float | None) -> None:
        """Until there is something to report; says what it waits for, and fails after ``timeout_s``."""

    @abstractmethod
    def _facts(self) -> dict[str, Any]: ...

    @abstractmethod
    def _text(self, width: int | None) -> str: ...

    def say(self, *, as_json: bool) -> None:
        """One report."""
        if as_json:
            print_json(self._facts())
        else:
            print_result(f"{self._text(output_width())}\n")

    def show(self) -> NoReturn:
        """A report that keeps up to date."""
        keep_showing(lambda: self._text(terminal_width()))

    def _row(self, frame: str, edge: FrameInfo) -> Row:
        ask = self._listener.buffer.clock_offsets.get(edge.writer or "")
        return Row(frame, edge, self._meter.measure(edge), None if ask is None else ask())


class MonitoredEdges(Monitored):
    """All edges."""

    def __init__(self, listener: TransformListener, meter: EdgeStatistics, roster: RobotDirectory) -> None:
        super().__init__(listener, meter)
        self._roster = roster

    def wait(self, timeout_s: float | None) -> None:
        waiter = ConditionWaiter()
        self._listener.add_observer(waiter.notify)
        if not waiter.wait_for(self._rows, timeout_s, self._reason):
            fail(f"gave up after {timeout_s:g} s: {self._reason()}")

    def _reason(self) -> str:
        roster = self._roster
        return roster.words.lacking(self._listener.robot, "robot_description", roster.robots(), heard=False)

    def _rows(self) -> list[Row]:
        frames = self._listener.buffer.frames()
        return [self._row(frame.name, frame) for frame in frames if frame.parent is not None]

    def _text(self, width: int | None) -> str:
        return self._roster.words.explained(overview_text(self._rows(), width=width))

    def _facts(self) -> dict[str, Any]:
        return {"edges": [row.facts() for row in self._rows()]}


class MonitoredPose(Monitored):
    """One pose, and the edges on its path."""

    def __init__(
        self,
        listener: TransformListener,
        meter: EdgeStatistics,
        roster: RobotDirectory,
        frames: tuple[str, str],
    ) -> None:
        super().__init__(listener, meter)
        self._target, self._source = frames
        self._awaited = PoseWaiter(listener, roster, *frames)

    def wait(self, timeout_s: float | None) -> None:
        self._awaited.answer(timeout_s=timeout_s)

    def _rows(self) -> list[Row]:
        begin, legs = path_between(self._listener.buffer.frames(), self._target, self._source)
        return [Row(begin, None, None, None), *(self._row(leg.frame, leg.edge) for leg in legs)]

    def _text(self, width: int | None) -> str:
        head = f"pose of {self._source} in {self._target}: {self._newest(self._awaited.answer())}"
        return self._awaited.explained(f"{head}\n{report_text(self._rows(), width=width)}")

    def _newest(self, transform: Transform) -> str:
        if transform.stamp is None:
            return "at any time (static)"
        age_s = self._awaited.age_s(transform)
        return "there" if age_s is None else f"the newest is {duration_text(round(age_s * 1e9))} old"

    def _facts(self) -> dict[str, Any]:
        transform = self._awaited.answer()
        return {
            "target": self._target,
            "source": self._source,
            "stamp": transform.stamp,
            "age_s": self._awaited.age_s(transform),
            "edges": [facts for row in self._rows() if (facts := row.facts()) is not None],
        }
