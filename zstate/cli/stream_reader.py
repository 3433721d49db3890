"""Reader of the samples of one stream of one robot."""

from __future__ import annotations

import queue
import time
from typing import TYPE_CHECKING, NamedTuple

from zstate._util.closeable import Closeable
from zstate.cli.output.console import fail, print_status
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.waiting import ConditionWaiter
from zstate.clock import LONGEST_WAIT_S
from zstate.net.presence import announce_reader
from zstate.net.streams import BULK_CAPACITY, CAPACITY
from zstate.net.subscription import Received, subscribe
from zstate.stream_registry import is_bulk
from zstate.streams import StreamName
from zstate.wire.keys import check_robot
from zstate.wire.messages import Message
from zstate.wire.registry import get_wire

if TYPE_CHECKING:
    from zstate.net.session import Session


class TimedSample(NamedTuple):
    """A sample, or a map, and its ``arrival`` [ns] by the monotonic clock."""

    arrival: int
    sample: Message


class StreamReader(Closeable):
    """Samples of ``stream`` of ``robot``, or its maps, in order of arrival, for one reading thread.

    Messages that cannot be decoded are skipped; the first of each kind is reported.
    """

    def __init__(self, session: Session, robot: str, stream: StreamName, wire: str = "native") -> None:
        self.robot = check_robot(robot)
        self._stream: StreamName = stream
        self._capacity = BULK_CAPACITY if is_bulk(stream) else CAPACITY
        self._refused: set[str] = set()
        self._samples: queue.SimpleQueue[TimedSample] = queue.SimpleQueue()
        self._waiter = ConditionWaiter()
        self._directory = RobotDirectory(session, robot, wire, self._waiter.notify)
        wire_format = get_wire(wire)
        self._subscriber = subscribe(
            session, wire_format, robot, stream, self._on_messages, on_error=self._on_error
        )
        self._announcements = announce_reader(session, wire_format, robot, (stream,))

    def close(self) -> None:
        for announcement in self._announcements:
            announcement.close()
        self._subscriber.close()
        self._directory.close()

    def _on_messages(self, received: list[Received]) -> None:
        now = time.monotonic_ns()
        for _, _, sample in received:
            # If the queue is not read, as on a stopped terminal, the newest samples are dropped.
            if self._samples.qsize() < self._capacity:
                self._samples.put(TimedSample(now, sample))
        self._waiter.notify()

    def _on_error(self, reason: str, text: str) -> None:
        if reason not in self._refused:
            self._refused.add(reason)
            print_status(f"{text}; further ones are not reported")

    def next(self, timeout_s: float) -> TimedSample | None:
        """The next sample, or None if none arrives within ``timeout_s``, at most 0.5 s."""
        try:
            return self._samples.get(timeout=min(timeout_s, LONGEST_WAIT_S))
        except queue.Empty:
            return None

    def first(self, timeout_s: float | None = None) -> TimedSample:
        """The first sample. Prints what it waits for; fails after ``timeout_s``."""
        waiter = self._waiter
        if not waiter.wait_for(self._samples.qsize, timeout_s, self._reason):
            fail(f"gave up after {timeout_s:g} s: {self._reason()}")
        if waiter.last_reason:
            print_status(f"received {self._directory.messages.topics(self.robot, (self._stream,))}")
        return self._samples.get_nowait()

    def no_sample_text(self) -> str:
        """Why no more samples arrive."""
        return self._directory.no_sample_text(self.robot, self._stream, ended=True)

    def _reason(self) -> str:
        return self._directory.no_sample_text(self.robot, self._stream)
