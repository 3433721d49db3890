"""Queries that a reader of the fault suite replies to."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

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


class Motion(Protocol):
    """A known motion of frame ``source`` in frame ``target``."""

    target: str
    source: str

    def includes(self, transform: Transform) -> bool:
        """Whether a transform is part of the motion, at its stamp."""
        ...


class ArmMotion:
    """The tool of rrbot, whose joints follow a ``SineSource``."""

    target, source = "world", "tool"

    def __init__(self) -> None:
        self._model = load_model("rrbot")
        self._kinematics = Kinematics(self._model)
        self._joints = SineSource(self._model)

    def includes(self, transform: Transform) -> bool:
        assert transform.stamp is not None
        poses = self._kinematics.link_poses(self._joints.read(transform.stamp).positions)
        pose = poses[self._model.links.index(self.source)]
        return are_close(transform, Transform.from_pose7(self.target, self.source, pose))


class OdometryMotion:
    """A constant velocity and yaw rate: interpolation is exact at every instant, however large the gap.

    ``lane`` [m] moves the path sideways by whole metres, so that writers can be distinguished; a pose between
    samples of two writers is in no lane.
    """

    target, source = "odom", "world"
    # Reduced as an integer: nanoseconds since 1970 exceed the precision of a float. The path begins again
    # every ten days.
    _period_ns = 10 * 86_400 * 1_000_000_000

    def __init__(self, lane: int = 0) -> None:
        self._lane = lane

    def pose(self, stamp: int) -> Transform:
        elapsed_s = stamp % self._period_ns * 1e-9
        yaw = math.remainder(0.1 * elapsed_s, math.tau)
        position = (0.05 * elapsed_s, self._lane, 0.0)
        return Transform.from_rpy(self.target, self.source, position, (0.0, 0.0, yaw), stamp)

    def includes(self, transform: Transform) -> bool:
        assert transform.stamp is not None
        lane = round(transform.translation[1])
        return are_close(transform, OdometryMotion(lane).pose(transform.stamp))


class JointsMotion:
    """rrbot whose joints turn at constant rates: interpolation is exact, however large the gap.

    ``target`` and ``source`` are the ends of the arm, or of a part of it. ``tolerance`` [m] is for poses
    from merged readings, whose joints are of different instants.
    """

    RATES = (0.02, -0.03)
    """Of shoulder and elbow [rad/s]."""
    _period_ns = OdometryMotion._period_ns

    def __init__(self, target: str = "world", source: str = "tool", tolerance: float = 1e-9) -> None:
        self.target, self.source = target, source
        self._tolerance = tolerance
        self._model = load_model("rrbot")
        self._kinematics = Kinematics(self._model)

    def positions(self, stamp: int) -> list[float]:
        """The positions of all joints [rad]."""
        elapsed_s = stamp % self._period_ns * 1e-9
        return [rate * elapsed_s for rate in self.RATES]

    def includes(self, transform: Transform) -> bool:
        assert transform.stamp is not None
        poses = self._kinematics.link_poses(self.positions(transform.stamp))
        target, source = (
            Transform.from_pose7("world", link, poses[self._model.links.index(link)])
            for link in (self.target, self.source)
        )
        truth = target.inverse() @ source
        return np.allclose(transform.matrix, truth.matrix, rtol=0.0, atol=self._tolerance)


def are_close(one: Transform, other: Transform) -> bool:
    return np.allclose(one.matrix, other.matrix, rtol=0.0, atol=1e-9)


class ReaderQueries:
    """Queries about one motion of the robots of a listener. A pose that is not part of it is an error."""

    def __init__(self, listener: TransformListener, motion: Motion) -> None:
        self._listener = listener
        self._buffer = listener.buffer
        self.motion = motion
        self._watching: dict[str, FreshnessMonitor] = {}

    def _frames(self, robot: str) -> tuple[str, str]:
        return f"{robot}/{self.motion.target}", f"{robot}/{self.motion.source}"

    def near(self, robot: str, stamp: int, timeout_s: float = 10.0) -> bool:
        """Whether the newest sample gets within half a minute of a stamp in time."""
        is_near = becomes_true(lambda: abs(self.newest(robot) - stamp) <= 30_000_000_000, timeout_s)
        if is_near:
            self._check(robot)
        return is_near

    def newest(self, robot: str) -> int:
        """The stamp of the newest sample, or 0."""
        try:
            return self._buffer.latest(*self._frames(robot))
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
        answer = self._buffer.lookup(*self._frames(robot))
        assert self.motion.includes(answer), answer

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
        return self._buffer.lookup(*self._frames(robot), max_age_s=MAX_AGE_S)

    def stats(self) -> dict[str, Any]:
        stats = self._listener.stats
        names = ("received", "recalled", "dropped", "missed", "late", "refused")
        return {name: getattr(stats, name) for name in names}

    def count(self, robot: str) -> int:
        """The number of samples of the motion in the buffer."""
        return sum(frame.count for frame in self._buffer.frames((self._frames(robot)[1],)))

    def wrong(self, robot: str, start: int, end: int) -> list[str]:
        """The poses and errors at 500 stamps from ``start`` to ``end`` that are not part of the motion."""
        stamps = [start + (end - start) * step // 499 for step in range(500)]
        found: list[str] = []
        for stamp in stamps:
            problem = self._buffer.explain(*self._frames(robot), stamp)
            answer = None if problem else self._buffer.lookup(*self._frames(robot), stamp)
            if answer is None or not self.motion.includes(answer):
                found.append(str(problem or answer))
        return found

    def problem(self, robot: str) -> str:
        """The kind and text of the error of a fresh lookup; empty if there is none."""
        try:
            self.fresh(robot)
        except ZStateError as error:
            return f"{type(error).__name__}: {error}"
        return ""

    def lane(self, robot: str) -> int:
        """The lane of the newest odometry."""
        return round(self._buffer.lookup(*self._frames(robot)).translation[1])

    def events(self) -> list[tuple[str, str, str]]:
        """The kind, stream and text of each event so far."""
        return [(event.kind, event.stream, event.text) for event in self._listener.events()]

    def watch(self, robot: str) -> None:
        self._watching[robot] = FreshnessMonitor(self, robot)

    def watched(self, robot: str) -> dict[str, Any]:
        return self._watching.pop(robot).report()

    def latencies(self, robot: str, count: int) -> list[int]:
        """Ages [ns] of the next samples at their first lookup."""
        ages: list[int] = []
        newest = self.newest(robot)
        while len(ages) < count:
            answer = self._buffer.wait(*self._frames(robot), newest + 1, timeout_s=10.0)
            ages.append(time.time_ns() - self.newest(robot))
            assert answer.stamp is not None
            newest = self.newest(robot)
        return ages


class FreshnessMonitor:
    """Checks one robot every 3 ms: no newest stamp goes back, no old pose is fresh, and none is wrong."""

    def __init__(self, answers: ReaderQueries, robot: str) -> None:
        self._answers = answers
        self._robot = robot
        self._stop = threading.Event()
        self._seen: dict[str, int] = dict.fromkeys(
            ("looks", "went_back", "old_as_fresh", "wrong", "stale", "gap_ns"), 0
        )
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
                seen["wrong"] += not self._answers.motion.includes(answer)
            except Stale:
                seen["stale"] += 1
            except ZStateError:
                pass

    def report(self) -> dict[str, int]:
        self._stop.set()
        self._thread.join()
        return self._seen
