"""OffClock: samples whose stamps are far from the time here. They are used like any other, and named."""

from __future__ import annotations

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import SYSTEM, stamp_text
from zstate.errors.times import counts_from_start, duration_text, unit_mistaken
from zstate.following.bounded import remember
from zstate.following.lag import LATE_NS, Lag, program_of, samples_of
from zstate.following.tally import Tally
from zstate.wire.messages import Sample, TransformSample

FAR_NS = 60_000_000_000
"""A sample was not held up for so long by any network, and clocks that disagree so much were never set."""

_HOUR_NS = 3_600_000_000_000
_EVERYTHING = (-(2**63), 2**63)


class OffClock:
    """Counts them in ``off_clock``, and logs the first of each program that writes a robot's samples.

    Those that are late, but not by so much, are given to a ``Lag``.

    ``is_described`` says that robots tell whose time they keep, so that one which has not yet may.
    """

    def __init__(self, buffer: TransformBuffer, tally: Tally, *, is_described: bool) -> None:
        self._buffer = buffer
        self._tally = tally
        self._is_described = is_described
        self._reported: dict[tuple[str, str], None] = {}
        self._lag = Lag(tally)

    def look(self) -> tuple[int, int]:
        """The stamps [ns] between which nothing need be noted, as of now."""
        clock = self._buffer.clock
        if clock.domain != SYSTEM:
            return _EVERYTHING
        now = clock.now()
        return now - LATE_NS, now + FAR_NS

    def note(self, robot: str, writer: str | None, sample: Sample) -> None:
        """A sample outside of that."""
        if not self._keeps_system_time(robot, sample):
            return
        now = self._buffer.clock.now()
        if abs(sample.stamp - now) <= FAR_NS:
            self._lag.note(robot, writer, now - sample.stamp, now)
            return
        self._tally.of(robot).count("off_clock")
        # Not by session: a writer that is restarted with each sample would be logged each time.
        key = (robot, program_of(writer))
        if key not in self._reported:
            remember(self._reported, key, None)
            text = _text(samples_of(robot, writer), sample.stamp, now)
            self._tally.note(f"off clock {' '.join(key)}", text)

    def _keeps_system_time(self, robot: str, sample: Sample) -> bool:
        kept = self._buffer.domain.domain_of(robot)
        if kept is None and self._is_described:
            # Whose time it is stands in the description, which is on its way, or will never come.
            return isinstance(sample, TransformSample) and sample.edges is not None
        return kept in (None, "", SYSTEM)


def likely_cause(stamp: int, now: int) -> str:
    """What makes writers stamp ``stamp`` when it is ``now`` [ns]."""
    if unit := unit_mistaken(stamp, now):
        return f"the writer gives {unit} where nanoseconds are meant"
    if counts_from_start(stamp):
        return (
            "1970 and after: the writer stamps with the time since it was switched on, its machine has no "
            "clock that was set, or this is simulated time (then both sides need `--clock sim`)"
        )
    hours, rest = divmod(stamp - now + FAR_NS, _HOUR_NS // 2)
    if rest < 2 * FAR_NS and abs(hours) <= 28:
        return "whole hours: the writer takes its local time for UTC, or the other way round"
    return "the clock of one of the two machines was never set (NTP); or what comes is a recording"


def _text(whose: str, stamp: int, now: int) -> str:
    return (
        f"{whose} are stamped {_apart(stamp - now)} this machine's time "
        f"({stamp_text(stamp)}): {likely_cause(stamp, now)}; they are used and counted in off_clock"
    )


def _apart(offset_ns: int) -> str:
    return f"{duration_text(abs(offset_ns))} {'after' if offset_ns > 0 else 'before'}"
