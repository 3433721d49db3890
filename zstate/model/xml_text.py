"""Text of XML files, whose encoding is declared in them."""

from __future__ import annotations

import codecs
import re

from zstate.model.findings import model_error
from zstate.model.xml import check_length

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
# Fixed, because Python has codecs that are no text encodings of files (rot13, unicode_escape).
_ENCODINGS = {"utf-8", "us-ascii", "ascii", "iso-8859-1", "latin-1", "iso-8859-15", "windows-1252", "cp1252"}
_DECLARED = re.compile(rb"""\s*<\?xml[^>]*?\sencoding\s*=\s*["']([^"'>]*)["']""")


def decode(data: bytes, source: str) -> str:
    """The text of an XML file. Raises ModelError.

    Encodings: UTF-8, UTF-16 with a byte order mark, and, if the XML declaration names them, US-ASCII,
    ISO-8859-1, ISO-8859-15 and windows-1252.
    """
    check_length(len(data), source)
    mark, encoding = next((one for one in _BYTE_ORDER_MARKS if data.startswith(one[0])), (b"", ""))
    data = data[len(mark) :]
    if not encoding:
        if b"\0" in data:
            line, column = _place(data, data.index(b"\0"))
            message = f"column {column}: a zero byte; this is a binary file, not a URDF"
            raise model_error(source, message, line)
        declared = _DECLARED.match(data[:1000])
        encoding = "utf-8" if declared is None else declared[1].decode("latin-1")
        if encoding.lower() not in _ENCODINGS:
            message = f"the declared encoding {encoding[:40]!r} is not read; save the file as UTF-8"
            raise model_error(source, message, 1)
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        line, column = _place(data, error.start)
        message = (
            f"column {column}: byte 0x{data[error.start]:02x} is not {encoding.upper()}; save the file as "
            'UTF-8, or declare its encoding in line 1 (<?xml version="1.0" encoding="ISO-8859-1"?>)'
        )
        raise model_error(source, message, line) from None


def _place(data: bytes, offset: int) -> tuple[int, int]:
    """Line and column of a byte, both counted from 1."""
    return data.count(b"\n", 0, offset) + 1, offset - data.rfind(b"\n", 0, offset)
