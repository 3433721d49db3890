"""Corrections of drifting odometry from a map: localisation, SLAM, a motion capture system."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import ExitStack
from typing import NamedTuple

from numpy.typing import ArrayLike

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.buffer.buffer import TransformBuffer
from zstate.clock import Clock, check_stamp, format_stamp
from zstate.errors import Closed, InvalidInput, LookupFailed, SecondWriter, format_duration
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher_status import PublisherStats
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.transform import Transform
from zstate.wire.keys import full_name

_JOIN_TIMEOUT_S = 0.5


class Correction(NamedTuple):
    """A correction measured at ``stamp`` [ns], of the odometry of ``base`` by ``odometry_writer``."""

    map_from_odom: Transform
    stamp: int
    base: str
    odometry_writer: str | None


class MapCorrection(Closeable):
    """Publishes the moving edge map -> odom, from poses of the base in the map that come late.

    A pose measured at ``stamp`` is compared with the odometry at that same instant::

        map_from_odom = map_from_base(stamp) @ odom_from_base(stamp).inverse()

    so its latency causes no error, however fast the base moves. (With the odometry of the present instead,
    the error is speed times latency.) The correction holds until the next: it is published with the stamp of
    each newest odometry sample. So ``lookup("map", "base_link")`` of any listener is at an odometry sample
    and exact, and needs no extrapolation, tolerance or stamps in the future; at the newest odometry stamp it
    waits (``timeout_s``) for the time that the correction takes to follow. Samples published before keep
    their correction, so that a replay equals what was live; the first correction is also published at its own
    stamp.

    The covariance of the edge is that of ``map_from_base``, carried to the origin of odom. A lookup of the
    base in the map adds the covariance of the odometry, which has grown since the odometry began: an upper
    limit, because the edge does not contain the odometry's error, but its opposite.

    ``robot`` owns bare frame names; ``map`` may be a full name such as "fleet/map". The odometry comes from
    ``buffer``, which a listener of this robot fills, or from a listener of its own on the first of ``wires``.
    If the odometry is restarted, its frame has another origin: nothing is published until the next ``set``,
    and the writer's status is a warning. ``writer``, ``wires``, ``clock``, ``program`` and SecondWriter are
    as of ``TransformPublisher``. A context manager; safe from any thread.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        map: str = "map",
        odom: str = "odom",
        *,
        writer: str = "map",
        wires: str | Sequence[str] = ("native",),
        buffer: TransformBuffer | None = None,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        self.robot = robot
        self.map, self.odom = full_name(robot, map), full_name(robot, odom)
        self._held: Correction | None = None
        self._published = -1
        """The newest stamp that the edge was published with [ns]."""
        self._lock = fork_safe_lock()
        self._has_advanced = fork_safe(threading.Event())
        self._stop = fork_safe(threading.Event())
        self._watch = ExitStack()
        with ExitStack() as opening:
            self._publisher = opening.enter_context(
                TransformPublisher(session, robot, writer, wires, clock=clock, program=program)
            )
            if buffer is None:
                wire = wires if isinstance(wires, str) else next(iter(wires))
                buffer = opening.enter_context(
                    TransformListener(session, robot, wire=wire, clock=clock)
                ).buffer
            self._buffer = buffer
            self._opened = opening.pop_all()
        self._thread = threading.Thread(target=self._run, name="zstate map correction", daemon=True)
        self._thread.start()

    def __repr__(self) -> str:
        held = "none yet" if self._held is None else f"the newest at {format_stamp(self._held.stamp)}"
        return f"<MapCorrection of {self.odom!r} in {self.map!r}: {held}>"

    @property
    def stats(self) -> PublisherStats:
        """Counts of the publisher of the edge; ``warning`` is not empty while it publishes nothing."""
        return self._publisher.stats

    def set(
        self,
        map_from_base: Transform,
        stamp: int | None = None,
        covariance: ArrayLike | None = None,
        *,
        timeout_s: float = 1.0,
    ) -> Transform:
        """Correct the odometry by a pose in the map, measured at ``stamp`` [ns]. Returns ``map_from_odom``.

        The source of ``map_from_base`` is any frame of the robot below odom, such as its laser. ``stamp`` and
        ``covariance``, (6, 6), are those of the transform by default. ``timeout_s`` waits for the odometry
        samples around the stamp.

        Raises InvalidInput for a transform with another target, without a stamp, or older than the correction
        that holds; as ``TransformBuffer.lookup`` if the odometry at the stamp is not known; and as
        ``TransformPublisher.publish``. If it raises, the earlier correction holds.
        """
        stamp = map_from_base.stamp if stamp is None else check_stamp(stamp)
        target, base = (full_name(self.robot, name) for name in (map_from_base.target, map_from_base.source))
        if stamp is None:
            raise InvalidInput(f"{map_from_base!r} has no stamp; a correction needs that of its measurement")
        if target != self.map:
            raise InvalidInput(f"a correction is a pose in {self.map!r}; got one in {target!r}")
        covariance = map_from_base.covariance if covariance is None else covariance
        odom_from_base = self._buffer.lookup(self.odom, base, stamp, timeout_s=timeout_s)
        # Static, which is exact: the error of the odometry is that of odom -> base alone.
        base_from_odom = Transform.from_pose7(base, self.odom, odom_from_base.inverse().pose7)
        measured = Transform.from_pose7(self.map, base, map_from_base.pose7)
        if covariance is not None:
            measured = measured.with_covariance(covariance)
        correction = Correction(measured @ base_from_odom, stamp, base, self._odometry_writer(base))
        with self._lock:
            self._hold(correction)
        return correction.map_from_odom

    def _hold(self, correction: Correction) -> None:
        held = self._held
        if held is not None and correction.stamp < held.stamp:
            age = format_duration(held.stamp - correction.stamp)
            raise InvalidInput(
                f"this correction was measured {age} before the one that holds; use the newest"
            )
        newest = self._buffer.latest(self.odom, correction.base)
        if self._published < correction.stamp < newest:
            self._publish(correction, correction.stamp)
        self._publish(correction, newest)
        self._held = correction
        self._publisher.warning = ""
        if held is None or held.base != correction.base:
            self._watch.close()
            self._watch.enter_context(
                self._buffer.watch(self.odom, correction.base, lambda _: self._has_advanced.set())
            )

    def _odometry_writer(self, base: str) -> str | None:
        """The writer of the edge that leads from odom towards ``base``, if it is announced."""
        _, (_, edge), *_ = self._buffer.path_frames(self.odom, base)
        return None if edge is None else edge.writer

    def _publish(self, correction: Correction, stamp: int) -> None:
        self._publisher.publish([correction.map_from_odom], stamp)
        self._published = stamp

    def _run(self) -> None:
        while True:
            self._has_advanced.wait()
            self._has_advanced.clear()
            if self._stop.is_set():
                return
            try:
                with self._lock:
                    self._follow()
            except LookupFailed:
                continue  # without odometry there is no instant to correct
            except (Closed, SecondWriter):
                return  # the next ``set`` raises it again

    def _follow(self) -> None:
        """Publish the correction that holds with the stamp of the newest odometry."""
        held = self._held
        if held is None:
            return
        newest = self._buffer.latest(self.odom, held.base)
        writer = self._odometry_writer(held.base)
        if newest < self._published or writer != held.odometry_writer:
            self._held, self._published = None, -1
            self._publisher.warning = (
                f"the odometry in {self.odom!r} was restarted (by {writer}): its origin is another one, and "
                f"{self.map!r} -> {self.odom!r} is not published until the next correction"
            )
        elif newest > self._published:
            self._publish(held, newest)

    def close(self) -> None:
        """Stop publishing; listeners keep the last correction. A second call does nothing."""
        self._stop.set()
        self._has_advanced.set()
        self._watch.close()
        self._thread.join(_JOIN_TIMEOUT_S)
        self._opened.close()
