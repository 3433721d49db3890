"""What the first bytes of an encoded picture say: its format and its size, before it is decoded.

A decoder allocates what a header asks for: a PNG of 100 kB may ask for gigabytes. JPEG is ITU-T
T.81, Annex B; PNG is RFC 2083; the packets of H.264 and H.265 are in the byte stream format of their Annex B.
"""

from __future__ import annotations

import struct
from typing import Literal, TypeAlias

from zstate.errors import MessageError

PictureFormat: TypeAlias = Literal["jpeg", "png", "h264", "h265"]
"""H.264 and H.265 are those of a video: a picture needs the ones before it, since the last key frame."""

PICTURE_PIXELS = 64_000_000
"""The pixels of the largest picture; decoded it takes three times as many bytes."""

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = struct.Struct(">8xI4sII")
_PNG_END = b"IEND\xaeB`\x82"
_JPEG = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
_START_OF_SCAN = 0xDA
# Frame headers: C0 to CF, but for the tables C4 and CC, and the reserved C8.
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = frozenset((0x01, *range(0xD0, 0xD9)))
_START_CODES = (b"\x00\x00\x01", b"\x00\x00\x00\x01")
_KEY_UNITS = {"h264": frozenset({5}), "h265": frozenset(range(16, 22))}
"""The types of the units of a picture that needs no others: IDR; and IDR, BLA and CRA."""


def format_of(data: bytes) -> PictureFormat | None:
    """The format of a still picture by its first bytes; None if it is neither JPEG nor PNG."""
    if data.startswith(_JPEG):
        return "jpeg"
    return "png" if data.startswith(_PNG) else None


def check_picture(data: bytes, form: PictureFormat) -> None:
    """Raises MessageError unless ``data`` is a whole picture of the format ``form``, by its markers alone.

    The reason is "foreign" (another format), "truncated", "malformed", or "too large" for one of more than
    ``PICTURE_PIXELS``. Whether its pixels are right, only a decoder knows. Of video the bytes must begin a
    packet; its size is not known here.
    """
    if form in _KEY_UNITS:
        if not data.startswith(_START_CODES):
            text = f"an {form} packet begins with a start code (Annex B), not with {data[:4].hex(' ')!r}"
            raise MessageError(text, reason="foreign")
        return
    found = format_of(data)
    if found != form:
        text = f"its bytes are {'neither JPEG nor PNG' if found is None else f'a {found}'}, not a {form}"
        raise MessageError(text, reason="foreign")
    width, height = _png_size(data) if form == "png" else _jpeg_size(data)
    if not 0 < width * height <= PICTURE_PIXELS:
        reason = "too large" if width * height else "malformed"
        limit = f"pictures have 1 to {PICTURE_PIXELS} pixels"
        raise MessageError(f"a {form} of {width} x {height} by its header; {limit}", reason=reason)


def picture_size(data: bytes, form: PictureFormat) -> tuple[int, int] | None:
    """The width and height [px] by the header of a checked picture; None of video."""
    if form in _KEY_UNITS:
        return None
    return _png_size(data) if form == "png" else _jpeg_size(data)


def is_key_frame(data: bytes, form: PictureFormat) -> bool:
    """Whether a packet can be decoded without the ones before it; every still picture can."""
    if form not in _KEY_UNITS:
        return True
    place = data.find(_START_CODES[0])
    while 0 <= place < len(data) - 3:
        first = data[place + 3]
        kind = first & 0x1F if form == "h264" else first >> 1 & 0x3F
        if kind in _KEY_UNITS[form]:
            return True
        place = data.find(_START_CODES[0], place + 3)
    return False


def _png_size(data: bytes) -> tuple[int, int]:
    if len(data) < _PNG_HEADER.size or data.rfind(_PNG_END) < 0:
        raise _cut_off("png", data)
    _, kind, width, height = _PNG_HEADER.unpack_from(data)
    if kind != b"IHDR":
        raise MessageError(f"a png that begins with {kind!r}, not with its header", reason="malformed")
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int]:
    size: tuple[int, int] | None = None
    place = 2
    while place + 4 <= len(data):
        if data[place] != 0xFF:
            text = f"a jpeg with {data[place]:#04x} at byte {place}, where a marker begins"
            raise MessageError(text, reason="malformed")
        marker = data[place + 1]
        if marker == 0xFF or marker in _WITHOUT_LENGTH:  # fill bytes; and markers that stand alone
            place += 1 if marker == 0xFF else 2
            continue
        if marker == _START_OF_SCAN:
            # In the pixels 0xff is followed by zero; the pictures inside of other segments end before.
            if data.rfind(_JPEG_END, place) < 0:
                raise _cut_off("jpeg", data)
            if size is None:
                raise MessageError("a jpeg without a frame header before its pixels", reason="malformed")
            return size
        if marker in _FRAME_HEADERS and place + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, place + 5)
            size = width, height
        place += 2 + max(2, int.from_bytes(data[place + 2 : place + 4]))
    raise _cut_off("jpeg", data)


def _cut_off(form: str, data: bytes) -> MessageError:
    return MessageError(f"a {form} cut off after {len(data)} bytes", reason="truncated")
