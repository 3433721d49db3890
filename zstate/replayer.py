"""Replayer: what a recording holds, said again with its own stamps."""

from __future__ import annotations

import math
import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from zstate._util.refusals import Refusals
from zstate.clock import Clock, SystemClock
from zstate.closing import Closing
from zstate.errors import InvalidInput
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.net.wires import wire_names
from zstate.nodes.clock import ClockPublisher
from zstate.record.models import first_descriptions, model_of
from zstate.record.reader import RecordReader
from zstate.record.transcript import LATCHED, Said, Transcript
from zstate.recording.load import check_has_robot
from zstate.replaying.cast import Cast
from zstate.replaying.pace import Lateness, Pace
from zstate.replaying.standing import Standing
from zstate.wire.messages import Clock as ClockMessage
from zstate.wire.messages import Sample

CLOCK_HZ = 100.0
"""So often the replay says what time it is, where the recording does not say it itself."""

_ENDS_WITHIN_S = 1.0


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """What became of a replay so far.

    ``samples`` were published, ``passes`` begun. ``rate`` is what was achieved: recorded seconds a second,
    pauses apart. Late by [ns]: half of the samples at most ``lateness_p50``, 99 of 100 ``lateness_p99``
    (of the last 65536), all of them ``lateness_max``. ``delays`` counts the times that it fell more than a
    second behind, and went on from there. ``refused`` says why others were not published.
    """

    samples: int
    passes: int
    rate: float
    lateness_p50: int
    lateness_p99: int
    lateness_max: int
    delays: int
    refused: Mapping[str, int]


class Replayer(Closing):
    """Publishes what was recorded of ``robots``, or of all there are, as when it was recorded.

    Stamps are those of the recording, and so is the spacing, divided by ``rate`` (inf: as fast as it can
    be said). It begins ``start_s`` [s] after the first message, with the descriptions and static edges
    as they were then, and lasts ``duration_s`` of the recording. With ``loop`` it begins again at its
    end; each pass has new writers, as stamps go back. The recording's time is said on the clock.

    Robots whose model was recorded go through a StatePublisher, the others are said as they were. Raises
    RecordingError, and InvalidInput for robots and times that the recording does not have. A context
    manager; ``run`` replays, other threads may pause and seek. It raises SecondWriter where somebody
    writes one of the robots now, but with ``takeover``.
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
        self._wires = wire_names(wires)
        self._loop = loop
        self._takeover = takeover
        self._clock: Clock = clock or SystemClock()
        self._pace = Pace(self._clock, rate)
        self._lateness = Lateness()
        self._refusals = Refusals()
        self._wake, self._running = threading.Event(), threading.Lock()
        self._is_open, self._is_paused = True, False
        self._target: int | None = None
        self._samples = self._passes = 0
        self._reader = RecordReader(path)
        try:
            self._transcript = Transcript(self._reader, self._refusals.count)
            chosen = tuple(check_has_robot(self._transcript, robot) for robot in robots)
            self.robots = chosen or self._transcript.robots
            self._begin, self._end = self._bounds(path, start_s, duration_s)
            self._models = dict(self._read_models())
        except BaseException:
            self._reader.close()
            raise
        self._position = self._begin

    def _bounds(self, path: str | Path, start_s: float, duration_s: float | None) -> tuple[int, int]:
        span = self._transcript.span
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

    def _read_models(self) -> Collection[tuple[str, RobotModel]]:
        described = first_descriptions(self._transcript, self.robots)
        models = {r: model_of(self._transcript, said, self._refusals.count) for r, said in described.items()}
        return [(robot, model) for robot, model in models.items() if model is not None]

    @property
    def span(self) -> tuple[int, int]:
        """The log times [ns] of the first and the last instant that are replayed."""
        return self._begin, self._end - 1

    @property
    def position(self) -> int:
        """The log time [ns] of what was said last."""
        return self._position

    @property
    def is_paused(self) -> bool:
        """Whether it waits for ``resume``."""
        return self._is_paused

    def report(self) -> ReplayReport:
        """How it went so far."""
        lateness = self._lateness
        return ReplayReport(
            samples=self._samples,
            passes=self._passes,
            rate=self._pace.achieved,
            lateness_p50=lateness.quantile(0.5),
            lateness_p99=lateness.quantile(0.99),
            lateness_max=lateness.largest,
            delays=self._pace.delays,
            refused=dict(self._refusals.counts),
        )

    def run(self) -> ReplayReport:
        """Replay, until the end or ``close()``. For one thread at a time."""
        with self._running:
            while self._is_open:
                target, self._target = self._target, None
                self._play(self._begin if target is None else target)
                if self._target is None and not self._loop:
                    break
            self._pace.rest()
        return self.report()

    def pause(self) -> None:
        """Say nothing but the time, until ``resume``."""
        self._is_paused = True
        self._wake.set()

    def resume(self) -> None:
        """Go on."""
        self._is_paused = False
        self._wake.set()

    def seek(self, log_time: int) -> None:
        """Go on from ``log_time`` [ns], which lies in ``span``, with new writers. Raises InvalidInput."""
        if not self._begin <= log_time < self._end:
            raise InvalidInput(f"{log_time} is not between {self._begin} and {self._end - 1}")
        self._target = log_time
        self._wake.set()

    def close(self) -> None:
        """End ``run``. A second call does nothing."""
        self._is_open = False
        self._wake.set()
        # Not while it is being read; a run ends at once, but for a signal that interrupted it.
        if self._running.acquire(timeout=_ENDS_WITHIN_S):
            self._reader.close()
            self._running.release()

    def _play(self, begin: int) -> None:
        """One pass from ``begin`` to the end, unless something comes between."""
        self._passes += 1
        self._position = begin
        speakers = self._transcript.concerning(self.robots)
        standing = self._standing(begin)
        with (
            Cast(
                self._session,
                self._wires,
                speakers,
                models=self._models,
                standing=standing,
                refusals=self._refusals,
                takeover=self._takeover,
            ) as cast,
            ClockPublisher(self._session, self._wires) as clock,
        ):
            self._pace.begin(begin)
            has_clock = any(speaker.stream == "clock" for speaker in speakers)
            ticks = None if has_clock else _Ticks(clock, begin, self._pace.rate)
            for said in self._transcript.said(self.robots, begin=begin, end=self._end):
                if not self._wait(said.log_time, ticks):
                    break
                self._say(said, cast, clock)

    def _standing(self, begin: int) -> Standing:
        """What holds at ``begin``."""
        standing = Standing()
        for said in self._transcript.said(self.robots, LATCHED, end=begin):
            standing.take(said)
        return standing

    def _wait(self, log_time: int, ticks: _Ticks | None) -> bool:
        """Wait until ``log_time``, telling the time meanwhile; False when this pass is over."""
        while ticks is not None and ticks.next <= log_time:
            if not self._reach(ticks.next, ticks):
                return False
            ticks.tell(log_time)
        return self._reach(log_time, ticks)

    def _reach(self, log_time: int, ticks: _Ticks | None) -> bool:
        while True:
            # Cleared first: what is asked for after this look wakes the wait.
            self._wake.clear()
            if not self._is_open or self._target is not None:
                return False
            if self._is_paused:
                self._rest(ticks)
            elif self._pace.wait(log_time, self._wake):
                self._position = log_time
                return True

    def _rest(self, ticks: _Ticks | None) -> None:
        self._pace.rest()
        while not self._wake.wait(1.0 / CLOCK_HZ):
            if ticks is not None:
                ticks.repeat(self._position)
        self._pace.begin(self._position)

    def _say(self, said: Said, cast: Cast, clock: ClockPublisher) -> None:
        lateness = self._pace.lateness(said.log_time)
        if isinstance(said.message, ClockMessage):
            clock.publish(said.message.stamp)
        elif cast.take(said) and isinstance(said.message, Sample):
            self._samples += 1
            self._lateness.add(lateness)


class _Ticks:
    """When the time is told next, in the time of the recording."""

    def __init__(self, clock: ClockPublisher, begin: int, rate: float) -> None:
        self.next = begin
        self._clock = clock
        self._is_paced = math.isfinite(rate)
        self._step = round(1e9 / CLOCK_HZ * (rate if self._is_paced else 1.0)) or 1

    def tell(self, ahead: int) -> None:
        """It is ``next``; nothing else is said before ``ahead``."""
        # Without a pace nobody waits through a silence.
        now = self.next if self._is_paced else ahead
        self._clock.publish(now)
        self.next = now + self._step

    def repeat(self, log_time: int) -> None:
        """It still is ``log_time``."""
        self._clock.publish(log_time)
