"""Publisher of moving transforms: edges that no joint of a model describes (tf2 ``TransformBroadcaster``).

``EdgePublisher`` is what it has in common with the publisher of odometry.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from contextlib import ExitStack
from typing import ClassVar, Protocol, cast

import numpy as np

from zstate._util.bounded import BoundedDict
from zstate.buffer.buffer import TransformBuffer
from zstate.clock import Clock, check_stamp
from zstate.errors import Closed, InvalidInput
from zstate.net.edge_monitor import EdgeMonitor
from zstate.net.ownership import Edge, WriterClaim, check_readers, claim_edges
from zstate.net.presence import local_writer
from zstate.net.sample_history import SampleCache, serve_history
from zstate.net.session import Session
from zstate.net.status import StatusPublisher
from zstate.net.writer import WireWriter
from zstate.nodes.publisher_status import StatusReporter
from zstate.nodes.sample_publisher import SamplePublisher
from zstate.nodes.static_publisher import edge_writer_name
from zstate.rate import RateReport
from zstate.streams import StreamName
from zstate.transform import UPPER_TRIANGLE, Transform
from zstate.wire.identity import Announcement
from zstate.wire.keys import full_name
from zstate.wire.messages import Edges, Odometry, WriterTransforms, edge_of, order_digest, to_block
from zstate.wire.protocol import carrier
from zstate.wire.registry import get_wire

# Edges of a sample for which the cache has room for 2000 samples.
_TYPICAL_EDGES = 16

_IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class EdgePublisher(SamplePublisher):
    """Base of the publishers of moving edges on ``stream`` under the name ``writer``, which own the edges.

    On the ROS wires the transforms are on /tf.
    """

    _kind: ClassVar[str]
    """What it is, for errors."""

    def __init__(
        self,
        session: Session,
        robot: str,
        stream: StreamName,
        *,
        writer: str | None,
        wires: str | Sequence[str],
        clock: Clock | None,
        program: str,
        cache_s: float,
        numbers: int,
    ) -> None:
        identity = local_writer(secrets.randbits(32), program)
        super().__init__(robot, wires, clock, identity.session)
        self.writer = edge_writer_name(writer, identity)
        self._session = session
        self._announced = Announcement(self.robot, stream, identity, self.writer)
        # The digests of the edges that were published together.
        self._orders: BoundedDict[Edges, bytes] = BoundedDict()
        # Raises here, where the mistake is made, what every listener would refuse.
        self._check = TransformBuffer()
        self._placed: set[Edge] = set()
        self._edge_tokens = ExitStack()
        self._edge_monitor: EdgeMonitor | None = None
        self._cache: SampleCache | None = None
        with ExitStack() as opening:
            if "native" in self._wires:
                claim = opening.enter_context(WriterClaim(session, [self._announced]))
                self._edge_monitor = opening.enter_context(EdgeMonitor(session, self._announced))
                self._claims = claim.check, self._edge_monitor.check
                self._serve_clock(session, identity, opening)
            for name in self._wires:
                wire = get_wire(name)
                wire_writer = opening.enter_context(WireWriter(session, wire, self.robot, identity))
                on_tf = (wire.transforms,) if wire.shared else ()
                for carrying in dict.fromkeys((carrier(wire, stream), *on_tf)):
                    self._writers[name, carrying] = wire_writer.open_stream(carrying, self.writer)
            if "native" in self._wires:
                status = StatusReporter(identity, lambda: self.stats).status
                opening.enter_context(StatusPublisher(session, self.robot, identity.identity, status))
                # Its queryable is also how writers that claim edges at the same time find each other.
                self._cache = self._new_cache(cache_s, numbers)
                opening.enter_context(
                    serve_history(session, self.robot, stream, self._cache, writer=self.writer)
                )
            opening.enter_context(self._edge_tokens)
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        closed = ", closed" if self._stop.is_set() else ""
        return f"<{type(self).__name__} {self.writer!r} of {self.robot!r}: {self._seq} samples{closed}>"

    def _head(self, stamp: int, names: Edges) -> tuple[int, int, int, bytes]:
        """The first fields of the next sample, of the edges ``names``, which this writer owns then.

        Called with the lock. Raises Closed, SecondWriter, InvalidInput and InsertRefused.
        """
        if self._stop.is_set():
            raise Closed(f"the {self._kind} {self.writer!r} is closed")
        self._check_ownership()
        order = self._orders.get(names)
        if order is None:
            order = self._orders[names] = self._place(names)
        return stamp, self._seq, self._session_id, order

    def _send(self, sample: WriterTransforms) -> None:
        """Publish the next sample. Called with the lock."""
        # Encode for all wires before sending on any: a wire may be unable to represent the stamp.
        payloads = {
            place: writer.encoder.encode(_carried(sample, place[1]))
            for place, writer in self._writers.items()
        }
        self._seq += 1
        if self._cache is not None:
            # Before sending: a reader that misses this sample can then request it as history.
            self._cache.append(sample.stamp, sample.seq, payloads["native", self._announced.stream])
        for place, payload in payloads.items():
            self._writers[place].write(payload)

    def _place(self, names: Edges) -> bytes:
        """Check edges that are published together for the first time, and own them. Returns their digest."""
        edges = [(full_name(self.robot, parent), full_name(self.robot, child)) for parent, child in names]
        children = {child for _, child in edges}
        if not edges or len(children) < len(edges):
            given = ", ".join(f"{parent!r} -> {child!r}" for parent, child in edges) or "no transform"
            raise InvalidInput(
                f"a sample has one transform for each of its children, at least one; got {given}"
            )
        with ExitStack() as claims:
            fresh = [edge for edge in edges if edge not in self._placed]
            if self._edge_monitor is not None and fresh:
                check_readers(self._session, self._announced, fresh)
                claims.enter_context(claim_edges(self._session, self._announced, fresh))
                # An earlier writer that answered above has announced itself by now.
                self._check_ownership()
            self._check.insert_many(edges, 0, [_IDENTITY] * len(edges), writer=self.writer)
            self._placed.update(fresh)
            if self._edge_monitor is not None and fresh:
                self._edge_monitor.add(fresh)
            self._edge_tokens.push(claims.pop_all().__exit__)
        return order_digest(names)


def _carried(sample: WriterTransforms, stream: StreamName) -> WriterTransforms:
    """``sample`` on ``stream``: without the velocity where that has transforms alone."""
    return edge_of(sample) if isinstance(sample, Odometry) and stream in ("tf", "transforms") else sample


class TransformSource(Protocol):
    """Interface of programs that compute moving transforms: odometry, trackers, simulators."""

    def read(self, stamp: int) -> Sequence[Transform] | None:
        """The transforms at ``stamp`` [ns], the present instant; None when there is nothing new."""
        ...


class TransformPublisher(EdgePublisher):
    """Publishes moving edges under one writer's name: odom -> base_link, a tracked object, a marker.

    A robot may have several such writers, and a ``StatePublisher``; listeners receive the edges of all.
    Bare frame names are the robot's own; other frames have full names, ``robot/frame``. One sample is one
    instant of the edges in it. ``writer`` distinguishes this publisher from others; default: the program,
    its process id and a random number. ``program`` is the script's name by default.

    On the native wire each edge has one writer. SecondWriter, which names the first writer, is raised if
    another active writer has the same name, and by ``publish`` if another writer of any robot places the
    same frame. If two writers publish one edge on networks that are joined later, or because one was frozen
    while the other took it over, the later one to start raises it and is closed. The ROS wires publish on
    /tf, where every node may write.

    On the native wire the last ``cache_s`` seconds of samples are cached for joining listeners (0: only the
    newest sample), and the status is published once a second while it has a reader. A context manager; safe
    from any thread.
    """

    _kind = "transform publisher"

    def __init__(
        self,
        session: Session,
        robot: str,
        writer: str | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        clock: Clock | None = None,
        program: str = "",
        cache_s: float = 2.0,
    ) -> None:
        super().__init__(
            session,
            robot,
            "transforms",
            writer=writer,
            wires=wires,
            clock=clock,
            program=program,
            cache_s=cache_s,
            numbers=_TYPICAL_EDGES * 28,
        )

    def publish(self, transforms: Sequence[Transform], stamp: int | None = None) -> None:
        """Publish one sample: each transform places its ``source`` on its ``target``, at ``stamp`` [ns].

        The default stamp is that of the transforms, or now if they have none. Covariances, if known
        (``Transform.with_covariance``), are published on the native wire. The first sample with an edge takes
        some round trips, in which the edge is compared with those of other writers.

        Raises InvalidInput for anything but a list of Transforms, at least one, for two of one child, and for
        transforms with different stamps; InsertRefused for a self edge, a loop or a second parent among this
        writer's edges, on the native wire also for an edge that contradicts an announced model, or that
        places a frame of another robot if that robot, or a third one, places it; SecondWriter; and Closed. If
        it raises, nothing was sent.
        """
        with self._refusals_counted():
            _check_transforms(transforms)
            stamp = self._stamp(transforms) if stamp is None else check_stamp(stamp)
            poses = to_block([transform.pose7 for transform in transforms])
            covariances = covariance_block(transforms)
            names = tuple([(transform.target, transform.source) for transform in transforms])
            with self._lock:
                self._send(WriterTransforms(*self._head(stamp, names), poses, names, covariances))

    def _stamp(self, transforms: Sequence[Transform]) -> int:
        """The one stamp of ``transforms``; now if they have none."""
        stamps = {transform.stamp for transform in transforms}
        if len(stamps) > 1:
            given = ", ".join(sorted(map(str, stamps)))
            raise InvalidInput(f"the transforms of one sample have one stamp; got {given}")
        (stamp,) = stamps or {None}
        return self._clock.now() if stamp is None else stamp

    def run(
        self, source: TransformSource, rate_hz: float = 50.0, *, seconds: float | None = None
    ) -> RateReport:
        """Publish the transforms of ``source`` at exactly ``rate_hz``, for ``seconds`` or until ``close()``.

        Deadlines and late ticks are those of ``StatePublisher.run``. If the source has nothing new, the tick
        publishes nothing. Raises as ``publish``.
        """

        def publish(transforms: Sequence[Transform], now: int) -> None:
            own = {transform.stamp for transform in transforms}
            self.publish(transforms, now if own == {None} else None)

        return self._publish_at(rate_hz, seconds, source.read, publish)


def _check_transforms(transforms: object) -> None:
    is_list = isinstance(transforms, Sequence) and not isinstance(transforms, str)
    if not is_list or not all(isinstance(one, Transform) for one in cast("Sequence[object]", transforms)):
        raise InvalidInput(f"publish takes a list of Transforms; got {transforms!r}")


def covariance_block(transforms: Sequence[Transform]) -> bytes | None:
    """The covariances of a sample, NaN where one is not known; None if none is."""
    known = [transform.covariance for transform in transforms]
    if all(covariance is None for covariance in known):
        return None
    missing = np.full((6, 6), np.nan)
    return to_block([(missing if one is None else one)[UPPER_TRIANGLE] for one in known])
