"""The processes that the fault suite breaks: each does its work, and answers questions on its standard input.

A question is a line of JSON, ``[name, *arguments]``; so is the answer.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from zstate import (
    SineSource,
    StatePublisher,
    StaticPublisher,
    TransformListener,
    ZStateError,
    connect,
    load_model,
)
from zstate.clock import SystemClock
from zstate.errors import Stale
from zstate.model.kinematics import Kinematics
from zstate.recorder import Recorder
from zstate.sources.source import JointReading
from zstate.transform import Transform

MAX_AGE_S = 0.5
CLONE_NEWNET = 0x40000000

Session = dict[str, Any]
Answer = Callable[..., Any]


def main() -> None:
    role, options = sys.argv[1], json.loads(sys.argv[2])
    namespace = options.pop("namespace", None)
    if namespace:
        _enter(namespace)
    {"publisher": publisher, "reader": reader, "recorder": recorder, "router": router}[role](**options)


def _enter(namespace: str) -> None:
    """Go there before any thread exists: a network namespace is a property of each thread."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path(f"/run/netns/{namespace}").open() as file:
        if libc.setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")


def _serve(**answers: Answer) -> None:
    print("ready", flush=True)
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        print(json.dumps({"census": census, **answers}[name](*arguments)), flush=True)


def census() -> dict[str, int]:
    """What must not grow. Threads are those of the process, Zenoh's too."""
    status = Path("/proc/self/status").read_text()
    resident = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return {
        "threads": len(list(Path("/proc/self/task").iterdir())),
        "fds": len(list(Path("/proc/self/fd").iterdir())),
        "rss_kb": int(resident.split()[1]),
    }


class ShiftedClock(SystemClock):
    """The system's clock, set wrong by ``shift_ns``."""

    shift_ns = 0

    def now(self) -> int:
        return super().now() + self.shift_ns

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        return super().wait_until(stamp - self.shift_ns, stop)


class Pausable:
    """A sine that remembers the last stamp it was asked for, until it is told to say nothing."""

    def __init__(self, source: SineSource) -> None:
        self._source = source
        self._last = 0
        self._paused = False

    def read(self, stamp: int) -> JointReading | None:
        if self._paused:
            return None
        self._last = stamp
        return self._source.read(stamp)

    def pause(self) -> int:
        self._paused = True
        return self._last


def publisher(
    robot: str, session: Session, rate_hz: float = 100.0, mark: float = 0.0, takeover: bool = False
) -> None:
    """A robot that moves, with one static edge besides its model, whose length is the mark."""
    model, clock = load_model("rrbot"), ShiftedClock()
    source = Pausable(SineSource(model))

    def shift(shift_ns: int) -> int:
        clock.shift_ns = shift_ns
        return clock.now()

    def leave() -> float:
        began = time.monotonic()
        opened.close()
        return time.monotonic() - began

    with (
        connect(**session) as opened,
        StatePublisher(opened, model, robot, clock=clock, takeover=takeover) as writing,
        StaticPublisher(opened, robot, f"mark.{os.getpid()}", takeover=takeover) as statics,
    ):

        def put_mark(value: float) -> None:
            statics.set(Transform.from_rpy("world", "mark", (value, 0.0, 0.0), (0.0, 0.0, 0.0)))

        def routers() -> list[str]:
            return [str(zid) for zid in opened.zenoh.info.routers_zid()]

        put_mark(mark)
        running = threading.Thread(target=writing.run, args=(source, rate_hz), daemon=True)
        running.start()
        _serve(mark=put_mark, shift=shift, pause=source.pause, routers=routers, leave=leave)


def recorder(session: Session, path: str) -> None:
    with connect(**session) as opened, Recorder(opened, path, ["r1"]) as recording:

        def ended() -> str | None:
            return f"{type(recording.failure).__name__}: {recording.failure}" if recording.wait(0.0) else None

        _serve(ended=ended, written=lambda: sum(recording.stats.messages.values()))


def router(listen: str, connect_to: list[str] | None = None) -> None:
    with connect(mode="router", listen=listen, endpoints=connect_to or ()) as opened:
        _serve(zid=lambda: opened.zid)


def reader(session: Session, robot: str = "*", follow: str = "joint_states", busy_ms: float = 0.0) -> None:
    """One that follows robots; with ``busy_ms`` each sample costs it so long, and nobody else runs."""
    with connect(**session) as opened, TransformListener(opened, robot, follow=follow) as listener:
        answers = _Answers(listener)
        if busy_ms:
            _burden(listener, busy_ms)
        _serve(
            after=answers.after,
            newest=answers.newest,
            near=answers.near,
            mark=answers.mark,
            stats=answers.stats,
            watch=answers.watch,
            watched=answers.watched,
            latencies=answers.latencies,
        )


def _burden(listener: TransformListener, busy_ms: float) -> None:
    insert = listener.buffer.insert_joints

    def slowly(*arguments: Any) -> bool:
        until = time.perf_counter() + busy_ms * 1e-3
        while time.perf_counter() < until:
            pass
        return insert(*arguments)

    listener.buffer.insert_joints = slowly  # type: ignore[method-assign]


class _Answers:
    """What a reader can say of the robots it follows. An answer that is not the sine's is an error."""

    def __init__(self, listener: TransformListener) -> None:
        self._listener = listener
        self._buffer = listener.buffer
        self._model = load_model("rrbot")
        self._kinematics = Kinematics(self._model)
        self._source = SineSource(self._model)
        self._watching: dict[str, _Watching] = {}

    def near(self, robot: str, stamp: int, timeout_s: float = 10.0) -> bool:
        """Whether the newest sample comes to be within half a minute of a stamp."""
        deadline = time.monotonic() + timeout_s
        while abs(self.newest(robot) - stamp) > 30_000_000_000:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.001)
        self._check(robot)
        return True

    def newest(self, robot: str) -> int:
        """The stamp of the newest sample, or 0."""
        try:
            return self._buffer.latest(f"{robot}/world", f"{robot}/tool")
        except ZStateError:
            return 0

    def after(self, robot: str, stamp: int, timeout_s: float = 15.0) -> int | None:
        """When [ns] there was an answer with a later stamp; it is checked."""
        deadline = time.monotonic() + timeout_s
        while self.newest(robot) <= stamp:
            if time.monotonic() > deadline:
                return None
            time.sleep(0.001)
        heard_at = time.time_ns()
        self._check(robot)
        return heard_at

    def _check(self, robot: str) -> None:
        answer = self._buffer.lookup(f"{robot}/world", f"{robot}/tool")
        assert answer.stamp is not None
        positions = self._source.read(answer.stamp).positions
        pose = self._kinematics.link_poses(positions)[self._model.links.index("tool")]
        expected = Transform.from_pose7("world", "tool", pose)
        assert np.allclose(answer.matrix, expected.matrix, rtol=0.0, atol=1e-9), (answer, expected)

    def mark(self, robot: str, value: float, timeout_s: float = 10.0) -> int | None:
        """When [ns] the robot's static edge had this length."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            try:
                edge = self._buffer.lookup(f"{robot}/world", f"{robot}/mark")
            except ZStateError:
                edge = None
            if edge is not None and edge.translation[0] == value:
                return time.time_ns()
            time.sleep(0.001)
        return None

    def stats(self) -> dict[str, Any]:
        stats = self._listener.stats
        names = ("received", "dropped", "missed", "late", "refused")
        return {name: getattr(stats, name) for name in names}

    def watch(self, robot: str) -> None:
        self._watching[robot] = _Watching(self, robot)

    def watched(self, robot: str) -> dict[str, Any]:
        return self._watching.pop(robot).report()

    def latencies(self, robot: str, count: int) -> list[int]:
        """How old [ns] each of the next samples is when it can be looked up."""
        ages: list[int] = []
        newest = self.newest(robot)
        while len(ages) < count:
            answer = self._buffer.wait(f"{robot}/world", f"{robot}/tool", newest + 1, timeout_s=10.0)
            ages.append(time.time_ns() - self.newest(robot))
            assert answer.stamp is not None
            newest = self.newest(robot)
        return ages


class _Watching:
    """Looks at one robot every few milliseconds: newest must never go back, nor old be called fresh."""

    def __init__(self, answers: _Answers, robot: str) -> None:
        self._answers = answers
        self._robot = robot
        self._stop = threading.Event()
        self._seen: dict[str, int] = {"looks": 0, "went_back": 0, "old_as_fresh": 0, "stale": 0, "gap_ns": 0}
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        seen, newest, changed = self._seen, self._answers.newest(self._robot), time.monotonic_ns()
        ends = f"{self._robot}/world", f"{self._robot}/tool"
        while not self._stop.wait(0.003):
            seen["looks"] += 1
            before, newest = newest, self._answers.newest(self._robot)
            seen["went_back"] += newest < before
            if newest != before:
                seen["gap_ns"] = max(seen["gap_ns"], time.monotonic_ns() - changed)
                changed = time.monotonic_ns()
            asked_at = time.time_ns()
            try:
                answer = self._answers._buffer.lookup(*ends, max_age_s=MAX_AGE_S)
                seen["old_as_fresh"] += asked_at - (answer.stamp or 0) > MAX_AGE_S * 1e9
            except Stale:
                seen["stale"] += 1
            except ZStateError:
                pass

    def report(self) -> dict[str, int]:
        self._stop.set()
        self._thread.join()
        return self._seen


if __name__ == "__main__":
    main()
