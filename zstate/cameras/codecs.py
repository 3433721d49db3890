"""Encoding and decoding of pictures: JPEG by simplejpeg, PNG and video by PyAV, loaded when needed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.cameras.pictures import PICTURE_PIXELS, PictureFormat, is_key_frame
from zstate.errors import InvalidInput, LibraryMissing, MessageError

Pixels = NDArray[np.uint8]

_DECODERS = {"png": "png", "h264": "h264", "h265": "hevc"}
"""The names that FFmpeg has for them."""


def check_pixels(pixels: Any) -> Pixels:
    """``pixels`` if they are a picture: uint8, RGB (H, W, 3) or gray (H, W). Raises InvalidInput if not."""
    array: Any = np.asarray(pixels)
    is_picture = array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)
    if array.dtype != np.uint8 or not is_picture:
        raise InvalidInput(
            "a picture is an array of uint8, RGB (H, W, 3) or gray (H, W), or the bytes of a JPEG or PNG; "
            f"got {array.dtype} of shape {array.shape}"
        )
    height, width = array.shape[:2]
    if not 0 < width * height <= PICTURE_PIXELS:
        raise InvalidInput(f"pictures have 1 to {PICTURE_PIXELS} pixels, not {width} x {height}")
    return array


def to_jpeg(pixels: Pixels, quality: int) -> bytes:
    """The JPEG of a checked picture, of ``quality`` 1 to 100. Raises LibraryMissing."""
    simplejpeg = _simplejpeg()
    array = np.ascontiguousarray(pixels)
    if array.ndim == 2:
        gray = array[..., np.newaxis]
        return simplejpeg.encode_jpeg(gray, quality, colorspace="GRAY", colorsubsampling="Gray")
    return simplejpeg.encode_jpeg(array, quality, colorspace="RGB", colorsubsampling="420")


def decode_still(data: bytes, form: PictureFormat) -> Pixels:
    """The pixels of a checked JPEG or PNG: RGB (H, W, 3).

    Raises MessageError with the reason "broken" if they cannot be decoded, and LibraryMissing.
    """
    if form != "jpeg":
        return VideoDecoder(form).decode(data)
    simplejpeg = _simplejpeg()
    try:
        return simplejpeg.decode_jpeg(data, colorspace="RGB")
    except ValueError as error:
        raise MessageError(f"a broken jpeg of {len(data)} bytes: {error}", reason="broken") from None


class PacketOrder:
    """The packets of one video, one after the other: which can be decoded.

    They begin with a key frame, and again after a packet that was lost or broken.
    """

    def __init__(self, form: PictureFormat) -> None:
        self.form: PictureFormat = form
        self._is_waiting = True
        self._next: tuple[int, int] | None = None

    def skip(self) -> None:
        """Wait for the next key frame: a packet is lost."""
        self._is_waiting = True

    def begins(self, packet: bytes, number: tuple[int, int] | None = None) -> bool:
        """Whether the next packet is a key frame that was waited for.

        ``number`` is the session of its writer, and the number in it: a gap is a loss. Raises MessageError
        with the reason "no key frame" if the packet cannot be decoded.
        """
        if number is not None:
            if number != self._next:
                self.skip()
            self._next = number[0], number[1] + 1
        if not self._is_waiting:
            return False
        if not is_key_frame(packet, self.form):
            text = f"a packet of {self.form} before the first key frame, or after a loss"
            raise MessageError(text, reason="no key frame")
        self._is_waiting = False
        return True


class VideoDecoder:
    """Decodes the packets of one video, one after the other; each gives a picture, as there are no B-frames.

    It begins with a key frame, and again after a packet that was lost or broken. Raises LibraryMissing.
    """

    def __init__(self, form: PictureFormat) -> None:
        self.form: PictureFormat = form
        self._av = pyav()
        self._decoder: Any = None
        self._order = PacketOrder(form)

    def skip(self) -> None:
        """Wait for the next key frame: a packet is lost."""
        self._order.skip()

    def decode(self, packet: bytes, number: tuple[int, int] | None = None) -> Pixels:
        """The pixels of the next packet: RGB (H, W, 3).

        ``number`` as of ``PacketOrder``. Raises MessageError with its reason "no key frame", or "broken".
        """
        if self._order.begins(packet, number):
            self._decoder = self._av.CodecContext.create(_DECODERS[self.form], "r")
            self._decoder.thread_count = 1  # with more of them a picture comes some packets later
            self._decoder.options = {"max_pixels": str(PICTURE_PIXELS)}
        try:
            (frame,) = self._decoder.decode(self._av.Packet(packet))
            pixels: Pixels = frame.to_ndarray(format="rgb24")
        except (ValueError, MemoryError) as error:  # FFmpeg's errors are these; a picture is missing
            self.skip()
            text = f"a broken {self.form} of {len(packet)} bytes: {error}"
            raise MessageError(text, reason="broken") from None
        pixels.flags.writeable = False  # those of a listener's picture
        return pixels


def _simplejpeg() -> Any:
    """The module. Raises LibraryMissing."""
    try:
        import simplejpeg  # noqa: PLC0415 # pyright: ignore[reportMissingTypeStubs] - loaded when it is needed
    except ImportError:
        raise _missing("JPEG needs simplejpeg") from None
    return simplejpeg


def pyav() -> Any:
    """The module. Raises LibraryMissing."""
    try:
        import av  # noqa: PLC0415 - loaded when it is needed
    except ImportError:
        raise _missing("PNG and video need PyAV") from None
    return av


def _missing(what: str) -> LibraryMissing:
    command = "pip install 'zstate[cameras]'"
    return LibraryMissing(f"{what}: {command}", command=command)
