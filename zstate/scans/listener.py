"""ScanListener: the scans of a robot, each ray placed by the pose at its own instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import Clock
from zstate.net.session import Session
from zstate.nodes.placing_listener import ByteLimits, PlacingListener
from zstate.scans.messages import LaserScan
from zstate.scans.scan import Scan, scan_from_message
from zstate.wire.keys import ANY
from zstate.wire.messages import Message

_LIMITS = ByteLimits(unread=64 * 2**20, waiting=16 * 2**20)
"""Reached before 256 scans: by 30 and 20 of the largest ones."""


@dataclass(frozen=True, eq=False)
class PlacedScan:
    """A ``scan`` whose rays stand in ``target``: ``points`` (N, 3) [m], NaN where ``valid`` (N,) is False.

    ``sensor`` is the name of the scanner. Each ray is placed by the pose at its own stamp. It is not valid if
    its range is no measurement, or if the history of the buffer begins after it. ``is_rigid`` means that the
    times of the rays are not known, and all are placed by the pose at the stamp of the scan.
    """

    scan: Scan
    sensor: str
    target: str
    points: NDArray[np.float32]
    valid: NDArray[np.bool_]

    @property
    def stamp(self) -> int:
        """The instant of the first ray [ns]."""
        return self.scan.stamp

    @property
    def is_rigid(self) -> bool:
        """Whether all rays are placed by one pose."""
        return self.scan.is_rigid

    def __repr__(self) -> str:
        rigid = ", rigid" if self.is_rigid else ""
        return f"<PlacedScan of {self.sensor!r} in {self.target!r}: {self.valid.sum()} points{rigid}>"


def _placed_size(placed: PlacedScan) -> int:
    return placed.scan.nbytes + placed.points.nbytes + placed.valid.nbytes


class ScanListener(PlacingListener[Scan, PlacedScan]):
    """Receives the scans of ``robot``, and places each ray in ``target`` by the pose at its own instant.

    ``for placed in scans`` and ``async for placed in scans`` return a PlacedScan for each scan, in the order
    in which they became placeable, and end with ``close()``. A scan waits for the pose of its *last* ray, at
    most ``timeout_s`` from its arrival: then it is counted in ``dropped`` by the name of the error, and
    ``last_reason`` names the edge that was too late. If more than 256 scans or 64 MiB are unread, or
    256 scans or 16 MiB of one sensor wait, the oldest are lost; ``dropped["Overflow"]`` counts them.
    ``refused`` counts messages that are no scan, by reason; the first of each reason is also logged.

    ``sensor`` selects one scanner of the robot; "*": all of them. On the wire "ros2dds", whose keys have no
    types, "*" is that of the topic ``scan``. Frames come from ``buffer``; without one, the listener fills a
    buffer of its own with the transforms of the robot. Bare frame names are the robot's own. ``clock`` is
    that of the buffer of its own; default: the system's. A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        target: str,
        *,
        sensor: str = ANY,
        buffer: TransformBuffer | None = None,
        wire: str = "native",
        timeout_s: float = 1.0,
        clock: Clock | None = None,
    ) -> None:
        super().__init__(
            session,
            robot,
            "scan",
            target,
            sensor=sensor,
            buffer=buffer,
            wire=wire,
            timeout_s=timeout_s,
            clock=clock,
            limits=_LIMITS,
            size_of=_placed_size,
        )
        self.target, self.buffer = self._in_target()

    def __repr__(self) -> str:
        return f"<ScanListener of {self.robot!r} in {self.target!r}: {len(self)} unread scans>"

    def _read(self, message: Message, robot: str) -> Scan:
        assert isinstance(message, LaserScan)
        return scan_from_message(message, robot)

    def _place(self, measured: Scan, sensor: str) -> PlacedScan:
        scan = measured
        target, buffer = self._in_target()
        points, valid = buffer.place(scan.points(), scan.stamps(), scan.frame, target)
        points = points.astype(np.float32, copy=False)  # for type checkers
        return PlacedScan(scan, sensor, target, points, valid)

    def _in_target(self) -> tuple[str, TransformBuffer]:
        assert self._target is not None  # scans always have one
        assert self._buffer is not None
        return self._target, self._buffer
