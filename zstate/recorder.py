"""Recorder: what robots say on the network, into MCAP files that every ROS tool opens."""

from __future__ import annotations

import atexit
import math
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from zstate._util.bounded_dict import BoundedDict
from zstate.clock import SystemClock, wait_in_slices
from zstate.closing import Closing
from zstate.errors import Closed, InvalidInput, MessageError, RecordingError
from zstate.ingest.counters import Counters
from zstate.ingest.sequence import GapCounter
from zstate.locks import new_lock, outlive_fork
from zstate.net.forked import forked_text
from zstate.net.inbox import Heard, Inbox
from zstate.net.presence import announce_reader, watch
from zstate.net.session import Session
from zstate.net.wires import wire_named
from zstate.rate import Rate
from zstate.record.scribe import Scribe
from zstate.record.writer import RecordWriter
from zstate.wire.keys import ANY, Stream, check_robot
from zstate.wire.messages import Clock, Message, Sample
from zstate.wire.protocol import SerializedSample, Wire
from zstate.wire.ros2.topics import SHARED
from zstate.wire.writer import Announced

FLUSH_NS = 500_000_000
"""So often all that was heard goes to the file, where ``kill -9`` cannot reach it."""

_WRITES_HZ = 20.0
# Who starts together should be seen together: it decides where the robots stand in the file.
_MEETING_NS = 300_000_000
# Closing takes a second at most, subscriptions included.
_LAST_WORDS_S = 0.5
_JOIN_WITHIN_S = 0.9

LARGE_BYTES = 1 << 16
"""Latched values from this size on are decoded and encoded in a thread of their own."""
_LARGE_WAITING_BYTES = 1 << 26

_LATCHED: tuple[Stream, ...] = ("robot_description", "tf_static")
_SAMPLES: tuple[Stream, ...] = ("joint_states", "tf")


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """Counts since the recorder opened.

    ``messages`` were written, by robot and stream (the clock is of the robot "ros"); ``bytes`` is the
    size of all ``files``. Messages were ``dropped`` by our own full ring, as too much waited or as the
    recording ended, ``missed`` between the writers' sequence numbers, ``unwritten`` for want of a
    description that fits; ``refused`` says why others could not be written.
    """

    messages: Mapping[tuple[str, Stream], int]
    bytes: int
    files: tuple[Path, ...]
    dropped: int
    missed: int
    refused: Mapping[str, int]
    unwritten: int


class Recorder(Closing):
    """Records ``robots``, or all there are, on ``wire`` into ``path``; a context manager.

    Every stream of theirs is heard, /tf too, which their publishers then have to say. A robot that was
    chosen alone, or is the only one when the recording begins, stands in the file's root with its
    frames as they are; others have a namespace and a frame prefix. ``max_bytes``, ``max_seconds`` and
    ``overwrite`` are RecordWriter's. RecordingError when the file cannot be made, InvalidInput for
    names that cannot be.

    When the disk is full or gone, the recording ends by itself: ``wait`` returns, ``failure`` says why,
    and what was written stays readable.
    """

    def __init__(
        self,
        session: Session,
        path: str | os.PathLike[str],
        robots: Sequence[str] = (),
        *,
        wire: str = "native",
        max_bytes: int | None = None,
        max_seconds: float | None = None,
        overwrite: bool = False,
    ) -> None:
        self.failure: Exception | None = None
        chosen = (robots,) if isinstance(robots, str) else tuple(dict.fromkeys(robots))
        self._chosen = tuple(map(check_robot, chosen))
        self._wire = wire_named(wire)
        self._counters = Counters()
        self._gaps = GapCounter(self._counters)
        self._programs: BoundedDict[int, str] = BoundedDict()
        self._announced: set[str] = set()
        self._held: list[Heard] = []
        self._ends_at = math.inf
        self._begins_at: int | None = None
        self._scribe: Scribe | None = None
        self._closing = new_lock()
        self._stop = outlive_fork(threading.Event())
        self._ended = outlive_fork(threading.Event())
        self._large = _Large(self._write_large, self._counters)
        with ExitStack() as opening:
            self._inbox = opening.enter_context(Inbox(session))
            robot = self._chosen[0] if len(self._chosen) == 1 else ANY
            opening.enter_context(watch(session, robot, self._on_writer, wire))
            _subscribe(self._inbox, self._wire, self._chosen)
            for robot in self._chosen or (ANY,):
                for announcement in announce_reader(session, self._wire, robot, (*_LATCHED, *_SAMPLES)):
                    opening.enter_context(announcement)
            self._writer = RecordWriter(
                path, max_bytes=max_bytes, max_seconds=max_seconds, overwrite=overwrite
            )
            self._opened = opening.pop_all()
        self._pid = os.getpid()
        # Before sessions are closed at the end of a program that forgets to close: the file is finished.
        atexit.register(self.close)
        self._thread = threading.Thread(target=self._run, name="zstate recorder", daemon=True)
        self._thread.start()

    @property
    def stats(self) -> RecorderStats:
        """What has been written, lost and refused so far."""
        heard, scribe, writer = self._counters.stats(), self._scribe, self._writer
        return RecorderStats(
            messages={} if scribe is None else scribe.messages,
            bytes=writer.size,
            files=writer.files,
            dropped=heard.dropped,
            missed=heard.missed,
            refused=heard.refused,
            unwritten=0 if scribe is None else scribe.unwritten,
        )

    def wait(self, timeout_s: float | None = None) -> bool:
        """Block until the recording has ended, or for ``timeout_s``; whether it has ended.

        Raises Closed in a forked process, where the recorder does not run.
        """
        if os.getpid() != self._pid:
            raise Closed(forked_text(f"this recorder belongs to process {self._pid}"))
        return wait_in_slices(self._ended, timeout_s)

    def close(self) -> None:
        """End the recording within a second: what was heard is written, and the file finished."""
        atexit.unregister(self.close)
        self._stop_hearing()
        self._ends_at = min(self._ends_at, time.monotonic() + _LAST_WORDS_S)
        self._stop.set()
        self._thread.join(_JOIN_WITHIN_S)

    def _stop_hearing(self) -> None:
        with self._closing:
            self._opened.close()

    def _on_writer(self, announced: Announced, alive: bool) -> None:
        if alive:
            self._programs[announced.writer.session] = str(announced.writer)
            if not self._chosen:
                self._announced.add(announced.robot)

    def _run(self) -> None:
        try:
            self._write_until_stopped()
        except Exception as error:  # whatever it is, it must not pass in silence
            self.failure = error
            self._stop_hearing()
        finally:
            self._large.close()
            self._ended.set()

    def _write_until_stopped(self) -> None:
        flushed = 0
        for now in Rate(_WRITES_HZ, SystemClock(), self._stop):
            self._write_heard()
            if now // FLUSH_NS != flushed:
                flushed = now // FLUSH_NS
                self._writer.flush()
            if self._large.failure is not None:
                raise self._large.failure
        self._write_heard()
        self._large.finish(self._ends_at)
        self._writer.close()

    def _write_heard(self) -> None:
        self._held += self._inbox.take()
        if self._scribe is None:
            self._scribe = self._new_scribe()
        if self._scribe is None:
            return
        for heard in self._held:
            self._write(self._scribe, heard)
        self._held = []

    def _new_scribe(self) -> Scribe | None:
        """None while it cannot be told yet which robots the recording begins with."""
        robots = set(self._chosen) or self._robots_so_far()
        if not self._chosen:
            if robots and self._begins_at is None:
                self._begins_at = time.monotonic_ns() + _MEETING_NS
            is_met = self._begins_at is not None and time.monotonic_ns() >= self._begins_at
            if not is_met and not self._stop.is_set():
                return None
        named = robots - {SHARED}
        alone = named.pop() if len(named) == 1 else None
        return Scribe(self._writer, self._counters.count_refusal, alone=alone, programs=self._programs)

    def _robots_so_far(self) -> set[str]:
        held = (heard for heard in self._held if heard.stream != "clock")
        robots = {self._robot(heard, arrival) for heard in held for arrival in heard.arrivals}
        return {robot for robot in robots if robot is not None} | self._announced.copy()

    def _write(self, scribe: Scribe, heard: Heard) -> None:
        self._gaps.start_batch(overflowed=heard.overflowed)
        for arrival in heard.arrivals:
            if time.monotonic() > self._ends_at:
                self._counters.count("dropped")
                continue
            robot = self._robot(heard, arrival)
            if robot is None:
                continue
            if heard.stream in _LATCHED and self._large.takes(robot, len(arrival.payload)):
                self._large.put(robot, heard, arrival)
            else:
                self._write_arrival(scribe, heard, robot, arrival)

    def _write_large(self, robot: str, heard: Heard, arrival: SerializedSample) -> None:
        assert self._scribe is not None
        self._write_arrival(self._scribe, heard, robot, arrival)

    def _write_arrival(self, scribe: Scribe, heard: Heard, robot: str, arrival: SerializedSample) -> None:
        stream, stamp = heard.stream, heard.stamp
        static_writer = self._wire.statics_writer(arrival.key) if stream == "tf_static" else None
        if not arrival.payload and stream in _LATCHED:
            if static_writer is not None:
                scribe.withdraw(robot, static_writer, stamp)
            return
        for message in self._decode(stream, arrival, robot):
            is_known = scribe.take(robot, message, stamp, static_writer)
            if is_known and isinstance(message, Sample | Clock):
                self._gaps.add((robot, stream, message.session), message.seq)

    def _robot(self, heard: Heard, arrival: SerializedSample) -> str | None:
        try:
            if heard.stream == "tf_static":
                self._wire.statics_writer(arrival.key)  # refuses a key that has none
            return self._wire.robot_of(arrival.key) if heard.robot is None else heard.robot
        except InvalidInput as error:
            self._counters.count_refusal("foreign", str(error))
            return None

    def _decode(self, stream: Stream, arrival: SerializedSample, robot: str) -> Sequence[Message]:
        try:
            return self._wire.decode(stream, arrival, robot)
        except MessageError as error:
            self._counters.count_refusal(error.reason, f"{arrival.key}: {error}")
            return ()


class _Large:
    """Large latched values, written in a thread of their own, so that samples are written meanwhile.

    A latched value that follows a large one of the same robot waits behind it. Of more bytes than
    can wait, the oldest values are dropped and counted.
    """

    def __init__(self, write: Callable[[str, Heard, SerializedSample], None], counters: Counters) -> None:
        self.failure: Exception | None = None
        self._write = write
        self._counters = counters
        self._waiting: deque[tuple[str, Heard, SerializedSample]] = deque()
        self._bytes = 0
        self._behind: Counter[str] = Counter()
        self._changed = outlive_fork(threading.Condition())
        self._is_open = True
        self._thread: threading.Thread | None = None

    def takes(self, robot: str, size: int) -> bool:
        """Whether a latched value of ``robot`` with so many bytes is written here."""
        return size >= LARGE_BYTES or self._behind[robot] > 0

    def put(self, robot: str, heard: Heard, arrival: SerializedSample) -> None:
        """Write it later."""
        with self._changed:
            self._waiting.append((robot, heard, arrival))
            self._behind[robot] += 1
            self._bytes += len(arrival.payload)
            while self._bytes > _LARGE_WAITING_BYTES and len(self._waiting) > 1:
                self._drop_oldest()
            self._changed.notify_all()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="zstate recorder latched", daemon=True)
            self._thread.start()

    def finish(self, until_s: float) -> None:
        """Wait until all is written, or the monotonic clock reads ``until_s``; the rest is dropped."""
        with self._changed:
            self._changed.wait_for(lambda: not +self._behind, max(0.0, until_s - time.monotonic()))
        self.close()
        if self.failure is not None:
            raise self.failure

    def close(self) -> None:
        """Write nothing more."""
        with self._changed:
            self._is_open = False
            while self._waiting:
                self._drop_oldest()
            self._changed.notify_all()

    def _drop_oldest(self) -> None:
        robot, _, arrival = self._waiting.popleft()
        self._bytes -= len(arrival.payload)
        self._behind[robot] -= 1
        self._counters.count("dropped")

    def _run(self) -> None:
        while (taken := self._take()) is not None:
            robot, heard, arrival = taken
            try:
                self._write(robot, heard, arrival)
            except RecordingError as error:
                if self._is_open:  # else the recording ended first
                    self.failure = error
                self._counters.count("dropped")
            except Exception as error:  # it ends the recording, as it would in its own thread
                self.failure = error
            with self._changed:
                self._behind[robot] -= 1
                self._changed.notify_all()

    def _take(self) -> tuple[str, Heard, SerializedSample] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or not self._is_open)
            if not self._is_open:
                return None
            taken = self._waiting.popleft()
            self._bytes -= len(taken[2].payload)
            return taken


def _subscribe(inbox: Inbox, wire: Wire, robots: Sequence[str]) -> None:
    """Hear every stream; where two robots share an expression, its keys tell them apart."""
    for stream in (*_LATCHED, *_SAMPLES):
        speakers: dict[str, set[str]] = {}
        for robot in robots or (ANY,):
            speakers.setdefault(wire.expression(robot, stream), set()).add(robot)
        hear = inbox.hear_latched if stream in _LATCHED else inbox.hear
        for expression, named in speakers.items():
            hear(stream, expression, named.pop() if robots and len(named) == 1 else None)
    inbox.hear("clock", wire.expression(robots[0] if robots else ANY, "clock"), SHARED)
