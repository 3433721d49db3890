"""Clouds as ROS 2 messages: sensor_msgs/PointCloud2. Livox's CustomMsg is not read."""

from __future__ import annotations

from zstate.clouds.cloud import message_points
from zstate.clouds.messages import CLOUD_FIELDS, PointCloud, PointField
from zstate.errors import InvalidInput
from zstate.wire.ros2.cdr import CdrReader, CdrWriter
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.streams import RosStream
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import POINT_CLOUD2

_BYTE = 1


def encode_cloud(cloud: PointCloud, names: FrameNames) -> bytes:
    """The payload of ``cloud``, decompressed: ROS has no field for a compression.

    Raises InvalidInput for a stamp outside 1901 to 2038, and for compressed data that is none of its points.
    """
    data = message_points(cloud).tobytes() if cloud.compression else cloud.data
    writer = CdrWriter()
    writer.stamp(cloud.stamp)
    writer.text(names.to_ros(cloud.frame))
    writer.count(cloud.height)
    writer.count(cloud.width)
    writer.count(len(cloud.fields))
    for name, offset, datatype, count in cloud.fields:
        writer.text(name)
        writer.count(offset)
        writer.numbers(bytes([datatype]), _BYTE)
        writer.count(count)
    writer.numbers(bytes([cloud.is_bigendian]), _BYTE)
    writer.count(cloud.point_step)
    writer.count(cloud.row_step)
    writer.sequence(data, _BYTE)
    writer.numbers(bytes([cloud.is_dense]), _BYTE)
    return writer.payload()


def decode_cloud(payload: bytes, session: int, seq: int, names: FrameNames) -> PointCloud:
    """The cloud in ``payload``. Raises MessageError with the reason "truncated" or "malformed"."""
    reader = CdrReader(payload, POINT_CLOUD2.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    height, width, field_count = reader.count(), reader.count(), reader.count()
    if field_count > CLOUD_FIELDS:
        raise reader.malformed(f"points of {field_count} fields, where {CLOUD_FIELDS} are allowed")
    fields = tuple(_field(reader) for _ in range(field_count))
    is_bigendian = _flag(reader)
    point_step, row_step = reader.count(), reader.count()
    data = reader.sequence(_BYTE)
    layout = height, width, fields, is_bigendian, point_step, row_step
    try:
        return PointCloud(stamp, seq, session, frame, *layout, data, _flag(reader))
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def _field(reader: CdrReader) -> PointField:
    name, offset = reader.text(), reader.count()
    return PointField(name, offset, reader.numbers(1, _BYTE)[0], reader.count())


def _flag(reader: CdrReader) -> bool:
    return reader.numbers(1, _BYTE) != b"\0"


CLOUD_STREAM = RosStream(
    POINT_CLOUD2,
    Qos("best_effort", depth=5),
    is_named=True,
    encode=encode_cloud,
    decode=decode_cloud,
    is_of_sensor=True,
)
