"""Clocks of sites: stamps of a site whose clock is off are compared with those of no other site.

The offsets of writers show whose clock is off (zstate.net.clock_offset). A robot of a site whose clock is
more than a tenth of a second off, beyond the uncertainty of the measurement, has a clock domain of its own,
which robots of its site with the same offset share: a lookup across two domains raises ClockMismatch, and
ages are corrected by the offset.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from zstate.buffer.feed import BufferFeed
from zstate.clock import ClockOffset
from zstate.net.clock_offset import ClockOffsetMonitor
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.net.sites import NO_SITES, Sites
from zstate.wire.identity import WriterId

_LEAST_NS = 100_000_000
"""Clocks that differ by less agree."""

_MOST_DOMAINS = 64
"""Of one site; a clock that drifts or is set makes new ones."""

_AGAIN_S = 1.0
"""Between two measurements of known writers, which have turns."""


class SiteClocks:
    """Measures the clocks of writers, and sets the clock domains of robots of sites in ``feed``.

    All of it happens in ``thread``. Clocks are measured as a writer is announced; where there are sites, one
    more writer each second.
    """

    def __init__(self, session: Session, thread: ServiceThread, feed: BufferFeed) -> None:
        self._thread, self._feed = thread, feed
        self._monitor = ClockOffsetMonitor(session, thread, feed.clock, feed.clock_offsets, self._on_measured)
        self._watched: dict[tuple[str, WriterId], Callable[[], object]] = {}
        self._offsets: dict[str, dict[WriterId, ClockOffset]] = {}
        self._domains: dict[str, dict[str, int]] = {}
        """The domains of each site with their offsets [ns]."""
        self._sites: Sites = NO_SITES
        self._has_turns = False

    def watch(self, robot: str, writer: WriterId) -> None:
        """Measure the clock of ``writer``."""
        self._thread.call(partial(self._watch, robot, writer))

    def unwatch(self, robot: str, writer: WriterId) -> None:
        """Stop measuring the clock of ``writer``."""
        self._thread.call(partial(self._unwatch, robot, writer))

    def on_sites(self, sites: Sites) -> None:
        """Set the announced sites. Called in the thread."""
        self._sites = sites
        for robot in self._offsets:
            self._update(robot)
        if sites.robots and not self._has_turns:
            self._has_turns = True
            self._thread.call(self._measure_next, _AGAIN_S)

    def _watch(self, robot: str, writer: WriterId) -> None:
        self._watched[robot, writer] = self._monitor.watch(robot, writer)

    def _unwatch(self, robot: str, writer: WriterId) -> None:
        self._watched.pop((robot, writer), None)
        self._monitor.unwatch(writer)
        if writer in self._offsets.get(robot, {}):
            del self._offsets[robot][writer]
            self._update(robot)

    def _measure_next(self) -> None:
        for key in list(self._watched)[:1]:
            measure = self._watched[key] = self._watched.pop(key)  # behind the others
            measure()
        self._has_turns = bool(self._sites.robots)
        if self._has_turns:
            self._thread.call(self._measure_next, _AGAIN_S)

    def _on_measured(self, robot: str, writer: WriterId, offset: ClockOffset) -> None:
        if (robot, writer) in self._watched:
            self._offsets.setdefault(robot, {})[writer] = offset
            self._update(robot)

    def _update(self, robot: str) -> None:
        site, offsets = self._sites.site_of(robot), self._offsets[robot].values()
        if not offsets:
            return  # samples of writers that left stay, in their domain
        offset = max(offsets, key=lambda one: abs(one.offset_ns))
        if site is None or not _differs(offset, 0):
            self._feed.set_measured_domain(robot, "")
            return
        domains = self._domains.setdefault(site, {})
        near = [name for name, ahead_ns in domains.items() if not _differs(offset, ahead_ns)]
        name = near[0] if near else f"site {site} ({offset.offset_ns * 1e-9:+.1f} s)"
        domains[name] = offset.offset_ns
        while len(domains) > _MOST_DOMAINS:
            del domains[next(iter(domains))]
        self._feed.set_measured_domain(robot, name, offset.offset_ns)


def _differs(offset: ClockOffset, expected_ns: int) -> bool:
    return abs(offset.offset_ns - expected_ns) - offset.uncertainty_ns > _LEAST_NS
