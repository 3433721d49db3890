"""The process of one writer, reader or late joiner; standard library only.

    PYTHON -m bench.worker SUBJECT writer|reader|joiner LABEL

On standard input: the job as a line of JSON, then ``{"do": "go"}``, ``{"do": "stop", ...}`` and
``{"do": "close"}``. On standard output, as lines of JSON: ``ready`` when connected; ``first`` when a reader
has an answer for every robot; ``result`` at the end; ``failed`` with the error instead of any of them. The
log is written to the job's folder as int64: ``LABEL.stamps`` (sent or answered), ``LABEL.times`` (of answers)
and ``LABEL.robots``. A job that soaks has counts in ``result`` instead of a log.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import time
import traceback
from array import array
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TextIO

from bench.job import Job
from bench.subjects import all_subjects
from bench.subjects.subject import Reader, Roles, Writer

CHECKS = 20
JOIN_WITHIN_S = 20.0
POLL_S = 0.0005
# A late writer catches up at most this much; then its schedule restarts.
MAX_BEHIND_NS = 50_000_000
# A soak: the half minute of a latched value, how often a reader looks, and the ages that it counts.
LATCH_S, LOOK_S = 30, 0.5
AGE_BINS, STALE_NS = 100_000, 10**9


class RunnerConnection:
    """The connection to the runner: job and commands from it, messages to it."""

    def __init__(self, commands: TextIO, out: TextIO) -> None:
        self._input = commands
        self._out = out
        self.job = Job.from_json(commands.readline())
        self.stopped = threading.Event()
        self._commands: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._read_commands, daemon=True).start()

    def _read_commands(self) -> None:
        for line in self._input:
            command = json.loads(line)
            if command["do"] == "stop":
                self.stopped.set()
            self._commands.put(command)
        self.stopped.set()
        for _ in range(3):  # at most go, stop and close are waited for
            self._commands.put({"do": "close"})

    def wait_for(self, do: str) -> dict[str, Any]:
        """The next command named ``do``, or ``close`` at the end of input."""
        while (command := self._commands.get())["do"] not in (do, "close"):
            pass
        return command

    def send(self, event: str, **facts: object) -> None:
        """Writes one message to the runner."""
        self._out.write(json.dumps({"event": event, **facts}) + "\n")
        self._out.flush()


class SampleLog:
    """Stamps, times [ns] and robot indices in arrays, which the garbage collector does not visit."""

    def __init__(self, job: Job) -> None:
        self.stamps, self.times, self.robots = array("q"), array("q"), array("q")
        self.complete = threading.Event()
        self._answered_robots: set[int] = set()
        self._robot_count = len(job.followed)

    def on_send(self, stamp: int) -> None:
        """Records that a sample has been sent."""
        self.stamps.append(stamp)

    def on_answer(self, stamp: int, robot: int = 0) -> None:
        """Records that the reader's buffer has answered at ``stamp``."""
        self.times.append(time.time_ns())
        self.stamps.append(stamp)
        self.robots.append(robot)
        if len(self._answered_robots) < self._robot_count:
            self._answered_robots.add(robot)
            if len(self._answered_robots) == self._robot_count:
                self.complete.set()

    def save(self, folder: str, label: str) -> None:
        """Writes the arrays to files, all with the same answers: a system that lags still answers now."""
        count = len(self.robots) or len(self.stamps)
        for name in ("stamps", "times", "robots"):
            with (Path(folder) / f"{label}.{name}").open("wb") as file:
                getattr(self, name)[:count].tofile(file)

    def choose(self, begin: int, end: int) -> list[tuple[int, int]]:
        """Up to ``CHECKS`` pairs of stamp and robot between ``begin`` and ``end``, spread evenly."""
        within = [n for n in range(len(self.robots)) if begin <= self.stamps[n] <= end]
        chosen = within[:: max(1, len(within) // CHECKS)][:CHECKS]
        return [(self.stamps[n], self.robots[n]) for n in chosen]


class SoakLog(SampleLog):
    """Counts of samples, and of their ages by tenths of a millisecond, in constant memory."""

    def __init__(self, job: Job) -> None:
        super().__init__(job)
        self.count = self.stale = self.oldest_ns = 0
        self._ages = array("q", bytes(8 * AGE_BINS))

    def on_send(self, stamp: int) -> None:
        """Counts a sample that has been sent."""
        self.count += 1

    def on_answer(self, stamp: int, robot: int = 0) -> None:
        """Counts an answer at ``stamp``; a soak has no pauses, so all robots answer in the first periods."""
        age_ns = time.time_ns() - stamp
        self.count += 1
        self.oldest_ns = max(self.oldest_ns, age_ns)
        self.stale += age_ns > STALE_NS
        self._ages[min(max(0, age_ns // 100_000), AGE_BINS - 1)] += 1
        if not self.complete.is_set():
            self._answered_robots.add(robot)
            if len(self._answered_robots) == self._robot_count:
                self.complete.set()

    def facts(self) -> dict[str, object]:
        """The counts, and the ages [ms] that half of the samples and 99 % of them do not exceed."""
        seen, ages_ms = 0, {}
        for tenths, count in enumerate(self._ages):
            seen += count
            for percent in (50, 99):
                if percent not in ages_ms and 100 * seen >= percent * self.count > 0:
                    ages_ms[percent] = (tenths + 1) / 10
        ages = [*ages_ms.values(), round(self.oldest_ns * 1e-6, 1)]
        return {"count": self.count, "age_ms_p50_p99_max": ages, "older_than_1_s": self.stale}


def write(roles: Roles, runner: RunnerConnection, label: str) -> None:
    """Sends at the rate, from ``go`` to ``stop``."""
    job = runner.job
    writers = [roles[0](job.for_robots(robot)) for robot in job.mine]
    runner.send("ready")
    runner.wait_for("go")
    record = SoakLog(job) if job.soaks else SampleLog(job)
    latch(writers, runner)
    send_at_rate(writers, job, runner.stopped, record.on_send)
    record.save(job.folder, label)
    runner.send("result", **record.facts() if isinstance(record, SoakLog) else {})
    runner.wait_for("close")  # readers may still look up poses
    for writer in writers:
        writer.close()


def latch(writers: Sequence[Any], runner: RunnerConnection) -> None:
    """In a soak, sets the latched values now and each half minute, until the run ends."""
    if not runner.job.soaks:
        return

    def latch_on() -> None:
        while not runner.stopped.wait(LATCH_S - time.time() % LATCH_S):
            for writer in writers:
                writer.latch(half_minute())

    for writer in writers:
        writer.latch(half_minute())
    threading.Thread(target=latch_on, daemon=True).start()


def half_minute() -> int:
    """The number of the current half minute."""
    return int(time.time()) // LATCH_S


def send_at_rate(  # noqa: PLR0917 - the last two are a clock, which tests turn
    writers: Sequence[Writer],
    job: Job,
    ended: threading.Event,
    on_send: Callable[[int], None],
    pause: Callable[[float], object] = time.sleep,
    now_ns: Callable[[], int] = time.monotonic_ns,
) -> None:
    """Sends one sample of every robot, each with its own stamp, at each absolute deadline."""
    period_ns, rows = 1e9 / job.rate_hz, len(job.rows)
    begin, tick = now_ns(), 0
    while not ended.is_set():
        for writer in writers:
            stamp = time.time_ns()
            writer.send(tick % rows, stamp)
            on_send(stamp)
        tick += 1
        left_ns = begin + tick * period_ns - now_ns()
        if left_ns > 0:
            pause(left_ns * 1e-9)
        elif left_ns < -MAX_BEHIND_NS:
            begin -= round(left_ns)


def read(roles: Roles, runner: RunnerConnection, label: str) -> None:
    """Logs every answer until ``stop``; then returns some poses for comparison."""
    job = runner.job
    record = SoakLog(job) if job.soaks else SampleLog(job)
    reader = roles[1](job, record.on_answer)
    runner.send("ready")
    while not record.complete.wait(0.2):
        if runner.stopped.is_set():
            break
    else:
        runner.send("first")
    if isinstance(record, SoakLog):
        latched = watch_latched(reader, runner)
        runner.send("result", **record.facts(), **latched)
        reader.close()
        return
    stop = runner.wait_for("stop")
    record.save(job.folder, label)
    checks = record.choose(stop.get("begin", 0), stop.get("end", 0))
    runner.send("result", poses=[(stamp, robot, pose_of(reader, stamp, robot)) for stamp, robot in checks])
    reader.close()


def watch_latched(reader: Any, runner: RunnerConnection) -> dict[str, object]:
    """Latched values of whole half minutes: how many arrived, how many did not, and the longest delay [s]."""
    robots, lost, after_s = len(runner.job.followed), 0, array("d")
    number, missing, whole = half_minute(), 0, False
    while not runner.stopped.wait(LOOK_S):
        if (now := half_minute()) != number:
            lost += missing if whole else 0
            number, missing, whole = now, robots, True
        if missing and not (missing := robots - reader.latched(number)):
            after_s.append(time.time() - number * LATCH_S)
    return {
        "latched": len(after_s) * robots,
        "latched_lost": lost,
        "latched_within_s": max(after_s, default=0.0),
    }


def pose_of(reader: Reader, stamp: int, robot: int) -> list[float] | str | None:
    """The pose from the reader's buffer at a stamp, or the error text."""
    try:
        pose = reader.pose(stamp, robot)
    except Exception as error:  # any error of the system belongs in the result
        return f"{type(error).__name__}: {error}"
    return None if pose is None else [float(number) for number in pose]


def join(roles: Roles, runner: RunnerConnection, label: str) -> None:
    """Measures from opening the session until every link has a pose; all imports come before."""
    job = runner.job
    runner.send("ready")
    runner.wait_for("go")
    begin = time.monotonic()
    reader = roles[1](job, ignore)
    while not (whole := reader.has_tree()) and time.monotonic() < begin + JOIN_WITHIN_S:
        time.sleep(POLL_S)
    runner.send("result", whole_s=time.monotonic() - begin if whole else None)
    reader.close()


def ignore(stamp: int, robot: int = 0) -> None:
    """Ignores the answers of a late joiner."""


def main() -> None:
    """Runs the role named on the command line."""
    name, role, label = sys.argv[1:]
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # library output must not mix with the lines of JSON
    runner = RunnerConnection(sys.stdin, out)
    try:
        roles = all_subjects()[name].load()
        {"writer": write, "reader": read, "joiner": join}[role](roles, runner, label)
    except Exception:
        traceback.print_exc()
        runner.send("failed", error=traceback.format_exc().strip().splitlines()[-1])
        sys.exit(1)


if __name__ == "__main__":
    main()
