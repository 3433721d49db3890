"""Which readings belong to the present time of an estimator, which has no clock: its stamps alone tell.

A reading is late if it is more than ``history_s`` older than the newest one. It is ahead if it is newer by
more than ``history_s``, and by more than a second. Neither moves the present time, unless others confirm it:

- forwards (all sources have paused, or a clock was set): by a second reading of the IMU, or by five readings
  of another source that cover half a second of stamps;
- backwards by more than ``history_s`` and a second (a recording in a loop, a restarted simulation): by five
  readings of one source, also of the IMU, that cover half a second of stamps.

They have different stamps, no 10 s apart, and no reading of the present time came between: none of the IMU,
and for other sources than the IMU none at all. So the clock of the IMU prevails over that of wheels that is
ahead, and the readings that were held back until then are not lost.

The order of arrival still matters in one case: a reading that is ahead and is followed by one of the present
is refused; in another order it may have been confirmed. Without jumps of more than ``history_s`` and a second
the order does not matter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from copy import copy
from typing import Literal, NamedTuple, TypeAlias

JUMP_NS = 1_000_000_000
"""No smaller difference between stamps is a jump of time."""

_CONFIRMED_NS, _CONFIRMED_COUNT = 500_000_000, 5
_GAP_NS = 10_000_000_000
_MOST_HELD = 2000

Place: TypeAlias = Literal["present", "late", "ahead"]
"""Where a stamp is, seen from the present time."""


class Held(NamedTuple):
    """A reading that waits for others to confirm its time, with the function that inserts it."""

    source: str
    stamp: int
    insert: Callable[[], None]


class _Run:
    """Readings of one source in a row that are all late, or all ahead."""

    def __init__(self, held: Held, place: Place) -> None:
        self.place = place
        self.first = self.last = held.stamp
        self.held = deque((held,), maxlen=_MOST_HELD)

    def continues_with(self, stamp: int, place: Place) -> bool:
        return place == self.place and self.first - _GAP_NS <= stamp <= self.last + _GAP_NS

    def add(self, held: Held) -> None:
        self.first, self.last = min(self.first, held.stamp), max(self.last, held.stamp)
        self.held.append(held)


class Jump(NamedTuple):
    """A jump of time that was confirmed. ``held`` are the readings that waited for it, of all sources."""

    is_back: bool
    size_ns: int
    held: list[Held]


class StampOrder:
    """The present time of an estimator, the ``newest`` stamp, by the rules of this module.

    ``reference`` is the source whose clock prevails, the IMU; ``leader`` the source of the newest stamp.
    """

    def __init__(self, history_ns: int, reference: str) -> None:
        self.newest: int | None = None
        self.leader = ""
        self._reference = reference
        self._history_ns, self._jump_ns = history_ns, max(history_ns, JUMP_NS)
        self._runs: dict[str, _Run] = {}

    def copied(self) -> StampOrder:
        """The same present time, without readings that wait: these are inserted where they were read."""
        other = copy(self)
        other._runs = {}
        return other

    def place(self, source: str, stamp: int) -> Place:
        """Where a reading of ``source`` is; if that is the present, it may become the newest one."""
        if self.newest is None:
            self.newest, self.leader = stamp, source
        if stamp > self.newest + self._jump_ns:
            return "ahead"
        if self.is_late(stamp):
            return "late"
        if self._runs:
            self._end_runs(source)
        if stamp > self.newest:
            self.newest, self.leader = stamp, source
        return "present"

    def is_late(self, stamp: int) -> bool:
        """Whether what has this stamp is older than what is kept."""
        return self.newest is not None and stamp < self.newest - self._history_ns

    def hold(self, held: Held, place: Place) -> Jump | None:
        """Keep a reading that is late or ahead; with the jump if it confirms one, after which time is new."""
        assert self.newest is not None
        if place == "late" and held.stamp >= self.newest - self._jump_ns:
            return None
        run = self._runs.get(held.source)
        if run is None or not run.continues_with(held.stamp, place):
            self._runs[held.source] = _Run(held, place)
            return None
        run.add(held)
        is_second_of_imu = held.source == self._reference and place == "ahead"
        is_long = run.last - run.first >= _CONFIRMED_NS and len(run.held) >= _CONFIRMED_COUNT
        if not is_long and not (is_second_of_imu and run.last > run.first):
            return None
        waiting = sorted(
            (one for each in self._runs.values() for one in each.held), key=lambda one: one.stamp
        )
        jump = Jump(place == "late", abs(run.last - self.newest), waiting)
        self.newest, self.leader = run.last, held.source
        self._runs = {}
        return jump

    def _end_runs(self, source: str) -> None:
        """A reading of the present has come: what others have of another time is not confirmed."""
        is_of_reference = source == self._reference
        self._runs = {
            name: run for name, run in self._runs.items() if name == self._reference and not is_of_reference
        }
