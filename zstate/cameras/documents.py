"""Pictures and calibrations as documents, which `zstate echo` prints: never the bytes of a picture."""

from __future__ import annotations

from typing import Any

from zstate.cameras.messages import CameraInfo, CompressedImage
from zstate.wire.keys import full_name
from zstate.wire.messages import from_block


def image_document(message: CompressedImage, robot: str) -> dict[str, Any]:
    """A picture of ``robot``: stamp [ns], format, bytes, and its size in pixels, None of a video."""
    width, height = message.size or (None, None)
    return {
        "stamp": message.stamp,
        "seq": message.seq,
        "frame": full_name(robot, message.frame),
        "format": message.format,
        "width": width,
        "height": height,
        "bytes": len(message.data),
    }


def camera_info_document(message: CameraInfo, robot: str) -> dict[str, Any]:
    """A calibration of ``robot``: stamp [ns], size and focal lengths [px], and the numbers of the lens."""
    fx, fy, cx, cy = from_block(message.k).tolist()
    return {
        "stamp": message.stamp,
        "frame": full_name(robot, message.frame),
        "width": message.width,
        "height": message.height,
        "model": message.model,
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "d": from_block(message.d).tolist(),
        "line_time_ns": message.line_time_ns,
    }
