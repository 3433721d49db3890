"""Messages of cameras on the native wire: pictures as they were encoded, and calibrations."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from zstate._util.format import SECOND_NS
from zstate.cameras.pictures import PictureFormat, check_picture, picture_size
from zstate.errors import InvalidInput
from zstate.message import Count, StampedMessage
from zstate.wire.measurements import check_finite, check_frame
from zstate.wire.messages import Interval, from_block

CameraModel: TypeAlias = Literal["plumb_bob", "rational_polynomial", "equidistant"]
"""The distortions of sensor_msgs/distortion_models.hpp; see zstate.cameras.camera."""

_LARGEST_SIDE = 65_535
_LARGEST_COEFFICIENT = 1e6
COEFFICIENTS: dict[CameraModel, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8,),
    "equidistant": (0, 4),
}
"""How many numbers the distortion of a model may have; none is no distortion."""

_NUMBER_BYTES = 8


class CompressedImage(StampedMessage, frozen=True, array_like=True, gc=False):
    """One picture of a camera, or one packet of a video with exactly one picture.

    ``stamp`` is the instant of the first row. ``frame``, named as in edges, is that of the camera: z looks
    forward, x to the right and y down. ``data`` are the bytes as the camera or the encoder made them, those
    of H.264 and H.265 in the byte stream format (Annex B).
    """

    frame: str
    format: PictureFormat
    data: bytes

    def __post_init__(self) -> None:
        check_frame(self.frame)
        check_picture(self.data, self.format)

    @property
    def size(self) -> tuple[int, int] | None:
        """The width and height [px] by the header; None of video."""
        return picture_size(self.data, self.format)


class CameraInfo(StampedMessage, frozen=True, array_like=True, gc=False):
    """The calibration of a camera, for pictures of ``width`` x ``height`` [px] as it sends them.

    ``k`` is a block of fx, fy, cx, cy [px], which are zero if the camera is not calibrated; the center of the
    first pixel is 0, 0. ``d`` is a block of the numbers of the distortion ``model``, in the order of OpenCV.
    Row i of a picture has the stamp ``stamp + i * line_time_ns``, zero for a global shutter. Of a stereo
    camera ``r`` is a block of the rotation that rectifies (3 x 3, row by row), and ``p`` one of the
    projection after it (3 x 4); None are those of a camera alone.
    """

    frame: str
    width: Count
    height: Count
    model: CameraModel
    k: bytes
    d: bytes
    line_time_ns: Interval = 0
    r: bytes | None = None
    p: bytes | None = None

    def __post_init__(self) -> None:
        check_frame(self.frame)
        _check_block("k", self.k, 4)
        if self.model not in COEFFICIENTS:
            raise InvalidInput(f"the models of cameras are {', '.join(COEFFICIENTS)}, not {self.model!r}")
        _check_block("d", self.d, *COEFFICIENTS[self.model])
        if self.d and np.abs(from_block(self.d)).max() > _LARGEST_COEFFICIENT:
            raise InvalidInput(f"d has numbers up to {_LARGEST_COEFFICIENT:g}; got {from_block(self.d)}")
        if self.r is not None:
            _check_block("r", self.r, 9)
        if self.p is not None:
            _check_block("p", self.p, 12)
        if max(self.width, self.height) > _LARGEST_SIDE:
            size = f"{self.width} x {self.height}"
            raise InvalidInput(f"a picture has at most {_LARGEST_SIDE} columns and rows, not {size}")
        fx, fy, *_ = from_block(self.k).tolist()
        if self.is_calibrated and not (min(fx, fy) > 0.0 and self.width and self.height):
            raise InvalidInput(
                f"a calibrated camera has pictures and focal lengths above 0; got {self.width} x "
                f"{self.height}, fx={fx}, fy={fy}. All of k is zero if it is not calibrated"
            )
        if not 0 <= self.line_time_ns * self.height < SECOND_NS:
            raise InvalidInput(
                f"the rows of a picture are read within a second: {self.height} of them with "
                f"line_time_ns={self.line_time_ns} are not"
            )

    @property
    def is_calibrated(self) -> bool:
        """Whether its focal lengths are known."""
        return bool(from_block(self.k).any())


def _check_block(name: str, block: bytes, *counts: int) -> None:
    """Raises InvalidInput unless ``block`` has one of ``counts`` of finite numbers."""
    if len(block) not in [count * _NUMBER_BYTES for count in counts]:
        allowed = " or ".join(map(str, counts))
        raise InvalidInput(f"{name} has {allowed} float64, not {len(block) / _NUMBER_BYTES:g}")
    check_finite(name, *from_block(block).tolist())
