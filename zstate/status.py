"""How a publisher does: its counts, and what a second's worth of them says."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from zstate.errors import duration_text
from zstate.rate import RateReport
from zstate.wire.keys import Stream
from zstate.wire.messages import Level, Status
from zstate.wire.writer import Writer

_QUIET_NS = 2_000_000_000
"""A publisher without a commanded rate is stale after so long without a sample."""


class StreamStats(NamedTuple):
    """What one stream on one wire took: ``suppressed`` samples were not said, since nobody read them."""

    samples: int
    bytes: int
    suppressed: int


@dataclass(frozen=True, slots=True)
class PublisherStats:
    """Counts since the publisher opened.

    ``sent`` samples were published, ``refused`` ones could not be: the last for ``last_refusal``.
    ``streams`` tells by (wire, stream) what each took; ``rate`` how the last ``run`` keeps its rate,
    None before one.
    """

    sent: int
    refused: int
    last_refusal: str
    streams: Mapping[tuple[str, Stream], StreamStats]
    rate: RateReport | None


class Verdict(NamedTuple):
    """A level and the reason for it."""

    level: Level
    text: str = ""


class Beat:
    """Makes of a publisher's counts a ``Status``, each time of what has happened since the last time."""

    def __init__(self, writer: Writer, stats: Callable[[], PublisherStats]) -> None:
        self._writer = writer
        self._read = stats
        self._stats = stats()
        self._at_ns = self._sent_at_ns = time.monotonic_ns()

    def status(self) -> Status:
        """How it does now."""
        before, now, at_ns = self._stats, self._read(), time.monotonic_ns()
        if now.sent > before.sent:
            self._sent_at_ns = at_ns
        rate_hz = (now.sent - before.sent) * 1e9 / max(at_ns - self._at_ns, 1)
        level, text = verdict(before, now, quiet_ns=at_ns - self._sent_at_ns)
        self._stats, self._at_ns = now, at_ns
        writer, late = self._writer, now.rate.late if now.rate else 0
        head = (time.time_ns(), writer.session, level, writer.program, writer.host, writer.pid)
        return Status(*head, rate_hz, now.sent, late, text, _values(now))


def verdict(before: PublisherStats, now: PublisherStats, *, quiet_ns: int) -> Verdict:
    """What two readings of the counts say, when the last sample was seen ``quiet_ns`` ago."""
    sent, refused = now.sent - before.sent, now.refused - before.refused
    if refused:
        text = f"{refused} of {sent + refused} samples cannot be published: {now.last_refusal}"
        return Verdict("warn" if sent else "error", text)
    if quiet_ns > _longest_pause_ns(now.rate):
        what = "since this publisher opened" if not now.sent else f"for {duration_text(quiet_ns)}"
        return Verdict("stale", f"nothing was published {what}")
    return _punctuality(before.rate, now.rate)


def _longest_pause_ns(rate: RateReport | None) -> float:
    return _QUIET_NS if rate is None else max(_QUIET_NS, 2e9 / rate.commanded_hz)


def _punctuality(before: RateReport | None, now: RateReport | None) -> Verdict:
    if now is None:
        return Verdict("ok")
    late = now.late - (before.late if before else 0)
    skipped = now.skipped - (before.skipped if before else 0)
    if late <= 0 and skipped <= 0:
        return Verdict("ok")
    return Verdict(
        "warn",
        f"{late} ticks late and {skipped} skipped: {now.commanded_hz:g} Hz are more than this process keeps; "
        "its source or its machine is slow",
    )


def _values(stats: PublisherStats) -> dict[str, str]:
    values = {"refused": str(stats.refused)}
    if stats.rate is not None:
        values |= {"commanded": f"{stats.rate.commanded_hz:g} Hz", "skipped": str(stats.rate.skipped)}
    for (wire, stream), said in stats.streams.items():
        values[f"{wire} {stream}"] = f"{said.samples} samples, {said.bytes} bytes"
    return values
