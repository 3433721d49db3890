"""Detects two writers that publish one moving edge or joint, although each owned it when it began.

That happens between peers if the second claims it before the token of the first has arrived, on networks that
are joined later, and if a writer was frozen or cut off for so long that its tokens expired, and another one
took over its edge.
"""

from __future__ import annotations

import time
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import NamedTuple, TypeAlias

import zenoh

from zstate._util.closeable import Closeable
from zstate.errors import MessageError
from zstate.net.edge_ownership import Edge, frame_conflict, named_edges
from zstate.net.ownership import CHECK_PERIOD_S, moving_streams, seniority
from zstate.net.session import Session
from zstate.net.streams import CAPACITY, Ring, to_serialized
from zstate.stream_registry import edge_streams
from zstate.streams import SAMPLE_BYTES
from zstate.wire.identity import Announcement
from zstate.wire.keys import WRITER_TOKEN, stream_key
from zstate.wire.messages import JointState, TransformSample
from zstate.wire.native import NativeWire

_WATCHED_S = 10.0
"""An older writer is watched for so long after it appears. One that appears later than the edges are owned
publishes them at once, or asks for them and is refused."""

_MAX_WATCHED = 16
"""Tokens can be made up; a subscription for each of these is harmless."""

_WIRE = NativeWire()
_Subscriber: TypeAlias = "zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]"


class _Watched(NamedTuple):
    samples: _Subscriber
    until_s: float


class EdgeMonitor(Closeable):
    """Watches the older writers of moving edges of one robot. Has no thread: reads samples when it is asked.

    Of two writers that publish one edge the later one ends: its ``check`` raises SecondWriter. A token alone
    displaces no writer, whatever start time it carries: its holder must also publish the edge. Writers whose
    sessions are in ``allowed`` do not conflict. ``joints`` are the edges that a driver moves, by the names of
    its coordinates in joint states: then other drivers of them are watched, too.
    """

    def __init__(
        self,
        session: Session,
        writer: Announcement,
        allowed: Container[int] = (),
        joints: Mapping[str, Edge] | None = None,
    ) -> None:
        self._session = session
        self._writer = writer
        self._allowed = allowed
        self._joints = joints or {}
        self._streams = moving_streams() if joints else edge_streams()
        self._children: set[str] = set()
        # Those of writers, not of edges: a router's replies leave out some of the tokens that are subscribed.
        self._tokens: _Subscriber | None = None
        self._watched: dict[Announcement, _Watched] = {}
        self._next_check = 0.0

    def add(self, edges: Sequence[Edge]) -> None:
        """Watch these edges, which ``claim_edges`` owns now."""
        if self._tokens is None:
            self._tokens = self._session.zenoh.liveliness().declare_subscriber(
                WRITER_TOKEN.expression(self._writer.robot),
                zenoh.handlers.RingChannel(CAPACITY),
                history=True,
            )
        for watched in self._watched.values():
            _drain(watched.samples)  # what a writer published before it released the edge is no conflict
        self._children.update(child for _, child in edges)

    def check(self) -> None:
        """Raise SecondWriter if an older writer publishes one of the edges. Checks 20 times per second."""
        now = time.monotonic()
        if self._tokens is None or now < self._next_check:
            return
        self._next_check = now + CHECK_PERIOD_S
        for token in _drain(self._tokens):
            self._on_token(token, now)
        for rival, (samples, until_s) in list(self._watched.items()):
            for edge in self._published(rival, samples):
                if edge[1] in self._children:
                    raise frame_conflict(rival, edge, "places")
            if now > until_s:
                self._stop_watching(rival)

    def _on_token(self, token: zenoh.Sample, now: float) -> None:
        for rival in _WIRE.parse_token(str(token.key_expr), self._writer.robot):
            if rival.stream not in self._streams:
                continue
            is_older = seniority(rival) < seniority(self._writer) and bool(rival.name)
            if token.kind == zenoh.SampleKind.DELETE:
                self._stop_watching(rival)
            elif is_older and rival.writer.session not in self._allowed and len(self._watched) < _MAX_WATCHED:
                ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
                key = stream_key(rival.robot, rival.stream, rival.name)
                samples = self._session.zenoh.declare_subscriber(key, ring)
                self._watched[rival] = _Watched(samples, now + _WATCHED_S)

    def _published(self, rival: Announcement, samples: _Subscriber) -> Iterator[Edge]:
        """The edges in samples of ``rival`` since the last call."""
        for sample in _drain(samples):
            with suppress(MessageError):
                for message in _WIRE.decode(
                    rival.stream, to_serialized(sample, "", SAMPLE_BYTES), rival.robot
                ):
                    if isinstance(message, TransformSample) and message.session == rival.writer.session:
                        yield from named_edges(rival.robot, message.edges or ())
                    elif isinstance(message, JointState) and message.session == rival.writer.session:
                        yield from (
                            self._joints[name] for name in message.names or () if name in self._joints
                        )

    def _stop_watching(self, rival: Announcement) -> None:
        watched = self._watched.pop(rival, None)
        if watched is not None:
            self._session.release(watched.samples)

    def close(self) -> None:
        """End the subscriptions. A second call does nothing."""
        if self._tokens is not None:
            self._session.release(self._tokens)
            self._tokens = None
        for rival in list(self._watched):
            self._stop_watching(rival)


def _drain(subscriber: _Subscriber) -> list[zenoh.Sample]:
    return list(islice(iter(subscriber.handler.try_recv, None), CAPACITY))
