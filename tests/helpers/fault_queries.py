"""Queries that a reader of the fault suite replies to."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from zstate import SineSource, TransformListener, ZStateError, load_model
from zstate.errors import Stale
from zstate.model.kinematics import Kinematics
from zstate.transform import Transform

MAX_AGE_S = 0.5
"""The age limit of a fresh lookup [s]."""


def becomes_true(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Whether ``condition()`` becomes true in time; checked every millisecond."""
    deadline = time.monotonic() + timeout_s
    while not (is_true := condition()) and time.monotonic() < deadline:
        time.sleep(0.001)
    return is_true


class ReaderQueries:
    """Queries about the robots of a listener. A pose that is not on the sine is an error."""

    def __init__(self, listener: TransformListener) -> None:
        self._listener = listener
        self._buffer = listener.buffer
        self._model = load_model("rrbot")
        self._kinematics = Kinematics(self._model)
        self._source = SineSource(self._model)
        self._watching: dict[str, FreshnessMonitor] = {}

    def near(self, robot: str, stamp: int, timeout_s: float = 10.0) -> bool:
        """Whether the newest sample gets within half a minute of a stamp in time."""
        is_near = becomes_true(lambda: abs(self.newest(robot) - stamp) <= 30_000_000_000, timeout_s)
        if is_near:
            self._check(robot)
        return is_near

    def newest(self, robot: str) -> int:
        """The stamp of the newest sample, or 0."""
        try:
            return self._buffer.latest(f"{robot}/world", f"{robot}/tool")
        except ZStateError:
            return 0

    def after(self, robot: str, stamp: int, timeout_s: float = 15.0) -> int | None:
        """The time [ns] of the first lookup with a later stamp; its pose is checked."""
        if not becomes_true(lambda: self.newest(robot) > stamp, timeout_s):
            return None
        received_at = time.time_ns()
        self._check(robot)
        return received_at

    def _check(self, robot: str) -> None:
        answer = self._buffer.lookup(f"{robot}/world", f"{robot}/tool")
        assert answer.stamp is not None
        positions = self._source.read(answer.stamp).positions
        pose = self._kinematics.link_poses(positions)[self._model.links.index("tool")]
        expected = Transform.from_pose7("world", "tool", pose)
        assert np.allclose(answer.matrix, expected.matrix, rtol=0.0, atol=1e-9), (answer, expected)

    def mark(self, robot: str, value: float, timeout_s: float = 10.0) -> int | None:
        """The time [ns] when the robot's static edge had this length."""
        return time.time_ns() if becomes_true(lambda: self._mark(robot) == value, timeout_s) else None

    def _mark(self, robot: str) -> float | None:
        try:
            return float(self._buffer.lookup(f"{robot}/world", f"{robot}/mark").translation[0])
        except ZStateError:
            return None

    def fresh(self, robot: str) -> Transform:
        """The newest pose, if it is not older than ``MAX_AGE_S``."""
        return self._buffer.lookup(f"{robot}/world", f"{robot}/tool", max_age_s=MAX_AGE_S)

    def stats(self) -> dict[str, Any]:
        stats = self._listener.stats
        names = ("received", "dropped", "missed", "late", "refused")
        return {name: getattr(stats, name) for name in names}

    def watch(self, robot: str) -> None:
        self._watching[robot] = FreshnessMonitor(self, robot)

    def watched(self, robot: str) -> dict[str, Any]:
        return self._watching.pop(robot).report()

    def latencies(self, robot: str, count: int) -> list[int]:
        """Ages [ns] of the next samples at their first lookup."""
        ages: list[int] = []
        newest = self.newest(robot)
        while len(ages) < count:
            answer = self._buffer.wait(f"{robot}/world", f"{robot}/tool", newest + 1, timeout_s=10.0)
            ages.append(time.time_ns() - self.newest(robot))
            assert answer.stamp is not None
            newest = self.newest(robot)
        return ages


class FreshnessMonitor:
    """Checks one robot every 3 ms: the newest stamp never goes back, no old pose passes as fresh."""

    def __init__(self, answers: ReaderQueries, robot: str) -> None:
        self._answers = answers
        self._robot = robot
        self._stop = threading.Event()
        self._seen: dict[str, int] = {"looks": 0, "went_back": 0, "old_as_fresh": 0, "stale": 0, "gap_ns": 0}
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        seen, newest, changed = self._seen, self._answers.newest(self._robot), time.monotonic_ns()
        while not self._stop.wait(0.003):
            seen["looks"] += 1
            before, newest = newest, self._answers.newest(self._robot)
            seen["went_back"] += newest < before
            if newest != before:
                seen["gap_ns"] = max(seen["gap_ns"], time.monotonic_ns() - changed)
                changed = time.monotonic_ns()
            asked_at = time.time_ns()
            try:
                answer = self._answers.fresh(self._robot)
                seen["old_as_fresh"] += asked_at - (answer.stamp or 0) > MAX_AGE_S * 1e9
            except Stale:
                seen["stale"] += 1
            except ZStateError:
                pass

    def report(self) -> dict[str, int]:
        self._stop.set()
        self._thread.join()
        return self._seen
