"""Mp4File: pictures as a video in a file, by PyAV."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

from zstate._util.closeable import Closeable
from zstate.cameras.codecs import Pixels, pyav
from zstate.errors import InvalidInput

CODEC, PIXEL_FORMAT = "h264", "yuv420p"

_OPTIONS = {"crf": "23", "preset": "veryfast"}
_KEY_EVERY = 2


class Mp4File(Closeable):
    """An mp4 of H.264 with ``fps`` pictures a second of ``size``, width and height [px].

    Picture i has the time i / fps, exactly. Every second one is a key frame, and none depends on a later one,
    so that any picture is decoded from two at most. A context manager.

    Raises InvalidInput for a width or height that is odd, which the format does not have, and LibraryMissing.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int) -> None:
        width, height = size
        if width % 2 or height % 2:
            raise InvalidInput(
                f"pictures of {width} x {height}: a video in {PIXEL_FORMAT} has an even width and height; "
                "let the camera send such pictures"
            )
        self._av = pyav()
        self._container: Any = self._av.open(str(path), "w", format="mp4")
        self._stream: Any = self._container.add_stream("libx264", rate=fps, options=_OPTIONS)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = PIXEL_FORMAT
        context = self._stream.codec_context
        context.gop_size, context.max_b_frames, context.time_base = _KEY_EVERY, 0, Fraction(1, fps)
        self._count = 0

    def write(self, pixels: Pixels) -> None:
        """Append a picture: RGB (H, W, 3)."""
        frame = self._av.VideoFrame.from_ndarray(pixels, format="rgb24")
        frame.pts, frame.time_base = self._count, self._stream.codec_context.time_base
        self._count += 1
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write what the encoder holds back, and the index. A second call does nothing."""
        if self._container is not None:
            container, self._container = self._container, None
            with container:
                container.mux(self._stream.encode(None))
