"""Playback: a recording on the network with its own stamps (rosbag2's Player), or as a joint source.

``Player`` publishes a recording. ``RecordedSource`` is the recorded motion of one robot at the present time.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.clock import Clock, SystemClock
from zstate.errors import InvalidInput, MessageError
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.nodes.clock import ClockPublisher
from zstate.recording.decode import (
    STREAMS,
    DecodedMessage,
    DecodedRecording,
    LatchedState,
    check_has_robot,
    first_descriptions,
    further_streams,
    recorded_model,
    robot_with_joint_states,
)
from zstate.recording.joint_parts import has_parts
from zstate.recording.playback_publishers import PlaybackPublishers
from zstate.recording.player_clock import Lateness, PlayerClock
from zstate.recording.reader import RecordingReader
from zstate.sources.joint_source import JointReading, JointStateValidator
from zstate.stream_registry import latched_streams
from zstate.wire.joint_order import JointNumbers
from zstate.wire.messages import ClockMessage, JointState, StampedMessage
from zstate.wire.registry import as_wire_names
from zstate.wire.ros2.streams import recorded_forms

CLOCK_HZ = 100.0
"""Rate at which the player publishes the clock if the recording has no clock messages."""

_ENDS_WITHIN_S = 1.0

# Stamps that step back further belong to a restarted clock; a late sample is skipped.
_LATE_NS = 10_000_000_000


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
    Playback starts ``start_s`` [s] after the first message, with the descriptions, static edges and maps in
    effect at that point, and lasts ``duration_s`` of the recording. With ``loop`` it restarts at its end;
    each pass has new writers, as stamps step back. The recording's time is published on the clock. Without
    samples (``has_samples``), what is latched stays in effect after the last message, for ``duration_s`` in
    all, by default until ``close``; not at an infinite rate.

    Robots with a recorded model are published by a StatePublisher, other messages unchanged, such as those of
    sensors, maps, odometry, and the joint states of several drivers of a robot, by writers of the recorded
    names; commands, states and stops of drivers are never published, and odometry of ROS nodes, whose edges
    are on /tf, on ROS wires only. Raises RecordingError, and InvalidInput for robots and times that are not
    in the recording. A context manager; ``run`` plays, other threads may pause and seek. ``run`` raises
    SecondWriter if another writer publishes one of the robots, unless ``takeover``.
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
            self.robots = selected or self._recording.names
            streams = {writer.stream for writer in self._recording.writers_of(self.robots)}
            self.has_samples = not streams <= {*latched_streams(), *recorded_forms(), "clock"}
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
        is_endless = duration_s is None and not (loop and self._end - self._begin > 1)
        self._is_held = not self.has_samples and is_endless and math.isfinite(rate)

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
        if duration_s is None:
            return begin, span[1] + 1
        last = begin + round(duration_s * 1e9)
        return begin, (min(span[1], last) if self.has_samples else last) + 1

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

    @property
    def is_held(self) -> bool:
        """Whether playback does not end by itself: there are no samples and no duration."""
        return self._is_held

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
        for decoded in self._recording.messages(self.robots, latched_streams(), end=begin):
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
            streams = (*STREAMS, *further_streams())
            for decoded in self._recording.messages(self.robots, streams, begin, self._end):
                if not self._advance(decoded.log_time, ticks):
                    return
                lateness = self._player_clock.lateness(decoded.log_time)
                if isinstance(decoded.message, ClockMessage):
                    clock.publish(decoded.message.stamp)
                elif publishers.publish(decoded) and isinstance(decoded.message, StampedMessage):
                    self._samples += 1
                    self._lateness.add(lateness)
            if not self.has_samples and self._advance(self._end - 1, ticks) and self._is_held:
                self._hold(ticks)

    def _advance(self, log_time: int, ticks: _ClockTicks | None) -> bool:
        """Publish the clock until ``log_time``; False when this pass is over."""
        while ticks is not None and ticks.next <= log_time:
            if not self._reach(ticks.next, ticks):
                return False
            ticks.publish(log_time)
        return self._reach(log_time, ticks)

    def _hold(self, ticks: _ClockTicks | None) -> None:
        """Publish nothing but the clock, which stands still, until ``close`` or ``seek``."""
        self._player_clock.pause()
        while True:
            self._wake.clear()  # before the checks, as in _reach
            if not self._is_open or self._target is not None:
                return
            if ticks is not None:
                ticks.clock.publish(self._position)
            self._wake.wait(1.0 / CLOCK_HZ)

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


class RecordedSource(Closeable):
    """The recorded motion of ``robot``, shifted to the present: it starts with the first ``read``.

    ``robot`` may be None if the file has joint states of one robot only. ``read`` returns the newest reading
    that is due, stamped as long after the start as it was recorded; ``ended`` is True after the last one. If
    a writer restarted with other stamps, its motion follows at its log times. Unusable states are counted in
    ``refused``, by reason; the first of each is logged.

    Raises RecordingError, and InvalidInput without joint states of ``robot``.
    """

    def __init__(self, path: str | Path, robot: str | None, model: RobotModel) -> None:
        self._refusals = Refusals("recorded joint_states")
        self.refused = self._refusals.counts
        self._states = JointStateValidator(model)
        self._reader = RecordingReader(path)
        try:
            recording = DecodedRecording(self._reader, self._refusals.count)
            self.robot = robot_with_joint_states(recording, robot)
        except BaseException:
            self.close()
            raise
        first, last = self._reader.span or (0, 0)
        self.duration_s = (last - first) / 1e9
        """Length of the recording [s]: by then everything is due."""
        self._messages = recording.messages((self.robot,), ("joint_states",))
        self._shift: _StampShift | None = None
        self._next = self._advance(None)

    @property
    def ended(self) -> bool:
        """Whether everything has been read."""
        return self._next is None

    def read(self, stamp: int) -> JointReading | None:
        """The newest reading that is due at ``stamp`` [ns]; None if no new one is due."""
        newest: JointReading | None = None
        while self._next is not None:
            decoded, numbers = self._next
            self._shift = self._shift or _StampShift(decoded, stamp)
            due = self._shift.shifted(decoded)
            if due > stamp:
                break
            newest = JointReading(*numbers, stamp=due)
            self._next = self._advance(self._shift)
        return newest

    def _advance(self, shift: _StampShift | None) -> tuple[DecodedMessage, JointNumbers] | None:
        for decoded in self._messages:
            assert isinstance(decoded.message, JointState)
            if shift is not None and shift.is_late(decoded):
                continue
            try:
                numbers = self._states.read(decoded.message)
            except MessageError as error:
                self._refusals.count(error.reason, error)
            except InvalidInput as error:
                self._refusals.count("bad numbers", error)
            else:
                return decoded, numbers
        return None

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        self._reader.close()


class _StampShift:
    """Shifts recorded stamps by the distance of the first one from the present."""

    def __init__(self, first: DecodedMessage, now: int) -> None:
        self._session: int = first.writer.session
        self._newest = _stamp(first)
        self._log_time = first.log_time
        self._offset = now - self._newest

    def is_late(self, decoded: DecodedMessage) -> bool:
        """Whether a newer sample of the same session came before."""
        back = self._newest - _stamp(decoded)
        return decoded.writer.session == self._session and 0 <= back <= _LATE_NS

    def shifted(self, decoded: DecodedMessage) -> int:
        """When the sample is due; to be called in the order of the recording."""
        stamp, session = _stamp(decoded), decoded.writer.session
        if stamp < self._newest - _LATE_NS or (session != self._session and stamp <= self._newest):
            before = self._newest + self._offset
            self._offset = before + max(0, decoded.log_time - self._log_time) - stamp
        self._session, self._newest, self._log_time = session, stamp, decoded.log_time
        return stamp + self._offset


def _stamp(decoded: DecodedMessage) -> int:
    assert isinstance(decoded.message, JointState)
    return decoded.message.stamp
