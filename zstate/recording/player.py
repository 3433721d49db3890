"""Plays a recording back onto the network with its own stamps (rosbag2's Player)."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.clock import Clock, SystemClock
from zstate.errors import InvalidInput
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.nodes.clock import ClockPublisher
from zstate.recording.decode import (
    LATCHED,
    DecodedRecording,
    LatchedState,
    check_has_robot,
    first_descriptions,
    recorded_model,
)
from zstate.recording.joint_parts import has_parts
from zstate.recording.playback_publishers import PlaybackPublishers
from zstate.recording.player_clock import Lateness, PlayerClock
from zstate.recording.reader import RecordingReader
from zstate.wire.messages import ClockMessage, Sample
from zstate.wire.registry import as_wire_names

CLOCK_HZ = 100.0
"""Rate at which the player publishes the clock if the recording has no clock messages."""

_ENDS_WITHIN_S = 1.0


@dataclass(frozen=True, slots=True)
class PlayerReport:
    """Progress of a playback.

    ``samples`` were published, ``passes`` started. ``rate`` was achieved: recorded seconds per second,
    without pauses. Lateness [ns]: at most ``lateness_p50`` for half of the samples, ``lateness_p99`` for 99
    of 100 (of the last 65536), ``lateness_max`` for all. ``delays`` counts the times that playback was more
    than a second late, and continued from there. ``refused`` counts unpublished messages, by reason.
    """

    samples: int
    passes: int
    rate: float
    lateness_p50: int
    lateness_p99: int
    lateness_max: int
    delays: int
    refused: Mapping[str, int]


class Player(Closeable):
    """Publishes the recorded messages of ``robots``, or of all robots, as when they were recorded.

    Stamps are those of the recording, and so is the spacing, divided by ``rate`` (inf: as fast as possible).
    Playback starts ``start_s`` [s] after the first message, with the descriptions and static edges in effect
    at that point, and lasts ``duration_s`` of the recording. With ``loop`` it restarts at its end; each pass
    has new writers, as stamps step back. The recording's time is published on the clock.

    Robots with a recorded model are published by a StatePublisher, other messages unchanged, such as the
    joint states of several drivers of a robot, each by a writer of the recorded name. Raises RecordingError,
    and InvalidInput for robots and times that are not in the recording. A context manager; ``run`` plays,
    other threads may pause and seek. ``run`` raises SecondWriter if another writer publishes one of the
    robots, unless ``takeover``.
    """

    def __init__(
        self,
        session: Session,
        path: str | Path,
        robots: Sequence[str] = (),
        *,
        wires: str | Sequence[str] = ("native",),
        rate: float = 1.0,
        start_s: float = 0.0,
        duration_s: float | None = None,
        loop: bool = False,
        clock: Clock | None = None,
        takeover: bool = False,
    ) -> None:
        self.rate = rate
        self._session = session
        self._wires = as_wire_names(wires)
        self._loop = loop
        self._takeover = takeover
        self._player_clock = PlayerClock(clock or SystemClock(), rate)
        self._lateness = Lateness()
        self._refusals = Refusals()
        self._wake, self._running = threading.Event(), threading.Lock()
        self._is_open, self._is_paused = True, False
        self._target: int | None = None
        self._samples = self._passes = 0
        self._reader = RecordingReader(path)
        try:
            self._recording = DecodedRecording(self._reader, self._refusals.count)
            selected = tuple(check_has_robot(self._recording, robot) for robot in robots)
            self.robots = selected or self._recording.robots
            self._begin, self._end = self._bounds(path, start_s, duration_s)
            self._models: dict[str, RobotModel] = {}
            self._in_parts: set[str] = set()
            for robot, description in first_descriptions(self._recording, self.robots).items():
                model = recorded_model(self._recording, description, self._refusals.count)
                if model is not None:
                    self._models[robot] = model
                    if has_parts(self._recording, robot, model):
                        self._in_parts.add(robot)
        except BaseException:
            self._reader.close()
            raise
        self._position = self._begin

    def _bounds(self, path: str | Path, start_s: float, duration_s: float | None) -> tuple[int, int]:
        span = self._reader.span
        if span is None or not self.robots:
            raise InvalidInput(f"there is nothing in {str(path)!r} to replay")
        length_s = (span[1] - span[0]) / 1e9
        if not 0.0 <= start_s <= length_s:
            raise InvalidInput(f"start_s is {start_s:g}; the recording is {length_s:g} s long")
        if duration_s is not None and not (math.isfinite(duration_s) and duration_s > 0.0):
            raise InvalidInput(f"duration_s is a positive number of seconds, not {duration_s!r}")
        begin = span[0] + round(start_s * 1e9)
        last = span[1] if duration_s is None else min(span[1], begin + round(duration_s * 1e9))
        return begin, last + 1

    @property
    def span(self) -> tuple[int, int]:
        """The log times [ns] of the first and the last instant that are played."""
        return self._begin, self._end - 1

    @property
    def position(self) -> int:
        """The log time [ns] of the newest message that was published."""
        return self._position

    @property
    def is_paused(self) -> bool:
        """Whether playback waits for ``resume``."""
        return self._is_paused

    def report(self) -> PlayerReport:
        """Progress so far."""
        lateness = self._lateness
        return PlayerReport(
            samples=self._samples,
            passes=self._passes,
            rate=self._player_clock.achieved,
            lateness_p50=lateness.quantile(0.5),
            lateness_p99=lateness.quantile(0.99),
            lateness_max=lateness.largest,
            delays=self._player_clock.delays,
            refused=dict(self._refusals.counts),
        )

    def run(self) -> PlayerReport:
        """Play until the end or ``close()``. One thread at a time."""
        with self._running:
            while self._is_open:
                target, self._target = self._target, None
                self._play(self._begin if target is None else target)
                if self._target is None and not self._loop:
                    break
            self._player_clock.pause()
        return self.report()

    def pause(self) -> None:
        """Publish nothing but the clock until ``resume``."""
        self._is_paused = True
        self._wake.set()

    def resume(self) -> None:
        """Continue after ``pause``."""
        self._is_paused = False
        self._wake.set()

    def seek(self, log_time: int) -> None:
        """Continue from ``log_time`` [ns] in ``span``, with new writers. Raises InvalidInput."""
        if not self._begin <= log_time < self._end:
            raise InvalidInput(f"{log_time} is not between {self._begin} and {self._end - 1}")
        self._target = log_time
        self._wake.set()

    def close(self) -> None:
        """End ``run``. A second call does nothing."""
        self._is_open = False
        self._wake.set()
        # Not while it is being read; a run ends at once, unless a signal interrupted it.
        if self._running.acquire(timeout=_ENDS_WITHIN_S):
            self._reader.close()
            self._running.release()

    def _play(self, begin: int) -> None:
        """Play one pass from ``begin`` to the end, unless it is closed or seeks."""
        self._passes += 1
        self._position = begin
        writers = self._recording.writers_of(self.robots)
        latched = LatchedState()
        for decoded in self._recording.messages(self.robots, LATCHED, end=begin):
            latched.update(decoded)
        with (
            PlaybackPublishers(
                self._session,
                self._wires,
                writers,
                models=self._models,
                in_parts=self._in_parts,
                latched=latched,
                refusals=self._refusals,
                takeover=self._takeover,
            ) as publishers,
            ClockPublisher(self._session, self._wires) as clock,
        ):
            self._player_clock.start(begin)
            has_clock = any(writer.stream == "clock" for writer in writers)
            ticks = None if has_clock else _ClockTicks(clock, begin, self._player_clock.rate)
            for decoded in self._recording.messages(self.robots, begin=begin, end=self._end):
                while ticks is not None and ticks.next <= decoded.log_time:
                    if not self._reach(ticks.next, ticks):
                        return
                    ticks.publish(decoded.log_time)
                if not self._reach(decoded.log_time, ticks):
                    return
                lateness = self._player_clock.lateness(decoded.log_time)
                if isinstance(decoded.message, ClockMessage):
                    clock.publish(decoded.message.stamp)
                elif publishers.publish(decoded) and isinstance(decoded.message, Sample):
                    self._samples += 1
                    self._lateness.add(lateness)

    def _reach(self, log_time: int, ticks: _ClockTicks | None) -> bool:
        """Wait until ``log_time``; False when this pass is over."""
        while True:
            # Cleared first: a request after these checks wakes the wait.
            self._wake.clear()
            if not self._is_open or self._target is not None:
                return False
            if self._is_paused:
                self._player_clock.pause()
                while not self._wake.wait(1.0 / CLOCK_HZ):
                    if ticks is not None:
                        ticks.clock.publish(self._position)
                self._player_clock.start(self._position)
            elif self._player_clock.wait(log_time, self._wake):
                self._position = log_time
                return True


class _ClockTicks:
    """Publishes the clock at CLOCK_HZ, in the time of the recording; ``next`` is the next tick."""

    def __init__(self, clock: ClockPublisher, begin: int, rate: float) -> None:
        self.next = begin
        self.clock = clock
        self._is_paced = math.isfinite(rate)
        self._step = round(1e9 / CLOCK_HZ * (rate if self._is_paced else 1.0)) or 1

    def publish(self, ahead: int) -> None:
        """Publish ``next``; no message is published before ``ahead``."""
        # At an infinite rate nothing waits through a gap.
        now = self.next if self._is_paced else ahead
        self.clock.publish(now)
        self.next = now + self._step
