"""Errors about instants: the frames are joined, and of that moment nothing is known."""

from __future__ import annotations

from zstate.errors.lookup import LookupFailed
from zstate.errors.times import difference_text, duration_text, instant_text

_IN_THEIR_TIME = (
    "; ask in the time that they keep, or for the newest instant (at=None), and let all writers keep one time"
)


class NoData(LookupFailed):
    """An edge of the path has no sample at all, or ``latest`` was asked of static edges only."""

    def explanation(self) -> str:
        if self.edge is None:
            return "every edge of the path is static, so there is no newest instant; ask `lookup` instead"
        if self.newest is not None:
            return f"too little is known of {self._edge_text()}"
        return f"no sample of {self._edge_text()} has arrived yet; is its writer running (`zstate ls`)?"


class _OutsideHistory(LookupFailed):
    """The instant asked for is not among those that samples tell of."""

    @property
    def happening(self) -> str:
        """What happened, with which values, without advice."""
        raise NotImplementedError

    @property
    def is_of_another_time(self) -> bool:
        """Whether what was asked and the samples are stamped by clocks that say nothing of each other."""
        return bool(self._difference)

    @property
    def _difference(self) -> str:
        if self.requested is None or self.newest is None:
            return ""
        return difference_text(self.requested, self.newest)

    @property
    def _has_one_sample(self) -> bool:
        return self.newest is not None and self.oldest == self.newest

    def _told(self, what: str) -> str:
        """``what``, and why the stamps are so far apart where that can be seen."""
        return f"{what}: {self._difference}" if self._difference else what

    def explanation(self) -> str:
        advice = _IN_THEIR_TIME if self._difference else self._advice()
        return f"{self.happening}{advice}{_also(self._clock_text())}"

    def _advice(self) -> str:
        raise NotImplementedError


class InFuture(_OutsideHistory):
    """The instant asked for lies after the newest sample of ``edge``."""

    @property
    def happening(self) -> str:
        which = "only" if self._has_one_sample else "newest"
        return self._told(
            f"asked {_span(self.requested, self.newest)} after the {which} sample of {self._edge_text()}"
        )

    def _advice(self) -> str:
        wait = "" if self.ended else "wait for it (timeout_s=...), "
        return f"; {wait}ask for the newest instant (at=None), or predict (predict_s=...)"


class InPast(_OutsideHistory):
    """The instant asked for lies before the oldest sample of ``edge``; waiting cannot mend it."""

    @property
    def happening(self) -> str:
        which = "only" if self._has_one_sample else "oldest"
        return self._told(
            f"asked {_span(self.oldest, self.requested)} before the {which} sample of {self._edge_text()}"
        )

    def _advice(self) -> str:
        if self.is_recorded:
            return f"; the recording has nothing older of it, and {_span(self.newest, self.oldest)} in all"
        if self._has_one_sample:
            return (
                " so far; ask for the newest instant (at=None), or start the listener earlier; what never "
                "moves is published as static (`zstate static`)"
            )
        return (
            f"; the history there spans {_span(self.newest, self.oldest)}: start the listener earlier or "
            "give the buffer more history_s"
        )


class Stale(LookupFailed):
    """The answer is older than ``max_age_s`` allows, or ``edge`` is silent for so long that there is none.

    An edge without new samples has no instant in common with ``other`` once the history of that one begins
    after its last sample; ``other_newest`` [ns] is the newest sample of ``other``, and ``max_age_s`` None.
    ``age_s`` is the age of the answer by the buffer's clock, or how much later ``other_newest`` is.
    """

    def __init__(
        self,
        target: str,
        source: str,
        *,
        age_s: float,
        max_age_s: float | None = None,
        other: tuple[str, str] | None = None,
        other_newest: int | None = None,
        edge: tuple[str, str] | None = None,
        requested: int | None = None,
        oldest: int | None = None,
        newest: int | None = None,
        rate_hz: float | None = None,
        writer: str | None = None,
    ) -> None:
        super().__init__(
            target,
            source,
            edge=edge,
            requested=requested,
            oldest=oldest,
            newest=newest,
            rate_hz=rate_hz,
            writer=writer,
        )
        self.age_s = age_s
        self.max_age_s = max_age_s
        self.other = other
        self.other_newest = other_newest

    def explanation(self) -> str:
        if self.max_age_s is None:
            return self._silence()
        if self.clock_offset_ns is None:
            clocks = ", and do the clocks of both machines agree?"
        else:
            clocks = f"? {self._clock_text()}".rstrip()
        return (
            f"the newest answer is {duration_text(round(self.age_s * 1e9))} old, {self.max_age_s:g} s are "
            f"allowed; the oldest link is {self._edge_text()}: is its writer alive (`zstate ls`){clocks}"
        )

    def _silence(self) -> str:
        newest, other_newest = self.newest or 0, self.other_newest or 0
        other = "the others" if self.other is None else f"{self.other[0]!r} -> {self.other[1]!r}"
        if difference := difference_text(other_newest, newest):
            return (
                f"{self._edge_text()} and {other} have no instant in common: {difference}; let all writers "
                "keep one time"
            )
        return (
            f"{self._edge_text()} has been silent since {instant_text(newest)}: its newest sample is "
            f"{duration_text(other_newest - newest)} older than that of {other}, whose history does not "
            f"reach back so far; is its writer alive (`zstate ls`)?{_also(self._clock_text())}"
        )


class NotFinite(LookupFailed):
    """The numbers on the path are so large that the result is infinite or NaN."""

    def explanation(self) -> str:
        return (
            f"the result is not finite: numbers on the path are too large, {self._edge_text()} has the "
            "largest; check the units and the positions that its writer publishes"
        )


def _span(later: int | None, earlier: int | None) -> str:
    return "some time" if later is None or earlier is None else duration_text(later - earlier)


def _also(text: str) -> str:
    return f"; {text}" if text else ""
