"""Pictures and videos, made by simplejpeg and PyAV."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import simplejpeg

_ENCODERS = {"png": "png", "h264": "libx264", "h265": "libx265"}


def pixels(width: int = 64, height: int = 48, brightness: int = 0) -> np.ndarray:
    """A smooth RGB picture (height, width, 3), which differs by ``brightness`` and in its corners."""
    rows, columns = np.mgrid[0:height, 0:width]
    red, green = 100 * columns // width, 100 * rows // height
    return np.stack((red, green, np.full_like(red, brightness)), axis=2).astype(np.uint8)


def jpeg(width: int = 64, height: int = 48, brightness: int = 0) -> bytes:
    return simplejpeg.encode_jpeg(pixels(width, height, brightness))


def png(width: int = 64, height: int = 48) -> bytes:
    return b"".join(_encoded([pixels(width, height)], "png", {}))


def video(count: int, form: str = "h264", *, key_every: int = 30, step: int = 20) -> list[bytes]:
    """The packets of ``count`` pictures of 64 x 48, the i-th with the brightness ``step`` i, in Annex B."""
    options = {"tune": "zerolatency", "preset": "ultrafast"}
    options |= {"x265-params": "log-level=none"} if form == "h265" else {}
    return _encoded([pixels(brightness=step * number) for number in range(count)], form, options, key_every)


def video_file(path: Path, count: int = 5, codec: str = "mjpeg", rate: int = 50) -> str:
    """A video of ``count`` pictures of 64 x 48, as ``video`` has them; its name gives its container."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height = 64, 48
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for number in range(count):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels(brightness=20 * number), "rgb24")))
        container.mux(stream.encode(None))
    return str(path)


def _encoded(
    pictures: list[np.ndarray], form: str, options: dict[str, str], key_every: int = 30
) -> list[bytes]:
    height, width = pictures[0].shape[:2]
    encoder = av.CodecContext.create(_ENCODERS[form], "w")
    encoder.width, encoder.height, encoder.time_base = width, height, Fraction(1, 30)
    encoder.pix_fmt = "rgb24" if form == "png" else "yuv420p"
    encoder.options, encoder.gop_size, encoder.max_b_frames = options, key_every, 0
    packets: list[bytes] = []
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts = number
        packets += map(bytes, encoder.encode(frame))
    return packets + list(map(bytes, encoder.encode(None)))
