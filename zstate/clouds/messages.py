"""Messages of point clouds on the native wire."""

from __future__ import annotations

from math import inf
from typing import Annotated, Literal, NamedTuple

from msgspec import Meta

from zstate.errors import InvalidInput
from zstate.message import Count, StampedMessage
from zstate.streams import MEGABYTE
from zstate.wire.measurements import check_frame

CLOUD_POINTS = 4_000_000
"""The most points of a cloud."""
CLOUD_BYTES = 60 * MEGABYTE
"""The most bytes of its points, before compression."""
CLOUD_FIELDS = 64
"""The most fields of a point."""
_NAME_LENGTH = 256

DATATYPE_BYTES = (0, 1, 1, 2, 2, 4, 4, 4, 8)
"""By the numbers of sensor_msgs/PointField: int8, uint8, int16, uint16, int32, uint32, float32, float64."""


class PointField(NamedTuple):
    """A field of each point: ``count`` numbers from the byte ``offset`` on.

    ``datatype`` is 1 to 8: int8, uint8, int16, uint16, int32, uint32, float32, float64.
    """

    name: str
    offset: Count
    datatype: Annotated[int, Meta(ge=1, le=8)]
    count: Count  # pyright: ignore[reportIncompatibleMethodOverride]  # the name in ROS; a tuple's is not used


class PointCloud(StampedMessage, frozen=True, array_like=True, gc=False):
    """Points of one sensor, in ``frame``, as in sensor_msgs/PointCloud2.

    ``data`` has ``height`` rows of ``row_step`` bytes, each with ``width`` points of ``point_step`` bytes; a
    cloud that is not organised has one row. ``is_dense`` is the writer's claim that all numbers are finite.
    ``stamp`` is the instant to which relative times of points refer.

    With a ``compression``, "lz4" or "zstd", ``data`` is compressed as ``zstate.clouds.compression`` has it,
    rows have no padding, and numbers are little-endian. ``resolution`` [m] is what x, y and z were rounded
    to; 0 if they were not.
    """

    frame: str
    height: Count
    width: Count
    fields: tuple[PointField, ...]
    is_bigendian: bool
    point_step: Count
    row_step: Count
    data: bytes
    is_dense: bool
    compression: Literal["", "lz4", "zstd"] = ""
    resolution: float = 0.0

    def __post_init__(self) -> None:
        check_frame(self.frame)
        check_counts(self.height * self.width, self.point_step)
        check_fields(self.fields, self.point_step)
        if self.width * self.point_step > self.row_step and self.height:
            raise InvalidInput(
                f"{self.width} points of {self.point_step} bytes do not fit into a row of {self.row_step}"
            )
        if self.compression:
            self._check_compressed()
        elif self.height * self.row_step != len(self.data):
            raise InvalidInput(
                f"{self.height} rows of {self.row_step} bytes need as many; the cloud has {len(self.data)}"
            )
        if not 0.0 <= self.resolution < inf or (self.resolution and not self.compression):
            raise InvalidInput(
                f"the resolution of a compressed cloud is 0 or more, of others 0; got {self.resolution}"
            )

    def _check_compressed(self) -> None:
        if self.row_step != self.width * self.point_step or self.is_bigendian:
            raise InvalidInput("a compressed cloud has rows without padding, and little-endian numbers")
        if sum(DATATYPE_BYTES[field.datatype] * field.count for field in self.fields) > self.point_step:
            raise InvalidInput("the fields of a compressed cloud do not overlap")
        if len(self.data) > CLOUD_BYTES:
            raise InvalidInput(f"{len(self.data)} compressed bytes, where {CLOUD_BYTES} are allowed")


def check_counts(points: int, point_step: int) -> None:
    """Raise InvalidInput unless a cloud may have ``points`` of ``point_step`` bytes."""
    if points > CLOUD_POINTS or points * point_step > CLOUD_BYTES:
        raise InvalidInput(
            f"a cloud of {points} points of {point_step} bytes, where {CLOUD_POINTS} points and "
            f"{CLOUD_BYTES} bytes are allowed: publish it in several clouds, or fewer points and fields"
        )


def check_fields(fields: tuple[PointField, ...], point_step: int) -> None:
    """Raise InvalidInput unless a point of ``point_step`` bytes has ``fields``, of different names."""
    if not 0 < len(fields) <= CLOUD_FIELDS:
        raise InvalidInput(f"a point has 1 to {CLOUD_FIELDS} fields, not {len(fields)}")
    names = [field.name for field in fields]
    if len(set(names)) != len(names):
        raise InvalidInput(f"the fields of a point have different names, not {', '.join(names)}")
    for name, offset, datatype, count in fields:
        if not 0 < len(name) <= _NAME_LENGTH or not 0 < datatype < len(DATATYPE_BYTES) or not count:
            raise InvalidInput(
                f"the field {name[:40]!r} has the datatype {datatype} and the count {count}; a name has 1 to "
                f"{_NAME_LENGTH} characters, a datatype is 1 to 8, a count 1 or more"
            )
        if offset + DATATYPE_BYTES[datatype] * count > point_step:
            raise InvalidInput(
                f"the field {name!r}, {count} times {DATATYPE_BYTES[datatype]} bytes from byte {offset} on, "
                f"is not inside a point of {point_step} bytes"
            )
