"""Checks of sample stamps against the clock here. Samples that fail are inserted all the same."""

from __future__ import annotations

from dataclasses import dataclass

from zstate._util.bounded import BoundedDict
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.format import counts_from_start, format_duration, guess_unit
from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.clock import FAR_NS, LATE_NS, SYSTEM, format_stamp
from zstate.ingest.counters import Counters
from zstate.wire.messages import Sample, TransformSample

_LAG_GROWTH_NS = 1_000_000_000

# After this long without a late sample, later ones are another backlog, for instance of another cut.
_BACKLOG_PAUSE_NS = 2_000_000_000

_HOUR_NS = 3_600_000_000_000
_ANY_STAMP = (-(2**63), 2**63)


class StampCheck:
    """Counts samples stamped more than a minute from now in ``off_clock``; warns once for each program.

    Samples that are late by less are passed to a ``LagDetector``. ``is_described`` means that robots publish
    descriptions, which name their clock: a robot without one yet is not checked. Any thread may call it.
    """

    def __init__(self, buffer: TransformBuffer, counters: Counters, *, is_described: bool) -> None:
        self._buffer = buffer
        self._domain = feed_of(buffer).domain
        self._counters = counters
        self._is_described = is_described
        self._reported: BoundedDict[tuple[str, str], None] = BoundedDict()
        self._lock = fork_safe_lock()
        self._lag = LagDetector(counters)

    def accepted_range(self) -> tuple[int, int]:
        """The earliest and latest stamp [ns] that need no check, as of now."""
        clock = self._buffer.clock
        if clock.domain != SYSTEM:
            return _ANY_STAMP
        now = clock.now()
        return now - LATE_NS, now + FAR_NS

    def check(self, robot: str, writer: str | None, sample: Sample) -> None:
        """Check a sample outside the accepted range."""
        domain = self._domain.domain_of(robot)
        if domain is None and self._is_described:
            # The description names the clock, and may not have arrived yet.
            is_on_system_clock = isinstance(sample, TransformSample) and sample.edges is not None
        else:
            is_on_system_clock = domain in (None, "", SYSTEM)
        if not is_on_system_clock:
            return
        now = self._buffer.clock.now()
        if abs(sample.stamp - now) <= FAR_NS:
            self._lag.add(robot, writer, sample, now)
            return
        self._counters.for_robot(robot).count("off_clock")
        # By program, not by session: a writer that restarts with each sample would be logged each time.
        key = (robot, _program(writer))
        with self._lock:
            is_first = key not in self._reported
            self._reported[key] = None
        if is_first:
            offset = sample.stamp - now
            self._counters.warn_once(
                f"off clock {' '.join(key)}",
                f"{_samples_text(robot, writer)} are stamped {format_duration(abs(offset))} "
                f"{'after' if offset > 0 else 'before'} this machine's time ({format_stamp(sample.stamp)}): "
                f"{likely_cause(sample.stamp, now)}; they are used and counted in off_clock",
            )


@dataclass(slots=True)
class _Backlog:
    """Late samples of the same edges or joints.

    ``least_ns`` is the least age, and ``new_ns`` that of the first sample with the ``stamp`` of the last one,
    which arrived at ``last_ns``.
    """

    least_ns: int
    new_ns: int
    stamp: int
    last_ns: int
    is_reported: bool = False


class LagDetector:
    """Warns once for each program when the age of its samples at arrival has grown by more than a second.

    Only growth counts, because the clocks of both sides may disagree. The burst after a network cut begins
    with its oldest sample, so its age only falls. A stamp before the last one is that of a clock that was set
    back, which is no backlog, and if all stamps are the same the writer's source stands still. Any thread may
    call it.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        # One writer may stamp some edges later than others, for instance those from a slow camera.
        self._backlogs: BoundedDict[tuple[str, int, bytes], _Backlog] = BoundedDict()
        self._lock = fork_safe_lock()

    def add(self, robot: str, writer: str | None, sample: Sample, now_ns: int) -> None:
        """Add a late sample of ``writer``, which arrived at ``now_ns``."""
        key, age_ns = (robot, sample.session, sample.order), now_ns - sample.stamp
        with self._lock:
            backlog = self._backlogs.get(key)
            if backlog is None or now_ns - backlog.last_ns > _BACKLOG_PAUSE_NS:
                is_reported = backlog is not None and backlog.is_reported
                self._backlogs[key] = _Backlog(age_ns, age_ns, sample.stamp, now_ns, is_reported)
                return
            if age_ns < backlog.least_ns or sample.stamp < backlog.stamp:
                backlog.least_ns = age_ns
            if sample.stamp != backlog.stamp:
                backlog.stamp, backlog.new_ns = sample.stamp, age_ns
            backlog.last_ns, least_ns = now_ns, backlog.least_ns
            stands_still = 2 * (age_ns - backlog.new_ns) > age_ns - least_ns
            if age_ns <= least_ns + _LAG_GROWTH_NS or backlog.is_reported:
                return
            backlog.is_reported = True
        if stands_still:
            text = (
                f"{writer or 'a writer'} of {robot!r} gives every sample the same stamp, "
                f"{format_stamp(sample.stamp)}: its source stands still"
            )
        else:
            text = (
                f"{_samples_text(robot, writer)} come {format_duration(age_ns)} after their stamps, "
                f"{format_duration(least_ns)} shortly before: more is sent than the network carries, or than "
                "this program handles; `zstate monitor` shows where samples wait, and a lower rate helps "
                "either way"
            )
        self._counters.warn_once(f"lag {robot} {_program(writer)}", text)


def likely_cause(stamp: int, now: int) -> str:
    """The likely reason why a writer stamps a sample ``stamp`` at the time ``now`` [ns]."""
    if unit := guess_unit(stamp, now):
        return f"the writer gives {unit} where nanoseconds are meant"
    if counts_from_start(stamp):
        return (
            "1970 and after: the writer stamps with the time since it was switched on, its machine has no "
            "clock that was set, or this is simulated time (then both sides need `--clock sim`)"
        )
    hours, rest = divmod(stamp - now + FAR_NS, _HOUR_NS // 2)
    if rest < 2 * FAR_NS and abs(hours) <= 28:
        return "whole hours: the writer takes its local time for UTC, or the other way round"
    return "the clock of one of the two machines was never set (NTP); or this is a recording played back"


def _program(writer: str | None) -> str:
    """The writer's program and host without its pid; empty if the writer is not announced."""
    name, has_pid, _ = (writer or "").rpartition(" pid ")
    return name if has_pid else writer or ""


def _samples_text(robot: str, writer: str | None) -> str:
    return f"samples of {robot!r}{f', which {writer} writes,' if writer else ''}"
