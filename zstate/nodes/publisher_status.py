"""Publisher counters, and the health level derived from them once a second."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import InvalidInput, format_duration
from zstate.model.joint_limits import JointLimits
from zstate.rate import RateReport
from zstate.streams import StreamName
from zstate.wire.identity import WriterId
from zstate.wire.messages import Level, Status, from_block

_LOG = logging.getLogger("zstate")

_QUIET_NS = 2_000_000_000
"""A publisher without a commanded rate is stale after this long without a sample."""

_CHECKED_EVERY_NS, _CHECKED_AT_ONCE = 1_000_000_000, 250
"""Positions are checked against joint limits in groups of one second, at most 250 samples."""

ARE_OUTSIDE = "samples are outside joint limits"
"""Part of the text of a ``Status`` that warns about joint limits."""


class StreamStats(NamedTuple):
    """Counts of one stream on one wire; ``suppressed`` samples had no reader and were not sent."""

    samples: int
    bytes: int
    suppressed: int


@dataclass(frozen=True, slots=True)
class PublisherStats:
    """Counts since the publisher opened.

    ``sent`` samples were published, ``refused`` ones were not; ``last_refusal`` is the newest reason.
    ``streams`` has the counts by (wire, stream). ``rate`` is the report of the last ``run``, None before
    the first. ``outside_limits`` published samples had joints outside their limits, the newest described
    by ``last_excess``. ``kinematics`` is what computes transforms: "Pinocchio 4.1.0", for instance, or
    "closed forms"; empty without the stream tf. ``warning`` is that of the program that publishes, empty
    for none.
    """

    sent: int
    refused: int
    last_refusal: str
    streams: Mapping[tuple[str, StreamName], StreamStats]
    rate: RateReport | None
    outside_limits: int = 0
    last_excess: str = ""
    kinematics: str = ""
    warning: str = ""

    def _repr_html_(self) -> str:
        from zstate._util.html import html_of_fields  # noqa: PLC0415 - for notebooks alone

        return html_of_fields(self)


class RefusalCount:
    """Counts each InvalidInput that is raised inside ``with`` it; ``newest`` is the text of the last one."""

    count = 0
    newest = ""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if isinstance(error, InvalidInput):
            self.newest = str(error)
            self.count += 1


class LimitWatch:
    """Counts the samples whose positions exceed joint limits, and logs the first.

    The first sample is checked at once, later ones in groups, which takes about 0.3 us per sample. Publishers
    call it without a lock: a handler of the warning may publish, or close the publisher. ``positions`` reads
    the block of positions in a sample; by default it is the sample.
    """

    def __init__(
        self, limits: JointLimits, robot: str, positions: Callable[[bytes], bytes | memoryview] = bytes
    ) -> None:
        self._count = 0
        self._last = ""
        self._lock = fork_safe_lock()
        self._limits, self._robot, self._positions = limits, robot, positions
        self._samples: list[bytes] = []
        self._began = self._due = 0

    def add(self, stamp: int, sample: bytes) -> None:
        """Count the ``sample`` with ``stamp`` [ns], now or with its group."""
        with self._lock:
            self._samples.append(sample)
            if self._began <= stamp < self._due and len(self._samples) < _CHECKED_AT_ONCE:
                return
            self._began, self._due = stamp, stamp + _CHECKED_EVERY_NS
            first = self._check()
        self._log(first)

    def add_outside(self, sample: bytes) -> None:
        """Count a ``sample`` that is known to be outside: the first now."""
        with self._lock:
            self._samples.append(sample)
            is_due = not self._count or len(self._samples) >= _CHECKED_AT_ONCE
            first = self._check() if is_due else ""
        self._log(first)

    def counted(self) -> tuple[int, str]:
        """How many samples were outside until now, and the joints of the newest."""
        with self._lock:
            first = self._check() if self._samples else ""
            counted = self._count, self._last
        self._log(first)
        return counted

    def _log(self, first: str) -> None:
        if first:
            _LOG.warning("%s: %s; further samples outside limits are only counted", self._robot, first)

    def _check(self) -> str:
        """Count the samples that are outside; the text of the first ever, else empty."""
        block = b"".join(map(self._positions, self._samples))
        positions = from_block(block).reshape(len(self._samples), -1)
        self._samples.clear()
        # Usually nothing is outside, and these two rows are sufficient to show it.
        extremes = np.stack((positions.min(axis=0), positions.max(axis=0)))
        if not self._limits.are_exceeded(extremes).any():
            return ""
        are_exceeded = self._limits.are_exceeded(positions)
        self._last = self._limits.explanation(positions[are_exceeded][-1:])
        first = "" if self._count else self._last
        self._count += int(are_exceeded.sum())
        return first


class Health(NamedTuple):
    """A level and the reason for it."""

    level: Level
    text: str = ""


class StatusReporter:
    """Derives a ``Status`` from a publisher's counts, each time from their change since the last one."""

    def __init__(self, writer: WriterId, stats: Callable[[], PublisherStats]) -> None:
        self._writer = writer
        self._read = stats
        self._stats = stats()
        self._at_ns = self._sent_at_ns = time.monotonic_ns()

    def status(self) -> Status:
        """The status of the time since the last call."""
        before, now, at_ns = self._stats, self._read(), time.monotonic_ns()
        if now.sent > before.sent:
            self._sent_at_ns = at_ns
        rate_hz = (now.sent - before.sent) * 1e9 / max(at_ns - self._at_ns, 1)
        level, text = assess_health(before, now, quiet_ns=at_ns - self._sent_at_ns)
        self._stats, self._at_ns = now, at_ns
        values = {"refused": str(now.refused)}
        if now.warning:
            values["warning"] = now.warning
        if now.outside_limits:
            values["outside limits"] = f"{now.outside_limits} samples, {now.last_excess}"
        if now.rate is not None:
            values |= {"commanded": f"{now.rate.commanded_hz:g} Hz", "skipped": str(now.rate.skipped)}
        for (wire, stream), counts in now.streams.items():
            values[f"{wire} {stream}"] = f"{counts.samples} samples, {counts.bytes} bytes"
        writer, late = self._writer, now.rate.late if now.rate else 0
        head = (time.time_ns(), writer.session, level, writer.program, writer.host, writer.pid)
        return Status(*head, rate_hz, now.sent, late, text, values)


def assess_health(before: PublisherStats, now: PublisherStats, *, quiet_ns: int) -> Health:
    """The health of a publisher between two readings of its counts, ``quiet_ns`` after its last sample."""
    sent, refused = now.sent - before.sent, now.refused - before.refused
    if refused:
        text = f"{refused} of {sent + refused} samples cannot be published: {now.last_refusal}"
        return Health("warn" if sent else "error", text)
    longest_ns = _QUIET_NS if now.rate is None else max(_QUIET_NS, 2e9 / now.rate.commanded_hz)
    if quiet_ns > longest_ns:
        what = "since this publisher opened" if not now.sent else f"for {format_duration(quiet_ns)}"
        reason = f": {now.warning}" if now.warning else ""
        return Health("stale", f"nothing was published {what}{reason}")
    if now.warning:
        return Health("warn", now.warning)
    outside = now.outside_limits - before.outside_limits
    if outside:
        return Health("warn", f"{outside} {ARE_OUTSIDE}: {now.last_excess}")
    if now.rate is not None:
        late = now.rate.late - (before.rate.late if before.rate else 0)
        skipped = now.rate.skipped - (before.rate.skipped if before.rate else 0)
        if late > 0 or skipped > 0:
            text = (
                f"{late} ticks late and {skipped} skipped: {now.rate.commanded_hz:g} Hz are more than this "
                "process keeps; its source or its machine is slow"
            )
            return Health("warn", text)
    return Health("ok")
