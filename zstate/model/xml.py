"""XML reader for untrusted input: text to elements with lines, to numbers.

Limits: 16 MiB, 200,000 elements, 100 levels. Entities are neither declared nor fetched: a DOCTYPE
with declarations or a reference to a file is refused. Prefixes are kept as written (``xacro:macro``)
and need no declaration, because existing URDF files lack it. Numbers are plain decimals, independent
of the locale.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from zstate.model.findings import model_error, quoted

MAX_BYTES = 16 * 1024 * 1024
MAX_ELEMENTS = 200_000
MAX_NESTING = 100

_CODES = expat.errors.codes
_UNFINISHED = (
    _CODES[expat.errors.XML_ERROR_NO_ELEMENTS],
    _CODES[expat.errors.XML_ERROR_UNCLOSED_TOKEN],
)
_MALFORMED = '&lt; for <, &amp; for &, and quotes around each value: name="..."'
_MISMATCH = _CODES[expat.errors.XML_ERROR_TAG_MISMATCH]


@dataclass(slots=True)
class Element:
    """One XML element: its tag as written, attributes, first line, children, and the text of a <param>."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list["Element"])
    text: str = ""

    def all(self, tag: str) -> list[Element]:
        """The direct children with that tag."""
        return [child for child in self.children if child.tag == tag]

    def walk(self) -> Iterator[Element]:
        """This element and everything below it, in the order of the document."""
        yield self
        for child in self.children:
            yield from child.walk()


@dataclass(frozen=True, slots=True)
class Document:
    """The text without byte order mark and leading blanks, and its root element."""

    text: str
    root: Element


def check_length(length: int, source: str) -> None:
    """Raise ModelError for a text that is too long."""
    if length > MAX_BYTES:
        raise model_error(source, f"the text has {length} bytes; the limit is {MAX_BYTES}")


def read_document(text: str, source: str) -> Document:
    """The element tree of ``text``. Raises ModelError if it is not XML, or not safe to read."""
    check_length(len(text), source)
    text = text.removeprefix("\ufeff")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        line = text.count("\n", 0, error.start) + 1
        message = f"the character {text[error.start]!r} is half of a pair, not text"
        raise model_error(source, message, line) from None
    body = text.lstrip()
    if not body:
        whole = '<robot name="NAME"><link name="base_link"/></robot>'
        raise model_error(source, 'the text is empty; a URDF begins with <robot name="...">', fix=whole)
    lines_before = text.count("\n", 0, len(text) - len(body))
    return Document(body, _Reader(source, body, lines_before).read())


class _Reader:
    def __init__(self, source: str, text: str, lines_before: int) -> None:
        self._source = source
        self._text = text
        self._lines_before = lines_before
        self._open: list[Element] = []
        self._root: Element | None = None
        self._count = 0
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.CharacterDataHandler = self._add_text
        self._parser.EndElementHandler = lambda _tag: self._open.pop()
        self._parser.StartDoctypeDeclHandler = self._doctype

    def read(self) -> Element:
        try:
            self._parser.Parse(self._text, True)
        except expat.ExpatError as error:
            line = error.lineno + self._lines_before
            cause, fix = self._cause(error)
            raise model_error(self._source, f"column {error.offset + 1}: {cause}", line, fix) from None
        assert self._root is not None, "expat accepts no document without an element"
        return self._root

    def _line(self) -> int:
        return self._parser.CurrentLineNumber + self._lines_before

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, self._line())
        self._count += 1
        if self._count > MAX_ELEMENTS:
            message = f"more than {MAX_ELEMENTS} elements, which is the limit"
            raise model_error(self._source, message, element.line)
        if len(self._open) == MAX_NESTING:
            message = f"<{_short(tag)}> is nested deeper than {MAX_NESTING} levels"
            raise model_error(self._source, message, element.line)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self._root = element
        self._open.append(element)

    def _add_text(self, text: str) -> None:
        if self._open[-1].tag == "param":  # the only element of a URDF whose text is read
            self._open[-1].text += text

    def _doctype(self, _name: str, system: str | None, public: str | None, has_declarations: int) -> None:
        if system or public or has_declarations:
            raise model_error(
                self._source,
                "a DOCTYPE with declarations (entities) or a reference to a file is refused: it can make "
                "a small file huge or read others; remove it",
                self._line(),
                "delete the DOCTYPE, and write what its entities stand for",
            )

    def _cause(self, error: expat.ExpatError) -> tuple[str, str]:
        """The fault, and what to write instead."""
        if (root := self._root) is not None and not self._open:
            fault = f"there is something after </{_short(root.tag)}>, which must end the file"
            if self._markup_at(error).startswith("<robot") and root.tag == "robot":
                first = f"the first begins in line {root.line}"
                fault = f"a second <robot>; {first}, and one file holds one robot"
            return fault, "delete what stands there, or move it before that"
        closing = f"</{_short(self._open[-1].tag)}>" if self._open else ""
        if error.code == _MISMATCH:
            return f"{self._markup_at(error)}> closes {self._innermost()}", f"{closing} before it"
        if error.code in _UNFINISHED and self._open:
            return f"the file ends inside {self._innermost()}; is it truncated?", f"{closing} at its end"
        return f"malformed XML: {expat.ErrorString(error.code)}", _MALFORMED

    def _innermost(self) -> str:
        element = self._open[-1]
        return f"<{_short(element.tag)}>, which was opened in line {element.line}"

    def _markup_at(self, error: expat.ExpatError) -> str:
        """The tag at which the parser failed, as written, without its attributes."""
        line = self._text.split("\n")[error.lineno - 1]
        found = re.match(r"[^\s>]*", line[max(0, line.rfind("<", 0, error.offset + 1)) :])
        return _short(found[0]) if found else ""


def _short(tag: str) -> str:
    return quoted(tag)[1:-1]


_DECIMAL = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
_BLANKS = re.compile(r"[ \t\r\n]+")


class NumberError(ValueError):
    """Text that is not a number, or not the right count of numbers."""


def read_numbers(text: str, count: int) -> tuple[float, ...]:
    """``count`` finite numbers separated by blanks. Raises NumberError."""
    _refuse_expression(text)
    tokens = [token for token in _BLANKS.split(text) if token]
    if len(tokens) != count:
        commas = "; separate them by blanks, not commas" if "," in text else ""
        raise NumberError(f"{quoted(text)} has {len(tokens)} of {count} number{'s'[: count - 1]}{commas}")
    return tuple(read_number(token) for token in tokens)


def read_number(text: str) -> float:
    """One finite number. Raises NumberError."""
    _refuse_expression(text)
    token = text.strip(" \t\r\n")
    if not _DECIMAL.fullmatch(token):
        raise NumberError(_fault(token))
    value = float(token)
    if not math.isfinite(value):
        raise NumberError(f"{quoted(token)} is too large to be a number here")
    return value


def _refuse_expression(text: str) -> None:
    if "${" in text or "$(" in text:
        raise NumberError(f"{quoted(text.strip())} is a xacro expression, not a number")


def _fault(token: str) -> str:
    if not token:
        return "an empty text is not a number"
    if _DECIMAL.fullmatch(token.replace(",", ".")):
        return f"{quoted(token)} has a decimal comma; write {quoted(token.replace(',', '.'))}"
    try:
        value = float(token)
    except ValueError:
        return f"{quoted(token)} is not a number"
    if not math.isfinite(value):
        return f"{quoted(token)} is not a finite number"
    return f"{quoted(token)} is a number to Python only; write {value!r}"
