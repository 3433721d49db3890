"""Document: XML text as a tree whose elements know their lines, read without trust.

Limits: 16 MiB, 200,000 elements, 100 levels. Entities are neither declared nor fetched: a DOCTYPE
with declarations or a reference to a file is refused. Prefixes are kept as written (``xacro:macro``)
and need no declaration, because URDF files in use lack it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from zstate.errors import ModelError
from zstate.model.encoding import TextFault, decode
from zstate.model.findings import Finding, quoted

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
    """One XML element: its tag as written, attributes, the line it begins in, and its children."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list["Element"])

    def all(self, tag: str) -> list[Element]:
        """The direct children of that tag."""
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


def read_document(data: str | bytes, source: str) -> Document:
    """The tree of ``data``. Raises ModelError saying where and why it is not (trustworthy) XML."""
    try:
        return _read(data)
    except TextFault as fault:
        raise ModelError(source, [Finding(fault.line, str(fault), "error", fault.fix)]) from None


def _read(data: str | bytes) -> Document:
    if len(data) > MAX_BYTES:
        raise TextFault(f"the text has {len(data)} bytes; the limit is {MAX_BYTES}")
    text = decode(data)
    body = text.lstrip()
    if not body:
        whole = '<robot name="NAME"><link name="base_link"/></robot>'
        raise TextFault('the text is empty; a URDF begins with <robot name="...">', fix=whole)
    lines_before = text.count("\n", 0, len(text) - len(body))
    return Document(body, _Reader(body, lines_before).read())


class _Reader:
    def __init__(self, text: str, lines_before: int) -> None:
        self._text = text
        self._lines_before = lines_before
        self._open: list[Element] = []
        self._root: Element | None = None
        self._count = 0
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._doctype

    def read(self) -> Element:
        try:
            self._parser.Parse(self._text, True)
        except expat.ExpatError as error:
            line = error.lineno + self._lines_before
            cause, fix = self._cause(error)
            raise TextFault(f"column {error.offset + 1}: {cause}", line, fix) from None
        assert self._root is not None, "expat accepts no document without an element"
        return self._root

    def _line(self) -> int:
        return self._parser.CurrentLineNumber + self._lines_before

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, self._line())
        self._count += 1
        if self._count > MAX_ELEMENTS:
            raise TextFault(f"more than {MAX_ELEMENTS} elements, which is the limit", element.line)
        if len(self._open) == MAX_NESTING:
            raise TextFault(f"<{_short(tag)}> is nested deeper than {MAX_NESTING} levels", element.line)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self._root = element
        self._open.append(element)

    def _end(self, _tag: str) -> None:
        self._open.pop()

    def _doctype(self, _name: str, system: str | None, public: str | None, has_declarations: int) -> None:
        if system or public or has_declarations:
            raise TextFault(
                "a DOCTYPE with declarations (entities) or a reference to a file is refused: it can make "
                "a small file huge or read others; remove it",
                self._line(),
                "delete the DOCTYPE, and write what its entities stand for",
            )

    def _cause(self, error: expat.ExpatError) -> tuple[str, str]:
        """What is wrong, and what to write instead."""
        if self._root is not None and not self._open:
            return self._after_root(error, self._root), "delete what stands there, or move it before that"
        closing = f"</{_short(self._open[-1].tag)}>" if self._open else ""
        if error.code == _MISMATCH:
            return f"{self._markup_at(error)}> closes {self._innermost()}", f"{closing} before it"
        if error.code in _UNFINISHED and self._open:
            return f"the file ends inside {self._innermost()}; is it truncated?", f"{closing} at its end"
        return f"malformed XML: {expat.ErrorString(error.code)}", _MALFORMED

    def _after_root(self, error: expat.ExpatError, root: Element) -> str:
        if self._markup_at(error).startswith("<robot") and root.tag == "robot":
            return f"a second <robot>; the first begins in line {root.line}, and one file holds one robot"
        return f"there is something after </{_short(root.tag)}>, which must end the file"

    def _innermost(self) -> str:
        element = self._open[-1]
        return f"<{_short(element.tag)}>, which was opened in line {element.line}"

    def _markup_at(self, error: expat.ExpatError) -> str:
        """The tag that the parser stumbled over, as written, without its attributes."""
        line = self._text.split("\n")[error.lineno - 1]
        found = re.match(r"[^\s>]*", line[max(0, line.rfind("<", 0, error.offset + 1)) :])
        return _short(found[0]) if found else ""


def _short(tag: str) -> str:
    return quoted(tag)[1:-1]
