"""Bytes of an XML file to text: byte order mark, declared encoding, and clear words when neither fits."""

from __future__ import annotations

import codecs
import re

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
# Python knows codecs that are no text encodings of files (rot13, unicode_escape): a list, not a lookup.
_ENCODINGS = {"utf-8", "us-ascii", "ascii", "iso-8859-1", "latin-1", "iso-8859-15", "windows-1252", "cp1252"}
_DECLARED = re.compile(rb"""\s*<\?xml[^>]*?\sencoding\s*=\s*["']([^"'>]*)["']""")


class TextFault(ValueError):
    """Bytes that are not the text they should be; ``line`` is where, when that can be said.

    ``fix`` is what to write instead.
    """

    def __init__(self, message: str, line: int | None = None, fix: str = "") -> None:
        super().__init__(message)
        self.line = line
        self.fix = fix


def decode(data: str | bytes) -> str:
    """The text of ``data`` without its byte order mark. Raises TextFault.

    Read are UTF-8, UTF-16 with a byte order mark, and, where the XML declaration says so, US-ASCII,
    ISO-8859-1, ISO-8859-15 and windows-1252.
    """
    text = data.removeprefix("\ufeff") if isinstance(data, str) else _decode_bytes(data)
    _refuse_what_is_no_text(text)
    return text


def _decode_bytes(data: bytes) -> str:
    for mark, encoding in _BYTE_ORDER_MARKS:
        if data.startswith(mark):
            return _decode_as(data[len(mark) :], encoding)
    if b"\0" in data:
        line, column = _place(data, data.index(b"\0"))
        raise TextFault(f"column {column}: a zero byte; this is a binary file, not a URDF", line)
    return _decode_as(data, _declared_encoding(data))


def _declared_encoding(data: bytes) -> str:
    declared = _DECLARED.match(data[:1000])
    if declared is None:
        return "utf-8"
    encoding = declared[1].decode("latin-1")
    if encoding.lower() not in _ENCODINGS:
        raise TextFault(f"the declared encoding {encoding[:40]!r} is not read; save the file as UTF-8", 1)
    return encoding


def _decode_as(data: bytes, encoding: str) -> str:
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        line, column = _place(data, error.start)
        raise TextFault(
            f"column {column}: byte 0x{data[error.start]:02x} is not {encoding.upper()}; save the file as "
            'UTF-8, or declare its encoding in line 1 (<?xml version="1.0" encoding="ISO-8859-1"?>)',
            line,
        ) from None


def _place(data: bytes, offset: int) -> tuple[int, int]:
    """Line and column of a byte, both counted from 1."""
    return data.count(b"\n", 0, offset) + 1, offset - data.rfind(b"\n", 0, offset)


def _refuse_what_is_no_text(text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError as error:
        line = text.count("\n", 0, error.start) + 1
        raise TextFault(f"the character {text[error.start]!r} is half of a pair, not text", line) from None
