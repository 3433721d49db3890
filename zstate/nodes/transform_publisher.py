"""Publisher of moving transforms: edges that no joint of a model describes (tf2 ``TransformBroadcaster``).

``EdgePublisher`` is what it has in common with the publisher of odometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import ClassVar, Protocol, cast

import numpy as np

from zstate._util.bounded import BoundedDict
from zstate.buffer.buffer import TransformBuffer
from zstate.clock import Clock, check_stamp
from zstate.errors import InvalidInput
from zstate.net.edge_monitor import EdgeMonitor
from zstate.net.edge_ownership import Edge, check_readers, claim_edges
from zstate.net.session import Session
from zstate.nodes.sample_publisher import SamplePublisher
from zstate.rate import RateReport
from zstate.streams import StreamName
from zstate.transform import UPPER_TRIANGLE, Transform
from zstate.wire.keys import full_name
from zstate.wire.messages import Edges, WriterTransforms, edge_of, order_digest, to_block
from zstate.wire.protocol import carrier

# Edges of a sample for which the cache has room for 2000 samples.
_TYPICAL_EDGES = 16

_IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class EdgePublisher(SamplePublisher):
    """Base of the publishers of moving edges under the name ``writer``, which own the edges.

    On the ROS wires the transforms are on /tf.
    """

    _stream: ClassVar[StreamName]
    _numbers: ClassVar[int]
    """How many numbers a sample has; the cache has room for 2000 samples."""

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
        super().__init__(session, robot, wires, clock, program)
        out, stream = self._out, self._stream
        self.writer = out.edge_writer_name(writer)
        out.title = f"the {stream.removesuffix('s')} publisher {self.writer!r}"
        self._announced = out.announcement(stream, self.writer)
        # The digests of the edges that were published together.
        self._orders: BoundedDict[Edges, bytes] = BoundedDict()
        # Raises here, where the mistake is made, what every listener would refuse.
        self._check = TransformBuffer()
        self._placed: set[Edge] = set()
        self._edge_tokens = ExitStack()
        self._edge_monitor: EdgeMonitor | None = None
        with out.opening():
            out.own([self._announced])
            if out.is_native:
                self._edge_monitor = out.opened.enter_context(EdgeMonitor(session, self._announced))
                out.checks.append(self._edge_monitor.check)
            for name, wire_writer in out.open_wires().items():
                wire = wire_writer.wire
                carrying = carrier(wire, stream)
                out.open_stream(name, carrying, self.writer)
                if wire.shared and carrying != wire.transforms:
                    out.open_stream(name, wire.transforms, self.writer, edge_of)
            out.report_status(lambda: self.stats)
            # Its queryable is also how writers that claim edges at the same time find each other.
            out.open_cache(cache_s, self._numbers)
            out.serve_history(stream, self.writer)
            out.opened.enter_context(self._edge_tokens)

    def __repr__(self) -> str:
        closed = ", closed" if self._out.is_closed else ""
        return f"<{type(self).__name__} {self.writer!r} of {self.robot!r}: {self._sent} samples{closed}>"

    def _order(self, names: Edges) -> bytes:
        """The digest of the edges ``names``, which are checked, and owned from their first sample on.

        Called with the lock. Raises SecondWriter, InvalidInput and InsertRefused.
        """
        order = self._orders.get(names)
        if order is not None:
            return order
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
                check_readers(self._out.session, self._announced, fresh)
                claims.enter_context(claim_edges(self._out.session, self._announced, fresh))
                # An earlier writer that answered above has announced itself by now.
                self._out.check()
            self._check.insert_many(edges, 0, [_IDENTITY] * len(edges), writer=self.writer)
            self._placed.update(fresh)
            if self._edge_monitor is not None and fresh:
                self._edge_monitor.add(fresh)
            self._edge_tokens.push(claims.pop_all().__exit__)
        order = self._orders[names] = order_digest(names)
        return order


class TransformSource(Protocol):
    """Interface of programs that compute moving transforms: odometry, trackers, simulators."""

    def read(self, stamp: int) -> Sequence[Transform] | None:
        """The transforms at ``stamp`` [ns], the present instant; None when there is nothing new."""
        ...


class TransformPublisher(EdgePublisher):
    """Publishes moving edges under one writer's name: odom -> base_link, a tracked object, a marker.

    A robot may have several such writers, and a ``StatePublisher``; listeners receive the edges of all.
    Bare frame names are the robot's own; other frames have full names, ``robot/frame``. One sample is one
    instant of the edges in it.

    - ``robot``: the robot that the writer belongs to.
    - ``writer``: distinguishes this publisher from others; default: the program, its process id and a random
      number.
    - ``wires``: what it publishes on, "native", "ros2" with options, or several.
    - ``clock``: gives the stamps of samples without one; default: the system's.
    - ``program``: the writer's name for others; default: the script's name.
    - ``cache_s``: the last seconds of samples that joining listeners of the native wire receive; 0: only the
      newest sample.

    On the native wire each edge has one writer. SecondWriter, which names the first writer, is raised if
    another active writer has the same name, and by ``publish`` if another writer of any robot places the
    same frame. If two writers publish one edge on networks that are joined later, or because one was frozen
    while the other took it over, the later one to start raises it and is closed. The ROS wires publish on
    /tf, where every node may write.

    On the native wire the status is published once a second while it has a reader. A context manager; safe
    from any thread.
    """

    _stream = "transforms"
    _numbers = 28 * _TYPICAL_EDGES

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
        with self._refusals:
            _check_transforms(transforms)
            stamp = self._stamp(transforms) if stamp is None else check_stamp(stamp)
            poses = to_block([transform.pose7 for transform in transforms])
            covariances = covariance_block(transforms)
            names = tuple([(transform.target, transform.source) for transform in transforms])
            out = self._out
            with out.lock:
                out.check()
                head = (stamp, out.seq, out.session_id, self._order(names))
                out.send(WriterTransforms(*head, poses, names, covariances))

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
