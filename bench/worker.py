"""The process of one writer, one reader or one late joiner; nothing but the standard library.

    PYTHON -m bench.worker SUBJECT writer|reader|joiner LABEL

On standard input: the job as a line of JSON, then ``{"do": "go"}``, ``{"do": "stop", ...}`` and
``{"do": "close"}``. On standard output, as lines of JSON: ``ready`` when it is connected; ``first`` when a
reader has an answer from every robot; ``result`` at the end; ``failed`` with the error instead of any of
them. What was recorded is left in the job's folder as int64: ``LABEL.stamps`` (sent, or answered),
``LABEL.times`` (when) and ``LABEL.robots``.
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
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from bench.job import Job
from bench.subjects import subject_named
from bench.subjects.subject import Reader, Roles, Writer

NAP_S = 0.010
CHECKS = 20
JOIN_WITHIN_S = 20.0
POLL_S = 0.0005
# A writer that is behind catches up, but not for ever.
MOST_BEHIND_NS = 50_000_000


class Told:
    """The runner's side of the conversation: the job, its commands, and lines for it."""

    def __init__(self, commands: TextIO, out: TextIO) -> None:
        self._said = commands
        self._out = out
        self.job = Job.from_json(commands.readline())
        self.ended = threading.Event()
        self._commands: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        for line in self._said:
            command = json.loads(line)
            if command["do"] == "stop":
                self.ended.set()
            self._commands.put(command)
        self.ended.set()
        for _ in range(3):  # nobody waits for more than go, stop and close
            self._commands.put({"do": "close"})

    def wait_for(self, do: str) -> dict[str, Any]:
        """The next command of that name; at the end of the input, to close."""
        while (command := self._commands.get())["do"] not in (do, "close"):
            pass
        return command

    def say(self, event: str, **facts: object) -> None:
        """A line for the runner."""
        self._out.write(json.dumps({"event": event, **facts}) + "\n")
        self._out.flush()


class Record:
    """Stamps and times [ns], as they come; kept without objects that the collector would visit."""

    def __init__(self, job: Job) -> None:
        self.stamps, self.times, self.robots = array("q"), array("q"), array("q")
        self.complete = threading.Event()
        self._heard: set[int] = set()
        self._wanted = len(job.robots)
        self._is_slow = job.load == "slow"

    def answered(self, stamp: int, robot: int = 0) -> None:
        """The reader's own buffer has just answered at ``stamp``."""
        self.times.append(time.time_ns())
        self.stamps.append(stamp)
        self.robots.append(robot)
        if len(self._heard) < self._wanted:
            self._heard.add(robot)
            if len(self._heard) == self._wanted:
                self.complete.set()
        if self._is_slow:
            time.sleep(NAP_S)

    def save(self, folder: str, label: str) -> None:
        """Leave all of it in files."""
        for name in ("stamps", "times", "robots"):
            with (Path(folder) / f"{label}.{name}").open("wb") as file:
                getattr(self, name).tofile(file)

    def some(self, begin: int, end: int) -> list[tuple[int, int]]:
        """Stamps from ``begin`` to ``end``, spread evenly, with the robot of each."""
        within = [n for n, stamp in enumerate(self.stamps) if begin <= stamp <= end]
        chosen = within[:: max(1, len(within) // CHECKS)][:CHECKS]
        return [(self.stamps[n], self.robots[n]) for n in chosen]


def write(roles: Roles, told: Told, label: str) -> None:
    """Send at the rate, from "go" to "stop"."""
    job, record = told.job, Record(told.job)
    writers = [roles[0](job.of(robot)) for robot in job.mine]
    told.say("ready")
    told.wait_for("go")
    if job.rate_hz:
        send_at_rate(writers, job, told.ended, record.stamps)
    else:
        send_flat_out(writers, job, told.ended, record.stamps)
    record.save(job.folder, label)
    told.say("result")
    told.wait_for("close")  # those who read may still be asked
    for writer in writers:
        writer.close()


def send_at_rate(writers: Sequence[Writer], job: Job, ended: threading.Event, stamps: array[int]) -> None:
    """One sample of every robot at each deadline; the deadlines are absolute."""
    period_ns, rows = 1e9 / job.rate_hz, len(job.rows)
    begin, tick = time.monotonic_ns(), 0
    while not ended.is_set():
        send_all(writers, tick % rows, stamps)
        tick += 1
        left_ns = begin + tick * period_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)
        elif left_ns < -MOST_BEHIND_NS:
            begin -= round(left_ns)


def send_flat_out(writers: Sequence[Writer], job: Job, ended: threading.Event, stamps: array[int]) -> None:
    """One sample after the other."""
    tick, rows = 0, len(job.rows)
    while not ended.is_set():
        send_all(writers, tick % rows, stamps)
        tick += 1


def send_all(writers: Sequence[Writer], row: int, stamps: array[int]) -> None:
    """One sample of each robot, with a stamp of its own."""
    for writer in writers:
        stamp = time.time_ns()
        writer.send(row, stamp)
        stamps.append(stamp)


def read(roles: Roles, told: Told, label: str) -> None:
    """Record every answer until told to stop; then show some of them."""
    job, record = told.job, Record(told.job)
    reader = roles[1](job, record.answered)
    told.say("ready")
    while not record.complete.wait(0.2):
        if told.ended.is_set():
            break
    else:
        if job.load == "busy":
            threading.Thread(target=spin, daemon=True).start()
        told.say("first")
    stop = told.wait_for("stop")
    record.save(job.folder, label)
    asked = record.some(stop.get("begin", 0), stop.get("end", 0))
    told.say("result", poses=[(stamp, robot, pose_of(reader, stamp, robot)) for stamp, robot in asked])
    reader.close()


def spin() -> None:
    """Pure Python that never waits: it gives the GIL up only when asked to, every 5 ms."""
    count = 0
    while True:
        count += 1


def pose_of(reader: Reader, stamp: int, robot: int) -> list[float] | str | None:
    """What the reader's buffer says at a stamp, or its error."""
    try:
        pose = reader.pose(stamp, robot)
    except Exception as error:  # whatever a system raises belongs in the result
        return f"{type(error).__name__}: {error}"
    return None if pose is None else [float(number) for number in pose]


def join(roles: Roles, told: Told, label: str) -> None:
    """From the opening of the session until every link has its place; everything was imported before."""
    job = told.job
    told.say("ready")
    told.wait_for("go")
    begin = time.monotonic()
    reader = roles[1](job, ignore)
    connected = time.monotonic()
    while not (whole := reader.has_tree()) and time.monotonic() < begin + JOIN_WITHIN_S:
        time.sleep(POLL_S)
    end = time.monotonic()
    told.say("result", connected_s=connected - begin, whole_s=end - begin if whole else None)
    reader.close()


def ignore(stamp: int, robot: int = 0) -> None:
    """A late joiner's answers are not counted."""


def main() -> None:
    """Be what the command line says."""
    name, role, label = sys.argv[1:]
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints must not come between the lines of JSON
    told = Told(sys.stdin, out)
    try:
        roles = subject_named(name).load()
        {"writer": write, "reader": read, "joiner": join}[role](roles, told, label)
    except Exception:
        traceback.print_exc()
        told.say("failed", error=traceback.format_exc().strip().splitlines()[-1])
        sys.exit(1)


if __name__ == "__main__":
    main()
