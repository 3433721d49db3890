"""Status of publishers, as subscribers receive it."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack, suppress
from itertools import count

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, Child, until
from helpers.robots import RRBOT, put, wait_for_reader
from msgspec.structs import replace

from zstate.errors import Closed, InvalidInput
from zstate.net.discovery import discover
from zstate.net.session import Session, connect
from zstate.net.status import StatusPublisher
from zstate.net.status_monitor import StatusSubscriber
from zstate.net.streams import KeyPublisher
from zstate.nodes.publisher import StatePublisher
from zstate.sources import JointReading, SineSource
from zstate.wire.identity import WriterId
from zstate.wire.keys import STATUS
from zstate.wire.messages import Status
from zstate.wire.native import encode, encoding_of

OK = Status(1, 2, "ok", "driver", "nuc", 3, 100.0, 4, 0)
ME = WriterId("driver", "nuc", 3, 1, OK.session).identity


class Statuses:
    """Every status of ``robot``, and its arrival [s]."""

    def __init__(self, session: Session, robot: str = "*") -> None:
        self.statuses: list[tuple[str, Status]] = []
        self.times: list[float] = []
        self.watch = StatusSubscriber(session, robot, self._on_status)

    def _on_status(self, robot: str, status: Status) -> None:
        self.times.append(time.monotonic())
        self.statuses.append((robot, status))

    @property
    def levels(self) -> set[str]:
        return {status.level for _, status in self.statuses}

    def last(self) -> Status:
        return self.statuses[-1][1]


def status_threads() -> int:
    return sum(thread.name == "zstate status" for thread in threading.enumerate())


def test_publisher_sends_its_status_once_a_second(sessions):
    received = Statuses(sessions[1])
    with StatePublisher(sessions[0], RRBOT, "r1", program="driver") as publisher:
        running = threading.Thread(target=publisher.run, args=(SineSource(RRBOT), 50.0))
        running.start()
        until(lambda: len(received.statuses) >= 3)
        (writer,) = {one for robot in discover(sessions[1]) for _, one in robot.writers}
    running.join()
    robot, status = received.statuses[-1]
    assert robot == "r1"
    assert (status.program, status.pid, status.session) == ("driver", writer.pid, writer.session)
    assert status.sent > 0
    assert status.values["commanded"] == "50 Hz"
    periods = np.diff(received.times)
    # The network may delay one; it neither catches up in a burst nor falls behind for long.
    assert 0.5 < np.mean(periods) < 2.0


def test_status_ends_with_its_publisher_and_leaves_no_thread(sessions):
    before = status_threads()
    received = Statuses(sessions[1])
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        publisher.publish([0.0, 0.0])
        until(lambda: received.statuses)
        assert status_threads() == before + 1
    assert status_threads() == before
    with StatePublisher(sessions[0], RRBOT, "r2"):
        until(lambda: received.statuses[-1][0] == "r2")
    names = [robot for robot, _ in received.statuses]
    assert names == sorted(names), "r1 published after its publisher was closed"


def test_publishers_of_a_session_share_a_thread_and_one_that_fails_ends_alone(sessions, monkeypatch):
    reported: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", reported.append)
    before = status_threads()
    received = Statuses(sessions[1])

    def broken() -> Status:
        raise ZeroDivisionError

    with ExitStack() as opened:
        for number, status in enumerate((broken, lambda: OK, lambda: OK)):
            opened.enter_context(StatusPublisher(sessions[0], f"r{number}", ME, status))
        assert status_threads() == before + 1
        until(lambda: {robot for robot, _ in received.statuses} == {"r1", "r2"})
        until(lambda: len(received.statuses) >= 4)
    assert status_threads() == before
    assert [args.exc_type for args in reported] == [ZeroDivisionError]


def test_late_subscriber_receives_no_status_from_before(sessions):
    asked, numbers = threading.Semaphore(0), count()

    def status() -> Status:
        asked.release()
        return replace(OK, sent=next(numbers))

    with StatusPublisher(sessions[0], "r1", ME, status):
        for _ in range(2):
            assert asked.acquire(timeout=DEADLINE_S)
        # The second one may be on its way.
        received = Statuses(sessions[1], "r1")
        until(lambda: received.statuses)
        assert received.statuses[0][1].sent >= 1


def test_silent_publisher_is_stale(sessions):
    received = Statuses(sessions[1], "r1")
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        publisher.publish([0.0, 0.0])
        until(lambda: "stale" in received.levels)
        assert "nothing was published for" in received.last().text
        until(lambda: publisher.publish([0.0, 0.0]) or received.last().level == "ok")


class Slow:
    """A source that takes longer than a period of 100 Hz."""

    def __init__(self) -> None:
        self._pause = threading.Event()

    def read(self, stamp: int) -> JointReading:
        self._pause.wait(0.03)
        return JointReading(np.zeros(2))


def test_publisher_below_its_rate_warns(sessions):
    received = Statuses(sessions[1], "r1")
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        running = threading.Thread(target=publisher.run, args=(Slow(), 100.0))
        running.start()
        until(lambda: "warn" in received.levels)
    running.join()
    warning = next(status for _, status in received.statuses if status.level == "warn")
    assert "100 Hz are more than this process keeps" in warning.text
    assert warning.late > 0


def test_status_contains_the_reason_of_refused_samples(sessions):
    received = Statuses(sessions[1], "r1")
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:

        def is_in_error() -> bool:
            with suppress(InvalidInput):
                publisher.publish([0.0, float("nan")])
            return "error" in received.levels

        until(is_in_error)
    assert "nan" in received.last().text


WRITER = """
    import sys
    from zstate import StatePublisher, connect, load_model
    with connect() as session, StatePublisher(session, load_model("rrbot"), "r1"):
        print("here")
        sys.stdin.readline()
"""


def test_ended_process_sends_no_status(spawn):
    with connect() as session:
        received = Statuses(session)
        child: Child = spawn(WRITER)
        child.line()
        until(lambda: received.statuses)
        child.kill()
        until(lambda: not discover(session, 0.2))
        with StatePublisher(session, RRBOT, "r2"):
            until(lambda: len([robot for robot, _ in received.statuses if robot == "r2"]) == 2)
    names = [robot for robot, _ in received.statuses]
    assert names == sorted(names), "r1 published after its process was killed"


def test_invalid_status_is_counted_and_ignored(sessions):
    received = Statuses(sessions[1], "r1")
    key = STATUS.key("r1", ME)
    with ExitStack() as opened:
        publishers = {
            encoding: opened.enter_context(KeyPublisher(sessions[0], key, encoding))
            for encoding in ("", encoding_of(Status))
        }
        wait_for_reader(sessions[0], key)
        for stream in publishers.values():
            stream.put(b"\xff\x00 noise")
        until(lambda: sum(received.watch.refused.values()) == 2)
    assert received.watch.refused == {"foreign": 1, "malformed": 1}
    assert not received.statuses


def test_a_status_counts_only_on_the_key_of_its_own_writer(sessions):
    received = Statuses(sessions[1])
    wait_for_reader(sessions[0], STATUS.key("r1", ME))
    theirs = WriterId("driver", "nuc", 3, 1, 99).identity
    wrong = [("r1", theirs, OK), ("*", ME, OK), ("r1", ME, replace(OK, rate_hz=float("nan")))]
    wrong += [("r1", "me", OK), ("r1", ME, replace(OK, text="a" * 70_000))]
    for robot, identity, status in wrong:
        key = f"zstate/{robot}/status/{identity}"
        put(sessions[0], key, encode(status), encoding_of(Status))
    until(lambda: sum(received.watch.refused.values()) == len(wrong))
    assert received.watch.refused == {"foreign": 3, "malformed": 1, "too large": 1}
    assert not received.statuses


def test_status_thread_ends_with_the_session():
    before = status_threads()
    with connect() as session:
        publisher = StatusPublisher(session, "r1", ME, lambda: OK)
    until(lambda: status_threads() == before)
    publisher.close()


@pytest.mark.parametrize("streams", [("robot_description",), ("tf_static",)])
def test_publisher_of_latched_streams_only_has_no_status(sessions, streams):
    before = status_threads()
    with StatePublisher(sessions[0], RRBOT, "r1", streams=streams):
        assert status_threads() == before


def test_ros_wire_carries_no_status(sessions, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    before = status_threads()
    with StatePublisher(sessions[0], RRBOT, "r1", ("ros2",)):
        assert status_threads() == before


def test_closed_publisher_keeps_its_refusal_counts(sessions):
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        publisher.publish([0.0, 0.0])
        with pytest.raises(InvalidInput):
            publisher.publish([0.0])
    with pytest.raises(Closed):
        publisher.publish([0.0, 0.0])
    assert (publisher.stats.sent, publisher.stats.refused) == (1, 1)
