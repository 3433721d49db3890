"""Scans and maps as ROS 2 messages."""

from __future__ import annotations

import struct
from math import isfinite

from zstate.errors import InvalidInput
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.wire.measurements import FLOAT32_BYTES
from zstate.wire.messages import to_block
from zstate.wire.ros2.cdr import CdrReader, CdrWriter
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.streams import RosStream
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import LASER_SCAN, OCCUPANCY_GRID

_CELL_BYTES = 1
_SCAN_FLOATS = 7
_POSE_NUMBERS = 7


def encode_scan(scan: LaserScan, names: FrameNames) -> bytes:
    """The payload of ``scan``.

    ROS has float32 where it has float64 (angles, range limits), and seconds in float32 where it has
    nanoseconds: ``time_increment`` is ``ray_ns``, ``scan_time`` is ``scan_ns``. ``angle_max`` is the angle of
    the last ray. Raises InvalidInput for a number that float32 cannot represent, and for a stamp outside 1901
    to 2038.
    """
    last_ray = max(0, len(scan.ranges) // FLOAT32_BYTES - 1)
    angle_max = scan.angle_min + last_ray * scan.angle_increment
    angles = scan.angle_min, angle_max, scan.angle_increment
    times_s = scan.ray_ns * 1e-9, scan.scan_ns * 1e-9
    writer = CdrWriter()
    writer.stamp(scan.stamp)
    writer.text(names.to_ros(scan.frame))
    writer.numbers(_float32(*angles, *times_s, scan.range_min, scan.range_max), FLOAT32_BYTES)
    writer.sequence(scan.ranges, FLOAT32_BYTES)
    writer.sequence(scan.intensities or b"", FLOAT32_BYTES)
    return writer.payload()


def encode_grid(grid: OccupancyGrid, names: FrameNames) -> bytes:
    """The payload of ``grid``, with a resolution of float32; its stamp is also ``map_load_time``.

    Raises InvalidInput as ``encode_scan`` does.
    """
    writer = CdrWriter()
    writer.stamp(grid.stamp)
    writer.text(names.to_ros(grid.frame))
    writer.stamp(grid.stamp)
    writer.numbers(_float32(grid.resolution), FLOAT32_BYTES)
    writer.count(grid.width)
    writer.count(grid.height)
    writer.numbers(grid.origin)
    writer.sequence(grid.cells, _CELL_BYTES)
    return writer.payload()


def _float32(*numbers: float) -> bytes:
    try:
        return struct.pack(f"<{len(numbers)}f", *numbers)
    except OverflowError:
        raise InvalidInput(
            f"ROS 2 has float32 for {', '.join(map(str, numbers))}, and one of them is too large for it"
        ) from None


def decode_scan(payload: bytes, session: int, seq: int, names: FrameNames) -> LaserScan:
    """The scan in ``payload``; its ``angle_max`` is ignored.

    Raises MessageError with the reason "truncated" or "malformed".
    """
    reader = CdrReader(payload, LASER_SCAN.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    angle_min, _, angle_increment, ray_s, scan_s, range_min, range_max = _floats(reader, _SCAN_FLOATS)
    ranges, intensities = reader.sequence(FLOAT32_BYTES), reader.sequence(FLOAT32_BYTES)
    if not (isfinite(ray_s) and isfinite(scan_s)):
        raise reader.malformed(f"its time_increment is {ray_s}, and its scan_time {scan_s} [s]")
    times = round(ray_s * 1e9), round(scan_s * 1e9)
    geometry = angle_min, angle_increment, *times, range_min, range_max
    try:
        return LaserScan(stamp, seq, session, frame, *geometry, ranges, intensities or None)
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def decode_grid(payload: bytes, session: int, seq: int, names: FrameNames) -> OccupancyGrid:
    """The grid in ``payload``, which has no ``seq``; its ``map_load_time`` is ignored.

    Raises as ``decode_scan`` does.
    """
    reader = CdrReader(payload, OCCUPANCY_GRID.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    reader.stamp()
    (resolution,) = _floats(reader, 1)
    width, height, origin = reader.count(), reader.count(), reader.numbers(_POSE_NUMBERS)
    cells = reader.sequence(_CELL_BYTES)
    try:
        return OccupancyGrid(session, stamp, frame, resolution, width, height, origin, cells)
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def _floats(reader: CdrReader, count: int) -> tuple[float, ...]:
    return struct.unpack(f"<{count}f", reader.numbers(count, FLOAT32_BYTES))


def _is_withdrawn(grid: OccupancyGrid) -> bool:
    return not grid.cells


_WITHDRAWN = OccupancyGrid(0, 1, "map", 1.0, 0, 0, to_block([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), b"")
SCAN_STREAM = RosStream(
    LASER_SCAN, Qos("best_effort", depth=5), is_named=True, encode=encode_scan, decode=decode_scan
)
MAP_STREAM = RosStream(
    OCCUPANCY_GRID,
    Qos(durability="transient_local", depth=1),
    is_named=True,
    encode=encode_grid,
    decode=decode_grid,
    withdrawn=_WITHDRAWN,
    is_withdrawn=_is_withdrawn,
)
