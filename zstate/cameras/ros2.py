"""Pictures and calibrations as ROS 2 messages, and raw pictures of ROS.

Foxglove displays videos as foxglove_msgs/CompressedVideo alone, and has a name of its own for the model
``equidistant``; recordings have its form of a video, which foxglove_compressed_video_transport has as well.
"""

from __future__ import annotations

import struct
from typing import cast

import numpy as np
from numpy.typing import NDArray

from zstate.cameras.messages import CameraInfo, CameraModel, CompressedImage
from zstate.cameras.pictures import PICTURE_PIXELS, PictureFormat, format_of
from zstate.errors import InvalidInput, MessageError
from zstate.wire.messages import from_block, to_block
from zstate.wire.ros2.cdr import CdrReader, CdrWriter
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.streams import DisplayedForm, RosStream
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import CAMERA_INFO, COMPRESSED_IMAGE, COMPRESSED_VIDEO, IMAGE

_VIDEO: tuple[PictureFormat, ...] = ("h264", "h265")
_REGION = struct.Struct("<4I")
_REGION_NUMBERS = 4
_EQUIDISTANT_IN_FOXGLOVE = "kannala_brandt"
_CHANNELS = {
    "rgb8": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "rgba8": (0, 1, 2, 3),
    "bgra8": (2, 1, 0, 3),
    "mono8": (0,),
}
"""Which channel of an encoding is red, green, blue, and the last one that is left out."""

Floats = NDArray[np.float64]


def encode_image(image: CompressedImage, names: FrameNames) -> bytes:
    """The sensor_msgs/CompressedImage of a picture, whose ``format`` is that of the bytes alone.

    Raises InvalidInput if CDR cannot represent it.
    """
    writer = CdrWriter()
    writer.stamp(image.stamp)
    writer.text(names.to_ros(image.frame))
    writer.text(image.format)
    writer.sequence(image.data, 1)
    return writer.payload()


def decode_image(payload: bytes, session: int, seq: int, names: FrameNames) -> CompressedImage:
    """The picture in a sensor_msgs/CompressedImage, whose format is that of its first bytes.

    The text of the format, ``bgr8; jpeg compressed bgr8`` and the like, varies; that of a video begins with
    its name. Raises MessageError with the reason "truncated", "malformed", "too large", or "foreign" for a
    picture of another format.
    """
    reader = CdrReader(payload, COMPRESSED_IMAGE.name)
    stamp, frame, text = reader.stamp(), names.to_zstate(reader.text()), reader.text()
    data = reader.sequence(1)
    videos: list[PictureFormat] = [form for form in _VIDEO if text.startswith(form)]
    form = format_of(data) or next(iter(videos), None)
    if form is None:
        known = "neither JPEG nor PNG by its first bytes, nor a video by its format"
        raise MessageError(f"a {COMPRESSED_IMAGE.name} with {text!r}: {known}", reason="foreign")
    try:
        return CompressedImage(stamp, seq, session, frame, form, data)
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def encode_video(packet: CompressedImage, names: FrameNames) -> bytes:
    """The foxglove_msgs/CompressedVideo of a packet of H.264 or H.265.

    Raises InvalidInput if CDR cannot represent it.
    """
    writer = CdrWriter()
    writer.stamp(packet.stamp)
    writer.text(names.to_ros(packet.frame))
    writer.sequence(packet.data, 1)
    writer.text(packet.format)
    return writer.payload()


def decode_video(payload: bytes, session: int, seq: int, names: FrameNames) -> CompressedImage:
    """The packet in a foxglove_msgs/CompressedVideo.

    Raises MessageError with the reason "truncated", "malformed", or "foreign" for another format.
    """
    reader = CdrReader(payload, COMPRESSED_VIDEO.name)
    stamp, frame, data, text = (
        reader.stamp(),
        names.to_zstate(reader.text()),
        reader.sequence(1),
        reader.text(),
    )
    form: PictureFormat | None = next((one for one in _VIDEO if one == text), None)
    if form is None:
        known = ", ".join(_VIDEO)
        raise MessageError(f"a {COMPRESSED_VIDEO.name} of {text!r}; known are {known}", reason="foreign")
    try:
        return CompressedImage(stamp, seq, session, frame, form, data)
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def _is_video(image: CompressedImage) -> bool:
    return image.format in _VIDEO


def encode_camera_info(info: CameraInfo, names: FrameNames) -> bytes:
    """The sensor_msgs/CameraInfo of a calibration, which does not have ``line_time_ns``.

    Raises InvalidInput if CDR cannot represent it.
    """
    return _encode_camera_info(info, names, info.model)


def encode_displayed_camera_info(info: CameraInfo, names: FrameNames) -> bytes:
    """The same with Foxglove's name of the model ``equidistant``."""
    return _encode_camera_info(info, names, _EQUIDISTANT_IN_FOXGLOVE)


def _is_equidistant(info: CameraInfo) -> bool:
    return info.model == "equidistant"


def _encode_camera_info(info: CameraInfo, names: FrameNames, model: str) -> bytes:
    fx, fy, cx, cy = from_block(info.k).tolist()
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, float(info.is_calibrated)]])
    writer = CdrWriter()
    writer.stamp(info.stamp)
    writer.text(names.to_ros(info.frame))
    writer.count(info.height)
    writer.count(info.width)
    writer.text(model)
    writer.sequence(info.d)
    writer.numbers(to_block(matrix))
    writer.numbers(info.r or to_block(np.eye(3)))
    writer.numbers(info.p or to_block(_alone(matrix)))
    writer.count(0)  # binning, and the region: all of the picture
    writer.count(0)
    writer.numbers(bytes(_REGION.size), 4)
    writer.numbers(b"\x00", 1)
    return writer.payload()


def decode_camera_info(payload: bytes, session: int, seq: int, names: FrameNames) -> CameraInfo:
    """The calibration in a sensor_msgs/CameraInfo, for the pictures as they are sent.

    ROS has the numbers of the whole sensor, and a region and a binning of what is sent; here they are
    combined, as image_geometry does it. Raises MessageError with the reason "truncated" or "malformed".
    """
    reader = CdrReader(payload, CAMERA_INFO.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    height, width, model, d = reader.count(), reader.count(), reader.text(), reader.sequence()
    k, r, p = (from_block(reader.numbers(count)).reshape(3, -1) for count in (9, 9, 12))
    x, y = max(reader.count(), 1), max(reader.count(), 1)
    left, top, rows, columns = _REGION.unpack(reader.numbers(_REGION_NUMBERS, 4))
    reader.numbers(1, 1)
    sent_from_sensor = np.array([[1.0 / x, 0.0, -left / x], [0.0, 1.0 / y, -top / y], [0.0, 0.0, 1.0]])
    with np.errstate(all="ignore"):  # what is not finite is malformed below
        k, p = sent_from_sensor @ k, sent_from_sensor @ p
    if not k.any():  # not calibrated: drivers put any model and numbers beside that
        model, d = "plumb_bob", b""
    elif k[0, 1] or k[1, 0] or k[2].tolist() != [0.0, 0.0, 1.0]:
        raise reader.malformed(f"its k is [fx 0 cx; 0 fy cy; 0 0 1], not {k.tolist()}")
    try:
        return CameraInfo(
            stamp,
            seq,
            session,
            frame,
            (columns or width) // x,
            (rows or height) // y,
            cast("CameraModel", model),  # which the message checks
            to_block([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]),
            d,
            r=None if np.array_equal(r, np.eye(3)) or not r.any() else to_block(r),
            p=None if np.array_equal(p, _alone(k)) or not p.any() else to_block(p),
        )
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def _alone(k: Floats) -> Floats:
    """The projection of a camera with the matrix ``k`` that is not of a stereo pair: (3, 4)."""
    return np.insert(k, 3, 0.0, axis=1)


def decode_raw_image(payload: bytes, names: FrameNames) -> tuple[int, str, NDArray[np.uint8]]:
    """The stamp [ns], the frame and the pixels of a sensor_msgs/Image, which the payload holds.

    The pixels are RGB (H, W, 3), or gray (H, W). Raises MessageError with the reason "truncated",
    "malformed", "too large", "no stamp", or "foreign" for an encoding without 8 bits a channel.
    """
    reader = CdrReader(payload, IMAGE.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    if not stamp:
        raise MessageError(f"the stamp of a {IMAGE.name} is zero, which means none in ROS", reason="no stamp")
    height, width, encoding = reader.count(), reader.count(), reader.text()
    reader.numbers(1, 1)  # the order of bytes, of which each channel has one
    step = reader.count()
    order = _CHANNELS.get(encoding)
    if order is None:
        known = ", ".join(_CHANNELS)
        raise MessageError(f"a {IMAGE.name} of {encoding!r}; known are {known}", reason="foreign")
    if width * height > PICTURE_PIXELS:
        text = f"a {IMAGE.name} of {width} x {height}; pictures have up to {PICTURE_PIXELS} pixels"
        raise MessageError(text, reason="too large")
    data = reader.sequence(1)
    channels = len(order)
    if not width * height or step < width * channels or len(data) != step * height:
        text = f"{width} x {height} of {encoding}, step={step}, have {len(data)} bytes"
        raise reader.malformed(text)
    rows = np.frombuffer(data, np.uint8).reshape(height, step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels)
    return stamp, frame, pixels[..., 0] if channels == 1 else pixels[..., order[:3]]


def _has_no_camera(info: CameraInfo) -> bool:
    return not (info.width and info.height)


_WITHDRAWN = CameraInfo(1, 0, 0, "camera", 0, 0, "plumb_bob", bytes(4 * 8), b"")
IMAGE_STREAM = RosStream(
    COMPRESSED_IMAGE,
    Qos("best_effort", depth=5),
    is_named=True,
    is_of_sensor=True,
    suffix="image_raw/compressed",
    encode=encode_image,
    decode=decode_image,
    # The name of foxglove_compressed_video_transport among the transports of a camera.
    displayed=DisplayedForm(COMPRESSED_VIDEO, "image_raw/foxglove", _is_video, encode_video, decode_video),
)
CAMERA_INFO_STREAM = RosStream(
    CAMERA_INFO,
    Qos(durability="transient_local", depth=1),
    is_named=True,
    is_of_sensor=True,
    suffix="camera_info",
    encode=encode_camera_info,
    decode=decode_camera_info,
    withdrawn=_WITHDRAWN,
    uncarried_number="line_time_ns",
    is_withdrawn=_has_no_camera,
    displayed=DisplayedForm(CAMERA_INFO, "camera_info", _is_equidistant, encode_displayed_camera_info),
)
