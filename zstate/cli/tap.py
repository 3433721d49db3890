"""Tap: one stream of one robot, sample by sample, as it comes in."""

from __future__ import annotations

import queue
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from zstate.cli.output.console import fail, print_status
from zstate.cli.roster import Roster
from zstate.clock import LONGEST_WAIT_S
from zstate.closing import Closing
from zstate.errors import MessageError
from zstate.net.presence import announce_reader
from zstate.net.streams import CAPACITY, StreamSubscriber
from zstate.net.wires import wire_named
from zstate.wire.keys import Stream, check_robot
from zstate.wire.messages import Message, Sample
from zstate.wire.wire import Arrival

if TYPE_CHECKING:
    from zstate.net.session import Session

# Waiting is mentioned when it lasts longer than meeting everybody does.
_GRACE_S = 0.5


class Tapped(NamedTuple):
    """A sample, and when it came [ns], by a clock that never jumps."""

    came: int
    sample: Sample


class Tap(Closing):
    """Hears ``stream`` of ``robot``. Messages that are not ours are noted, the first of each kind."""

    def __init__(self, session: Session, robot: str, stream: Stream, wire: str = "native") -> None:
        self.robot = check_robot(robot)
        self._stream: Stream = stream
        self._wire = wire_named(wire)
        self._refused: set[str] = set()
        self._samples: queue.SimpleQueue[Tapped] = queue.SimpleQueue()
        self._roster = Roster(session, robot, wire)
        key = self._wire.expression(robot, stream)
        self._subscriber = StreamSubscriber(session, key, self._take)
        self._announcements = announce_reader(session, self._wire, robot, (stream,))

    def close(self) -> None:
        for announcement in self._announcements:
            announcement.close()
        self._subscriber.close()
        self._roster.close()

    def _take(self, arrivals: list[Arrival]) -> None:
        came = time.monotonic_ns()
        for arrival in arrivals:
            for sample in self._decode(arrival):
                assert isinstance(sample, Sample)
                # Where nothing is taken, as on a terminal that stands still, the newest are left out.
                if self._samples.qsize() < CAPACITY:
                    self._samples.put(Tapped(came, sample))

    def _decode(self, arrival: Arrival) -> Sequence[Message]:
        try:
            return self._wire.decode(self._stream, arrival, self.robot)
        except MessageError as error:
            self._refuse(arrival.key, error)
            return ()

    def _refuse(self, key: str, error: MessageError) -> None:
        if error.reason not in self._refused:
            self._refused.add(error.reason)
            print_status(f"{key}: {error}; further ones are passed over in silence")

    def next(self, timeout_s: float) -> Tapped | None:
        """The next sample, or None when none comes within ``timeout_s``, or half a second if that is less."""
        try:
            return self._samples.get(timeout=min(timeout_s, LONGEST_WAIT_S))
        except queue.Empty:
            return None

    def silence(self) -> str:
        """Why nothing more comes."""
        return self._roster.silence(self.robot, self._stream, ended=True)

    def first(self, timeout_s: float | None = None) -> Tapped:
        """The first sample, whenever it comes; says what it waits for. Fails after ``timeout_s``."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        said = ""
        while True:
            left_s = _GRACE_S if deadline is None else max(0.0, deadline - time.monotonic())
            tapped = self.next(min(left_s, _GRACE_S))
            if tapped is not None:
                if said:
                    print_status(f"heard {self._roster.words.place(self.robot, (self._stream,))}")
                return tapped
            reason = self._roster.silence(self.robot, self._stream)
            if deadline is not None and left_s <= _GRACE_S:
                fail(f"gave up after {timeout_s:g} s: {reason}")
            if reason != said:
                said = reason
                print_status(f"waiting: {reason}")
