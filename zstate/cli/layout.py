"""A tree as lines of text, with columns beside it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from zstate.errors import printable

Guides = Callable[[str, Mapping[str, Sequence[str]]], Iterator[tuple[str, str]]]
"""What draws a tree: ``tree_lines`` or ``chain_lines``."""

_WIDE_ENOUGH = 20
"""So many letters are a column that text can be folded in."""


def tree_lines(root: str, children: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, str]]:
    """(guide, name) of each node below and including ``root``, parents first.

    However deep the tree is: nothing recurses.
    """
    stack = [(root, "", "")]
    while stack:
        name, guide, guide_below = stack.pop()
        yield guide, name
        below = children.get(name, ())
        for position in reversed(range(len(below))):
            is_last = position == len(below) - 1
            fork, rail = ("└── ", "    ") if is_last else ("├── ", "│   ")
            stack.append((below[position], guide_below + fork, guide_below + rail))


def chain_lines(root: str, children: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, str]]:
    """As ``tree_lines``, but two columns deep, and only where the tree forks."""
    stack = [(root, "", "")]
    while stack:
        name, guide, rail = stack.pop()
        yield guide, name
        children_here = children.get(name, ())
        if len(children_here) == 1:
            stack.append((children_here[0], f"{rail}↓ ", rail))
            continue
        for position in reversed(range(len(children_here))):
            is_last = position == len(children_here) - 1
            fork, below_it = ("└ ", "  ") if is_last else ("├ ", "│ ")
            stack.append((children_here[position], rail + fork, rail + below_it))


def in_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines whose columns stand under each other; a cell cannot add lines of its own."""
    shown = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in shown
    ]


def narrowed(rows: Sequence[Sequence[str]], width: int | None, dispensable: Sequence[int] = ()) -> list[str]:
    """``in_columns``, without as many of the ``dispensable`` columns, the first first, as ``width`` asks for.

    Columns are counted from 0 in ``rows``. Lines may still be too wide when all of them are gone.
    """
    lines, gone = in_columns(rows), set[int]()
    for column in dispensable:
        if width is None or max(map(len, lines), default=0) <= width:
            break
        gone.add(column)
        kept = [[cell for place, cell in enumerate(row) if place not in gone] for row in rows]
        lines = in_columns(kept)
    return lines


def letters_for(names: Iterable[str]) -> dict[str, str]:
    """Something shorter for each of ``names``, in their order: a to z, then numbers."""
    return {name: _letter(number) for number, name in enumerate(dict.fromkeys(names))}


def _letter(number: int) -> str:
    return chr(ord("a") + number) if number < 26 else str(number + 1)


def fitted(text: str, width: int) -> str:
    """``text`` with lines longer than ``width`` folded between words.

    What does not fit goes on below the line's last column where that is wide enough, else it is indented
    by two. Words are not broken, so that a path or a key stays whole.
    """
    return "\n".join(part for line in text.split("\n") for part in _folded(line, width))


def _folded(line: str, width: int) -> list[str]:
    if len(line) <= width:
        return [line]
    import textwrap

    columns = [gap.end() for gap in re.finditer(r"(?<=\S) {2,}(?=\S)", line)]
    last = columns[-1] if columns else 0
    indent = last if 0 < last <= width - _WIDE_ENOUGH else len(line) - len(line.lstrip()) + 2
    return textwrap.wrap(
        line,
        width,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    )
