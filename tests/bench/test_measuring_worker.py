"""The protocol between runner and worker, with an in-process subject."""

from __future__ import annotations

import io
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.processes import until
from numpy.typing import NDArray

from bench.job import Job
from bench.subjects.subject import Answered
from bench.worker import RunnerConnection, SampleLog, SoakLog, half_minute, join, read, send_at_rate, write

POSE = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]


class Loopback:
    """Connects the writers and readers of this file."""

    def __init__(self) -> None:
        self.answered: Answered | None = None
        self.sent: list[tuple[str, int, int]] = []
        self.has_tree_after = 0
        self.latched: dict[str, int] = {}


class Writer:
    def __init__(self, loopback: Loopback, job: Job) -> None:
        self._loopback, self._job = loopback, job

    def send(self, row: int, stamp: int) -> None:
        self._loopback.sent.append((self._job.robot, row, stamp))
        if self._loopback.answered is not None:
            self._loopback.answered(stamp, self._job.robots.index(self._job.robot))

    def latch(self, number: int) -> None:
        self._loopback.latched[self._job.robot] = number

    def close(self) -> None:
        self._loopback.answered = None


class Reader:
    def __init__(self, loopback: Loopback, job: Job, answered: Answered) -> None:
        self._loopback = loopback
        loopback.answered = answered

    def pose(self, stamp: int, robot: int = 0) -> list[float]:
        if stamp % 2:
            raise KeyError("odd")
        return POSE

    def has_tree(self) -> bool:
        self._loopback.has_tree_after -= 1
        return self._loopback.has_tree_after < 0

    def latched(self, number: int) -> int:
        return list(self._loopback.latched.values()).count(number)

    def close(self) -> None:
        self._loopback.answered = None


class RunningRole:
    """A worker role in a thread, and the runner's end of its connection."""

    def __init__(self, role: Callable[..., None], loopback: Loopback, job: Job, label: str) -> None:
        receiving, sending = os.pipe()
        self._commands = os.fdopen(sending, "w")
        self._out = io.StringIO()
        self._commands.write(job.to_json() + "\n")
        self._commands.flush()
        self._input = os.fdopen(receiving)
        connection = RunnerConnection(self._input, self._out)
        roles = (lambda job: Writer(loopback, job), lambda job, answered: Reader(loopback, job, answered))
        self.thread = threading.Thread(target=role, args=(roles, connection, label), daemon=True)
        self.thread.start()

    def send(self, **command: object) -> None:
        self._commands.write(json.dumps(command) + "\n")
        self._commands.flush()

    def messages(self, count: int) -> list[dict[str, Any]]:
        """Waits for and returns the first ``count`` messages."""
        until(lambda: self._out.getvalue().count("\n") >= count)
        return [json.loads(line) for line in self._out.getvalue().splitlines()][:count]

    def close(self) -> None:
        self._commands.close()
        self.thread.join(10.0)
        assert not self.thread.is_alive()
        self._input.close()


@pytest.fixture
def job(tmp_path: Path) -> Job:
    rows = tuple((0.1 * n, 0.2 * n) for n in range(4))
    return Job("none", "", ("a", "b"), "base", "tip", ("base", "tip"), rows, 1000.0, folder=str(tmp_path))


@pytest.fixture
def start_role(job: Job) -> Iterator[Callable[..., RunningRole]]:
    roles: list[RunningRole] = []

    def start(role: Callable[..., None], loopback: Loopback, label: str, its_job: Job = job) -> RunningRole:
        roles.append(RunningRole(role, loopback, its_job, label))
        return roles[-1]

    yield start
    for running_role in roles:
        running_role.close()


def numbers(job: Job, name: str) -> list[int]:
    return np.fromfile(Path(job.folder) / name, dtype=np.int64).tolist()


def test_job_round_trips_through_json(job: Job) -> None:
    assert Job.from_json(job.to_json()) == job


def test_writer_and_reader_run_from_ready_to_results(
    job: Job, start_role: Callable[..., RunningRole]
) -> None:
    loopback = Loopback()
    reader = start_role(read, loopback, "reader0")
    assert reader.messages(1) == [{"event": "ready"}]
    writer = start_role(write, loopback, "writer0")
    assert writer.messages(1) == [{"event": "ready"}]
    assert not loopback.sent, "nothing is sent before the command go"
    writer.send(do="go")
    assert reader.messages(2)[1] == {"event": "first"}
    until(lambda: len(loopback.sent) >= 20)
    writer.send(do="stop")
    assert writer.messages(2)[1] == {"event": "result"}
    sent = numbers(job, "writer0.stamps")
    reader.send(do="stop", begin=sent[0], end=sent[-1])
    poses = reader.messages(3)[2]["poses"]
    assert numbers(job, "reader0.stamps") == sent == [stamp for _, _, stamp in loopback.sent]
    assert [row for _, row, _ in loopback.sent] == [n % 4 for n in range(len(sent))]
    assert all(answered >= stamp for answered, stamp in zip(numbers(job, "reader0.times"), sent, strict=True))
    assert 1 <= len(poses) <= 20
    assert all(pose == ("KeyError: 'odd'" if stamp % 2 else POSE) for stamp, _, pose in poses)


def test_reader_of_a_fleet_reports_first_after_an_answer_of_every_robot(
    job: Job, start_role: Callable[..., RunningRole]
) -> None:
    loopback = Loopback()
    reader = start_role(read, loopback, "reader0", replace(job, robots=("r1", "r2", "r3")))
    reader.messages(1)
    assert loopback.answered is not None
    for robot in (0, 2, 2, 0):
        loopback.answered(time.time_ns(), robot)
    assert len(reader.messages(1)) == 1
    loopback.answered(time.time_ns(), 1)
    assert reader.messages(2)[1] == {"event": "first"}


def test_writer_of_several_robots_alternates_between_them(
    job: Job, start_role: Callable[..., RunningRole]
) -> None:
    loopback = Loopback()
    writer = start_role(
        write, loopback, "writer0", replace(job, robots=("r1", "r2", "r3"), mine=("r1", "r3"))
    )
    writer.messages(1)
    writer.send(do="go")
    until(lambda: len(loopback.sent) >= 8)
    writer.send(do="stop")
    writer.messages(2)
    assert [(robot, row) for robot, row, _ in loopback.sent[:6]] == [
        ("r1", 0), ("r3", 0), ("r1", 1), ("r3", 1), ("r1", 2), ("r3", 2),
    ]  # fmt: skip


def test_late_joiner_reports_the_time_until_the_whole_tree(start_role: Callable[..., RunningRole]) -> None:
    loopback = Loopback()
    loopback.has_tree_after = 3
    joiner = start_role(join, loopback, "joiner0")
    joiner.messages(1)
    assert loopback.answered is None, "it does not connect before the command go"
    joiner.send(do="go")
    result = joiner.messages(2)[1]
    assert result["event"] == "result"
    assert result["whole_s"] >= 0.0


@dataclass
class SlowSending:
    """A writer that takes 3 ms of its own clock for a sample, and once ``longest_s``; 50 samples in all."""

    ended: threading.Event
    longest_s: float = 0.003
    now_s: float = 1.0

    def __post_init__(self) -> None:
        self.sent_at: list[float] = []

    def pause(self, seconds: float) -> None:
        self.now_s += seconds

    def send(self, row: int, stamp: int) -> None:
        self.sent_at.append(self.now_s)
        self.pause(self.longest_s if len(self.sent_at) == 10 else 0.003)
        if len(self.sent_at) == 50:
            self.ended.set()

    def close(self) -> None:
        pass


def send_slowly(job: Job, longest_s: float = 0.003) -> NDArray[np.float64]:
    """The times [s] of 50 samples at 200 Hz."""
    ended = threading.Event()
    slow = SlowSending(ended, longest_s)
    stamps = SampleLog(job).stamps
    send_at_rate(
        [slow], replace(job, rate_hz=200.0), ended, stamps.append, slow.pause, lambda: round(1e9 * slow.now_s)
    )
    assert len(stamps) == 50
    return np.array(slow.sent_at)


def test_writer_keeps_its_deadlines_if_sending_is_slow(job: Job) -> None:
    # Without deadlines the gaps would be of 8 ms.
    assert 1e9 * np.diff(send_slowly(job)) == pytest.approx(5e6, abs=10.0)


def test_writer_catches_up_after_a_pause_and_then_keeps_the_same_deadlines(job: Job) -> None:
    times = send_slowly(job, longest_s=0.023)
    gaps = 1e9 * np.diff(times)
    # The next sample is 18 ms late; each of the following gaps is of 3 ms, until the rest is less than 2 ms.
    assert gaps[9] == pytest.approx(23e6, abs=10.0)
    assert gaps[10:19] == pytest.approx(3e6, abs=10.0)
    assert np.median(gaps) == pytest.approx(5e6, rel=0.1)
    assert times[-1] - times[0] == pytest.approx(49 * 0.005, abs=1e-7)


def test_samples_have_the_stamps_of_their_sending(job: Job) -> None:
    loopback, ended = Loopback(), threading.Event()

    class Once(Writer):
        def send(self, row: int, stamp: int) -> None:
            super().send(row, stamp)
            ended.set()

    before, stamps = time.time_ns(), SampleLog(job).stamps
    send_at_rate([Once(loopback, job)], job, ended, stamps.append)
    assert [stamp for _, _, stamp in loopback.sent] == list(stamps)
    assert before <= stamps[0] <= time.time_ns()


def test_reader_that_still_answers_saves_whole_answers_only(job: Job) -> None:
    record = SampleLog(job)
    record.on_answer(1)
    record.on_answer(2)
    record.times.append(time.time_ns())  # the answering thread is between the appends of its next answer
    record.stamps.append(3)
    record.save(job.folder, "reader0")
    assert numbers(job, "reader0.stamps") == [1, 2]
    assert len(numbers(job, "reader0.times")) == len(numbers(job, "reader0.robots")) == 2
    assert record.choose(0, 9) == [(1, 0), (2, 0)]


def test_soak_counts_samples_and_latched_values_of_every_robot(
    job: Job, start_role: Callable[..., RunningRole]
) -> None:
    loopback = Loopback()
    soaking = replace(job, robots=("r1", "r2"), mine=("r1", "r2"), soaks=True)
    reader = start_role(read, loopback, "reader0", soaking)
    reader.messages(1)
    writer = start_role(write, loopback, "writer0", soaking)
    writer.messages(1)
    writer.send(do="go")
    until(lambda: len(loopback.sent) >= 20)
    writer.send(do="stop")
    result = writer.messages(2)[1]
    assert result["count"] == len(loopback.sent)
    assert loopback.latched == {"r1": half_minute(), "r2": half_minute()}
    reader.send(do="stop")
    result = reader.messages(3)[2]
    assert result["count"] == len(loopback.sent)
    assert result["latched_lost"] == 0


def test_ages_of_a_soak_are_percentiles_in_constant_memory(job: Job) -> None:
    record = SoakLog(job)
    for age_ms in (*[0.0] * 98, 2_000.0, 20_000.0):
        record.on_answer(time.time_ns() - round(age_ms * 1e6))
    p50, p99, oldest = record.facts()["age_ms_p50_p99_max"]
    assert p50 < 1000.0
    assert 2_000.0 <= p99 < 3_000.0
    assert 20_000.0 <= oldest < 21_000.0
    assert record.facts()["older_than_1_s"] == 2
    assert len(record.stamps) == 0
