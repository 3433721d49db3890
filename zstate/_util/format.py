"""Times as errors say them: how long, when, and why two stamps may be of different times."""

from __future__ import annotations

from datetime import datetime, timezone

_SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * _SECOND_NS
_UNITS = (("seconds", _SECOND_NS), ("milliseconds", 1_000_000), ("microseconds", 1_000))

# No clock that was set tells a year before 1980, and no simulation lasts until then.
_FIRST_DECADE_NS = 3650 * DAY_NS


def format_duration(nanoseconds: int) -> str:
    """A duration as a person says it: 85 ns, 12.0 us, 3.5 ms, 4.2 s, 20458.0 days."""
    size = abs(nanoseconds)
    if size >= 2 * DAY_NS:
        return f"{nanoseconds / DAY_NS:.1f} days"
    for unit, scale in (("s", _SECOND_NS), ("ms", 1_000_000), ("us", 1_000)):
        if size >= scale:
            return f"{nanoseconds / scale:.1f} {unit}"
    return f"{nanoseconds} ns"


def format_time(stamp: int) -> str:
    """When a stamp [ns] is: the date and time of a wall clock, or how long after 1970 began."""
    if counts_from_start(stamp):
        return f"{stamp / _SECOND_NS:.3f} s"
    return f"{datetime.fromtimestamp(stamp // _SECOND_NS, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"


def counts_from_start(stamp: int) -> bool:
    """Whether a stamp [ns] is of 1970 and after: simulated, or the time since something was switched on."""
    return abs(stamp) < _FIRST_DECADE_NS


def guess_unit(stamp: int, near: int) -> str:
    """The unit that puts ``stamp`` within a day of the wall-clock time ``near`` [ns], where ns do not."""
    if counts_from_start(near) or abs(stamp - near) < DAY_NS:
        return ""
    return next((unit for unit, scale in _UNITS if abs(stamp * scale - near) < DAY_NS), "")


def difference_text(asked: int, newest: int) -> str:
    """Why ``asked`` and the stamps of samples up to ``newest`` [ns] may not be of one time.

    Empty where nothing points to it.
    """
    if unit := guess_unit(asked, newest):
        return f"that instant, {asked}, looks like {unit}: stamps are nanoseconds"
    if unit := guess_unit(newest, asked):
        return f"their writer gives {unit} where nanoseconds are meant"
    if counts_from_start(asked) == counts_from_start(newest):
        return ""
    ours, theirs = f"that instant, {format_time(asked)}", f"(the newest {format_time(newest)})"
    if counts_from_start(asked):
        return (
            f"{ours}, is simulated time or one since a machine was switched on, and those samples keep "
            f"wall-clock time {theirs}"
        )
    return (
        f"{ours}, is wall-clock time, and those samples keep simulated time, or that of a machine whose "
        f"clock was never set {theirs}"
    )
