"""The conversation between the runner and a worker, with a subject that is a function call."""

from __future__ import annotations

import io
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.processes import until

from bench.job import Job
from bench.subjects.subject import Answered
from bench.worker import Record, Told, join, read, send_at_rate, write

POSE = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]


class Wire:
    """Where writers and readers of this file meet."""

    def __init__(self) -> None:
        self.answered: Answered | None = None
        self.sent: list[tuple[str, int, int]] = []
        self.has_tree_after = 0


class Writer:
    def __init__(self, wire: Wire, job: Job) -> None:
        self._wire, self._job = wire, job

    def send(self, row: int, stamp: int) -> None:
        self._wire.sent.append((self._job.robot, row, stamp))
        if self._wire.answered is not None:
            self._wire.answered(stamp, self._job.robots.index(self._job.robot))

    def close(self) -> None:
        self._wire.answered = None


class Reader:
    def __init__(self, wire: Wire, job: Job, answered: Answered) -> None:
        self._wire = wire
        wire.answered = answered

    def pose(self, stamp: int, robot: int = 0) -> list[float]:
        if stamp % 2:
            raise KeyError("odd")
        return POSE

    def has_tree(self) -> bool:
        self._wire.has_tree_after -= 1
        return self._wire.has_tree_after < 0

    def close(self) -> None:
        self._wire.answered = None


class Talk:
    """A worker's role on a thread, and the runner's end of the conversation with it."""

    def __init__(self, role: Callable[..., None], wire: Wire, job: Job, label: str) -> None:
        receiving, sending = os.pipe()
        self._commands = os.fdopen(sending, "w")
        self._out = io.StringIO()
        self._commands.write(job.to_json() + "\n")
        self._commands.flush()
        self._input = os.fdopen(receiving)
        told = Told(self._input, self._out)
        roles = (lambda job: Writer(wire, job), lambda job, answered: Reader(wire, job, answered))
        self.thread = threading.Thread(target=role, args=(roles, told, label), daemon=True)
        self.thread.start()

    def tell(self, **command: object) -> None:
        self._commands.write(json.dumps(command) + "\n")
        self._commands.flush()

    def said(self, count: int) -> list[dict[str, Any]]:
        """The first ``count`` things it says, once it has."""
        until(lambda: self._out.getvalue().count("\n") >= count)
        return [json.loads(line) for line in self._out.getvalue().splitlines()][:count]

    def hang_up(self) -> None:
        self._commands.close()
        self.thread.join(10.0)
        assert not self.thread.is_alive()
        self._input.close()


@pytest.fixture
def job(tmp_path: Path) -> Job:
    rows = tuple((0.1 * n, 0.2 * n) for n in range(4))
    return Job("none", "", ("a", "b"), "base", "tip", ("base", "tip"), rows, 1000.0, folder=str(tmp_path))


@pytest.fixture
def begin(job: Job) -> Iterator[Callable[..., Talk]]:
    talks: list[Talk] = []

    def start(role: Callable[..., None], wire: Wire, label: str, its_job: Job = job) -> Talk:
        talks.append(Talk(role, wire, its_job, label))
        return talks[-1]

    yield start
    for talk in talks:
        talk.hang_up()


def numbers(job: Job, name: str) -> list[int]:
    return np.fromfile(Path(job.folder) / name, dtype=np.int64).tolist()


def test_a_job_survives_being_json(job: Job) -> None:
    assert Job.from_json(job.to_json()) == job


def test_a_writer_and_a_reader_go_from_ready_to_results(job: Job, begin: Callable[..., Talk]) -> None:
    wire = Wire()
    reader = begin(read, wire, "reader0")
    assert reader.said(1) == [{"event": "ready"}]
    writer = begin(write, wire, "writer0")
    assert writer.said(1) == [{"event": "ready"}]
    assert not wire.sent, "nothing is sent before it is told to go"
    writer.tell(do="go")
    assert reader.said(2)[1] == {"event": "first"}
    until(lambda: len(wire.sent) >= 20)
    writer.tell(do="stop")
    assert writer.said(2)[1] == {"event": "result"}
    sent = numbers(job, "writer0.stamps")
    reader.tell(do="stop", begin=sent[0], end=sent[-1])
    poses = reader.said(3)[2]["poses"]
    assert numbers(job, "reader0.stamps") == sent == [stamp for _, _, stamp in wire.sent]
    assert [row for _, row, _ in wire.sent] == [n % 4 for n in range(len(sent))]
    assert all(answered >= stamp for answered, stamp in zip(numbers(job, "reader0.times"), sent, strict=True))
    assert 1 <= len(poses) <= 20
    assert all(pose == ("KeyError: 'odd'" if stamp % 2 else POSE) for stamp, _, pose in poses)


def test_a_reader_has_its_first_answers_when_every_robot_of_a_fleet_was_heard(
    job: Job, begin: Callable[..., Talk]
) -> None:
    wire = Wire()
    reader = begin(read, wire, "reader0", replace(job, robots=("r1", "r2", "r3")))
    reader.said(1)
    assert wire.answered is not None
    for robot in (0, 2, 2, 0):
        wire.answered(time.time_ns(), robot)
    assert len(reader.said(1)) == 1
    wire.answered(time.time_ns(), 1)
    assert reader.said(2)[1] == {"event": "first"}


def test_a_writer_of_several_robots_sends_one_sample_of_each_in_turn(
    job: Job, begin: Callable[..., Talk]
) -> None:
    wire = Wire()
    writer = begin(write, wire, "writer0", replace(job, robots=("r1", "r2", "r3"), mine=("r1", "r3")))
    writer.said(1)
    writer.tell(do="go")
    until(lambda: len(wire.sent) >= 8)
    writer.tell(do="stop")
    writer.said(2)
    assert [(robot, row) for robot, row, _ in wire.sent[:6]] == [
        ("r1", 0), ("r3", 0), ("r1", 1), ("r3", 1), ("r1", 2), ("r3", 2),
    ]  # fmt: skip


def test_a_late_joiner_tells_when_it_had_the_whole_tree(begin: Callable[..., Talk]) -> None:
    wire = Wire()
    wire.has_tree_after = 3
    joiner = begin(join, wire, "joiner0")
    joiner.said(1)
    assert wire.answered is None, "it does not connect before it is told to go"
    joiner.tell(do="go")
    result = joiner.said(2)[1]
    assert result["event"] == "result"
    assert 0.0 <= result["connected_s"] <= result["whole_s"]


def test_who_sends_keeps_its_deadlines_whatever_sending_takes(job: Job) -> None:
    ended = threading.Event()
    stamps = Record(job).stamps

    class Slow(Writer):
        def send(self, row: int, stamp: int) -> None:
            time.sleep(0.003)
            if len(stamps) == 49:
                ended.set()

    began = time.monotonic()
    send_at_rate([Slow(Wire(), job)], replace(job, rate_hz=200.0), ended, stamps)
    # 50 samples at 200 Hz: the last is due after 245 ms. Without deadlines it would take 400 ms.
    assert len(stamps) == 50
    assert time.monotonic() - began >= 0.245
    gaps = np.diff(np.array(stamps))
    assert np.median(gaps) == pytest.approx(5e6, rel=0.1)


def test_a_slow_reader_naps_in_the_thread_that_answers(job: Job) -> None:
    record = Record(replace(job, load="slow"))
    began = time.monotonic()
    record.answered(1)
    assert time.monotonic() - began >= 0.010
