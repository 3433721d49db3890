"""Messages of laser scanners, and maps, on the native wire."""

from __future__ import annotations

import zlib
from math import inf

import numpy as np
from numpy.typing import NDArray

from zstate.errors import InvalidInput, MessageError
from zstate.message import Count, Message, SessionId, Stamp, StampedMessage
from zstate.streams import GRID_CELLS, LATCHED_BYTES
from zstate.wire.measurements import FLOAT32_BYTES, check_finite, check_frame
from zstate.wire.messages import POSE_BYTES, Interval, from_block

_DEFLATED_BYTES = 64_000
_DEFLATED = b"\x78"
_FASTEST = 1

SCAN_RAYS = 100_000
"""The most rays of a laser scan."""


class LaserScan(StampedMessage, frozen=True, array_like=True, gc=False):
    """One scan of a planar laser, which measures its rays one after the other.

    Ray i has the angle ``angle_min + i * angle_increment`` [rad], from the x axis of ``frame`` about its z
    axis, and the stamp ``stamp + i * ray_ns``. ``ray_ns`` is zero if it is not known, and so is ``scan_ns``,
    the time between two scans. ``ranges`` [m] is a block of float32. A range outside of ``range_min`` to
    ``range_max`` is no measurement: -inf if too near, inf without an echo, NaN if invalid (REP 117).
    ``intensities`` is None or such a block, in units of the device. ``frame`` is named as in edges.
    """

    frame: str
    angle_min: float
    angle_increment: float
    ray_ns: Interval
    scan_ns: Interval
    range_min: float
    range_max: float
    ranges: bytes
    intensities: bytes | None = None

    def __post_init__(self) -> None:
        check_frame(self.frame)
        check_finite("angles", self.angle_min, self.angle_increment)
        if not 0.0 <= self.range_min <= self.range_max or self.range_min == inf:
            limits = f"{self.range_min} and {self.range_max}"
            raise InvalidInput(f"a scan has 0 <= range_min <= range_max, range_min finite, not {limits}")
        count, rest = divmod(len(self.ranges), FLOAT32_BYTES)
        if rest:
            raise InvalidInput(f"a block of float32 has a multiple of 4 bytes, not {len(self.ranges)}")
        if count > SCAN_RAYS:
            raise InvalidInput(
                f"a scan of {count} rays, where {SCAN_RAYS} are allowed: publish it in several scans"
            )
        if self.intensities is not None and len(self.intensities) != len(self.ranges):
            raise InvalidInput(
                f"{count} ranges take as many intensities; got {len(self.intensities)} bytes, not {4 * count}"
            )
        last_stamp = self.stamp + count * self.ray_ns
        if min(self.ray_ns, self.scan_ns) < 0 or max(last_stamp, self.scan_ns) >= 2**63:
            raise InvalidInput(
                f"{count} rays of {self.ray_ns} ns each, in a scan of {self.scan_ns} ns: times are not "
                "negative, and the stamp of the last ray has 64 bits"
            )


class OccupancyGrid(Message, frozen=True, array_like=True, gc=False):
    """A map of square cells: the probability that a cell is occupied [%], or -1 if not known.

    ``cells`` are int8, row by row: each of the ``height`` rows has ``width`` cells along the grid's x axis,
    and rows follow its y axis. A cell has edges of ``resolution`` [m]. ``origin`` is a block of one pose,
    ``frame_from_grid``, at the corner of the first cell. ``frame`` is named as in edges; ``stamp`` [ns] is
    the time of the map.

    Above 64 kB the payload is deflated (zlib, RFC 1950). Its first byte is then 0x78, with which no array of
    MessagePack begins.
    """

    session: SessionId
    stamp: Stamp
    frame: str
    resolution: float
    width: Count
    height: Count
    origin: bytes
    cells: bytes

    @staticmethod
    def pack(payload: bytes) -> bytes:
        return zlib.compress(payload, _FASTEST) if len(payload) > _DEFLATED_BYTES else payload

    @staticmethod
    def unpack(payload: bytes) -> bytes:
        return _inflated(payload) if payload.startswith(_DEFLATED) else payload

    def __post_init__(self) -> None:
        check_frame(self.frame)
        if not 0.0 < self.resolution < inf:
            raise InvalidInput(f"the resolution of a grid is positive and finite [m], not {self.resolution}")
        if len(self.origin) != POSE_BYTES:
            raise InvalidInput(f"the origin is a pose of {POSE_BYTES} bytes, not {len(self.origin)}")
        check_finite("an origin", *from_block(self.origin).tolist())
        if min(self.width, self.height) < 0 or len(self.cells) != self.width * self.height:
            raise InvalidInput(
                f"a grid of {self.width} x {self.height} needs as many cells, not {len(self.cells)}"
            )
        if len(self.cells) > GRID_CELLS:
            raise InvalidInput(
                f"a grid of {len(self.cells)} cells, where {GRID_CELLS} are allowed (4096 x 4096)"
            )
        values = np.frombuffer(self.cells, dtype=np.int8)
        if values.size and not -1 <= values.min() <= values.max() <= 100:
            raise InvalidInput(
                f"cells are from -1 (not known) to 100 (occupied), not {values.min()} to {values.max()}"
            )


def _inflated(payload: bytes) -> bytes:
    """The deflated grid in ``payload``; at most one byte more than is allowed is inflated."""
    inflater = zlib.decompressobj()
    try:
        data = inflater.decompress(payload, LATCHED_BYTES + 1)
    except zlib.error as error:
        raise MessageError(f"a malformed OccupancyGrid: {error}", reason="malformed") from None
    if len(data) > LATCHED_BYTES:
        text = f"an OccupancyGrid of more than {LATCHED_BYTES} bytes, deflated to {len(payload)}"
        raise MessageError(text, reason="too large")
    if not inflater.eof:
        text = f"a deflated OccupancyGrid cut off after {len(payload)} bytes"
        raise MessageError(text, reason="truncated")
    if inflater.unused_data:
        text = f"a malformed OccupancyGrid: {len(inflater.unused_data)} bytes after its deflated ones"
        raise MessageError(text, reason="malformed")
    return data


def cells_of(grid: OccupancyGrid) -> NDArray[np.int8]:
    """The cells of ``grid``: (height, width), read-only, sharing its memory; row 0 is at the origin."""
    return np.frombuffer(grid.cells, dtype=np.int8).reshape(grid.height, grid.width)
