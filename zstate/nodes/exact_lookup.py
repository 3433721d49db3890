"""Exact lookups where samples arrive thinned: the writers themselves have all of their last seconds.

A router between may let pass 5 of 50 samples a second. What is missing at one instant is requested from the
caches of the writers that move the path, and inserted: the answer is that of a listener next to them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Collection
from functools import partial

from zstate.buffer.buffer import TransformBuffer, check_duration, feed_of
from zstate.buffer.frame_tree import Edge
from zstate.clock import check_stamp, wait_interruptible
from zstate.errors import InFuture, InPast, LookupFailed, Unreachable, as_timeout
from zstate.ingest.base import StreamIngest
from zstate.nodes.state_reader import StateReader
from zstate.streams import JOINT_STREAMS
from zstate.transform import Transform
from zstate.wire.identity import Announcement
from zstate.wire.keys import frame_owner
from zstate.wire.messages import Sample

_ROUND_S = 0.05
"""Between two requests for an instant that the writers have not reached yet."""

_IS_ALL = "that is all that its writer keeps: its cache_s; a recording at the site has more"


class ExactLookup:
    """Lookups in ``buffer``, which ``reader`` fills, with all samples of the writers around an instant."""

    def __init__(self, buffer: TransformBuffer, reader: StateReader) -> None:
        self._buffer, self._reader = buffer, reader

    def lookup(self, target: str, source: str, at: int | None, timeout_s: float) -> Transform:
        """The transform at ``at`` [ns], or at the newest instant. Raises as ``TransformListener.lookup``."""
        deadline = time.monotonic() + check_duration("timeout_s", timeout_s)
        # Any pose shows the path; without one, there is nothing to request.
        newest = self._buffer.wait(target, source, None, timeout_s).stamp
        stamp = newest if at is None else check_stamp(at)
        if newest is None or stamp is None:
            return self._buffer.lookup(target, source, stamp)
        while True:
            left_s = deadline - time.monotonic()
            reason = self._missing(target, source, stamp, max(left_s, _ROUND_S))
            if reason is None:
                return self._buffer.lookup(target, source, stamp)
            if isinstance(reason, InPast):
                raise reason
            if left_s <= 0.0:
                raise as_timeout(reason, timeout_s) if isinstance(reason, LookupFailed) else reason
            wait_interruptible(threading.Event(), min(_ROUND_S, left_s))

    def _missing(
        self, target: str, source: str, stamp: int, timeout_s: float
    ) -> LookupFailed | Unreachable | None:
        """Why the pose at ``stamp`` is not known exactly, after the writers were asked; None if it is."""
        edges = [one for one in feed_of(self._buffer).edges_between(target, source) if one.track is not None]
        writers = {edge.names: self._writers_of(edge) for edge in edges}
        spans = self._recall({one for found in writers.values() for one in found}, stamp, timeout_s)
        for edge in edges:
            found = [spans.get(one) for one in writers[edge.names]] or [None]
            for span in found:
                if span is None:
                    return Unreachable(
                        f"{edge.writer}, which places {edge.child!r}, has not sent its samples in time: it "
                        "keeps none (cache_s=0), or the link to it is slow; without exact the samples that "
                        "have arrived answer",
                        endpoints=(),
                    )
                oldest, newest = span
                if oldest <= stamp <= newest:
                    continue
                kind = InFuture if stamp > newest else InPast
                facts = {"requested": stamp, "oldest": oldest, "newest": newest}
                reason = kind(target, source, edge=edge.names, writer=edge.writer, **facts)
                reason.note = _IS_ALL if kind is InPast else ""
                return reason
        return None

    def _recall(
        self, writers: Collection[Announcement], stamp: int, timeout_s: float
    ) -> dict[Announcement, tuple[int, int]]:
        """Request the samples that ``writers`` cached, back to ``stamp`` [ns], and insert them.

        Returns the oldest and the newest of their stamps, between which nothing is missing, of each writer
        that replied within ``timeout_s`` [s].
        """
        spans: dict[Announcement, tuple[int, int]] = {}
        waiting, done = len(writers), threading.Event()

        def on_samples(one: Announcement, ingest: StreamIngest, samples: list[Sample]) -> bool:
            ingest.insert_history(samples, are_missing=True)
            oldest, newest = samples[0].stamp, samples[-1].stamp
            spans[one] = oldest, max(newest, spans.get(one, (0, newest))[1])
            return oldest > stamp

        def on_done() -> None:
            nonlocal waiting
            waiting -= 1
            if waiting <= 0:
                done.set()

        for one in writers:
            self._reader.request_history(one, partial(on_samples, one), on_done)
        if writers:
            wait_interruptible(done, timeout_s)
        return spans.copy()

    def _writers_of(self, edge: Edge) -> list[Announcement]:
        """The announced writers that may have placed ``edge``; one process writes for many robots."""
        robots = {frame_owner(name) for name in edge.names}
        return [
            one
            for one in self._reader.announced
            if one.robot in robots
            and str(one.writer) == edge.writer
            and (one.stream in JOINT_STREAMS) == (edge.kind == "joint")
        ]
