"""Texts in messages: durations and stamps, why two stamps are far apart, suggestions for misspelled names."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from difflib import get_close_matches

SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * SECOND_NS
_UNITS = (("seconds", SECOND_NS), ("milliseconds", 1_000_000), ("microseconds", 1_000))


# A clock that was set shows 1980 or later; no simulation lasts ten years.
_FIRST_DECADE_NS = 3650 * DAY_NS


def format_duration(nanoseconds: int) -> str:
    """A duration in a readable unit: 85 ns, 12.0 us, 3.5 ms, 4.2 s, 20458.0 days."""
    size = abs(nanoseconds)
    if size >= 2 * DAY_NS:
        return f"{nanoseconds / DAY_NS:.1f} days"
    for unit, scale in (("s", SECOND_NS), ("ms", 1_000_000), ("us", 1_000)):
        if size >= scale:
            return f"{nanoseconds / scale:.1f} {unit}"
    return f"{nanoseconds} ns"


def format_time(stamp: int) -> str:
    """A stamp [ns] as date and time, or as seconds if it is within ten years of zero."""
    if counts_from_start(stamp):
        return f"{stamp / SECOND_NS:.3f} s"
    return f"{datetime.fromtimestamp(stamp // SECOND_NS, UTC):%Y-%m-%d %H:%M:%S} UTC"


def counts_from_start(stamp: int) -> bool:
    """Whether a stamp [ns] is within ten years of zero: simulated time, or time since a start."""
    return abs(stamp) < _FIRST_DECADE_NS


def guess_unit(stamp: int, near: int) -> str:
    """The unit that puts ``stamp`` within a day of the wall-clock time ``near`` [ns]; empty for ns."""
    if counts_from_start(near) or abs(stamp - near) < DAY_NS:
        return ""
    return next((unit for unit, scale in _UNITS if abs(stamp * scale - near) < DAY_NS), "")


def difference_text(requested: int, newest: int) -> str:
    """Why ``requested`` and the stamps of samples up to ``newest`` [ns] may be of unrelated clocks.

    Empty if nothing points to it.
    """
    if unit := guess_unit(requested, newest):
        return f"the requested stamp {requested} looks like {unit}, but stamps are nanoseconds"
    if unit := guess_unit(newest, requested):
        return f"the writer's stamps look like {unit}, but stamps are nanoseconds"
    if counts_from_start(requested) == counts_from_start(newest):
        return ""
    requested_text = f"the requested stamp, {format_time(requested)}"
    newest_text = f"(newest {format_time(newest)})"
    if counts_from_start(requested):
        return (
            f"{requested_text}, is simulated time or time since a machine was switched on, but the samples "
            f"have wall-clock stamps {newest_text}"
        )
    return (
        f"{requested_text}, is wall-clock time, but the samples have simulated stamps, or those of a "
        f"machine whose clock was never set {newest_text}"
    )


def did_you_mean(name: str, candidates: Iterable[str], *, count: int = 1) -> str:
    """``; did you mean 'x'?`` with the ``candidates`` most similar to ``name``; empty without any."""
    return suggestion_text(*get_close_matches(name, list(candidates), n=count))


def suggestion_text(*names: str | None) -> str:
    """``; did you mean 'x' or 'y'?``; empty without names. None stands for no name."""
    found = [repr(name) for name in names if name is not None]
    return f"; did you mean {' or '.join(found)}?" if found else ""
