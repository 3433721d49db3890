"""The diagnostics of a TransformListener: events of writers, stamp checks, clock offsets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from zstate._util.closeable import Closeable
from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.clock import SYSTEM
from zstate.errors import InsertRefused
from zstate.ingest.counters import Counters
from zstate.ingest.diagnostics import Diagnostics, WriterEvent
from zstate.ingest.events import EventLog
from zstate.ingest.frame_ownership import EdgeSource
from zstate.ingest.robot_ingests import Follow, sample_streams
from zstate.ingest.stamp_checks import StampCheck
from zstate.net.router_losses import RouterLossDetector
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.net.sites import Sites, SiteWatch
from zstate.nodes.site_clocks import SiteClocks
from zstate.streams import StreamName
from zstate.wire.identity import Announcement
from zstate.wire.messages import Sample
from zstate.wire.protocol import Wire


class ListenerDiagnostics(Diagnostics, Closeable):
    """Logs the events of writers, checks stamps, and measures the clocks of writers for ``buffer``.

    Clocks are measured by ``thread``, on the native wire, if the clock of ``buffer`` is a machine's.
    ``on_event`` is called with each event on a thread of its own; see ``EventLog``.
    """

    def __init__(
        self,
        session: Session,
        wire: Wire,
        follow: Follow,
        buffer: TransformBuffer,
        *,
        thread: ServiceThread,
        counters: Counters,
        on_event: Callable[[WriterEvent], None] | None,
    ) -> None:
        self._streams = sample_streams(wire, follow)
        self._stamp_check = StampCheck(buffer, counters, is_described=not wire.shared)
        self._follow = follow
        self._clocks: SiteClocks | None = None
        if not wire.shared and buffer.clock.domain == SYSTEM:
            self._clocks = SiteClocks(session, thread, feed_of(buffer))
        streams: tuple[StreamName, ...] = ("robot_description", "tf_static", *self._streams)
        self._events = EventLog(streams, follow, wire.shared, on_event)
        self._has_deadlines = on_event is not None
        self._routers, self._are_cut_off = RouterLossDetector(session), False
        self._sites: SiteWatch | None = None
        if self._has_deadlines:
            self.on_usual_sample = self._events.on_sample
        if not wire.shared:
            self._sites = SiteWatch(session, thread, self._on_sites)

    def close(self) -> None:
        if self._sites is not None:
            self._sites.close()
        self._routers.close()
        self._events.close()

    def events(self) -> tuple[WriterEvent, ...]:
        return self._events.recent()

    def on_samples(
        self, samples: Sequence[tuple[str, Sample]], writers: Mapping[tuple[str, int], str]
    ) -> None:
        if self._has_deadlines:
            for robot, sample in samples:
                self._events.on_sample(robot, sample.session)
        earliest, latest = self._stamp_check.accepted_range()
        for robot, sample in samples:
            if not earliest <= sample.stamp <= latest:
                self._stamp_check.check(robot, writers.get((robot, sample.session)), sample)

    def before_losses(self) -> None:
        self._are_cut_off = self._routers.lost_recently()

    def on_writer(self, announced: Announcement, *, alive: bool) -> None:
        if self._are_cut_off and not alive:
            self._events.on_cut_off(announced)
        self._events.on_writer(announced, alive)
        if self._clocks is not None and announced.stream in self._streams:
            watch = self._clocks.watch if alive else self._clocks.unwatch
            watch(announced.robot, announced.writer)

    def _on_sites(self, sites: Sites) -> None:
        self._events.set_thinned(sites.periods_s(self._follow))
        if self._clocks is not None:
            self._clocks.on_sites(sites)

    def on_set_back(self, robot: str, session: int, text: str) -> None:
        self._events.add_set_back(robot, session, text)

    def on_conflict(self, stream: StreamName, source: EdgeSource, refusal: InsertRefused) -> None:
        self._events.add_second_edge(stream, source, refusal)

    def on_static_children(self, robot: str, writer: str, children: frozenset[str]) -> None:
        self._events.set_static_children(robot, writer, children)
