"""Text layout: trees, columns and tables that fit the terminal, and wrapped sentences."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from zstate.errors import printable

Guides = Callable[[str, Mapping[str, Sequence[str]]], Iterator[tuple[str, str]]]
"""Draws the lines of a tree: ``tree_lines`` or ``chain_lines``."""

_WIDE_ENOUGH = 20
"""Text is wrapped within the last column if that has at least this many letters."""


def tree_lines(
    root: str, children: Mapping[str, Sequence[str]], *, is_chain: bool = False
) -> Iterator[tuple[str, str]]:
    """(guide, name) of ``root`` and of each node below it, parents first; of any depth: not recursive."""
    guides = (("├ ", "│ "), ("└ ", "  ")) if is_chain else (("├── ", "│   "), ("└── ", "    "))
    stack = [(root, "", "")]
    while stack:
        name, guide, guide_below = stack.pop()
        yield guide, name
        below = children.get(name, ())
        if is_chain and len(below) == 1:
            stack.append((below[0], f"{guide_below}↓ ", guide_below))
            continue
        for position in reversed(range(len(below))):
            fork, rail = guides[position == len(below) - 1]
            stack.append((below[position], guide_below + fork, guide_below + rail))


def chain_lines(root: str, children: Mapping[str, Sequence[str]]) -> Iterator[tuple[str, str]]:
    """As ``tree_lines``, but indented by two and only at forks; "↓" marks an only child."""
    return tree_lines(root, children, is_chain=True)


def in_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines with aligned columns; line breaks in cells are escaped."""
    shown = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in shown
    ]


@dataclass(frozen=True, slots=True)
class Table:
    """A table that becomes narrower when it does not fit.

    First the names in the column ``abbreviate`` are replaced by letters, which are explained below the table.
    Then the ``optional`` columns are left out, the first one first. Without ``headed`` the headings are not
    printed; they only name the columns.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    optional: Sequence[str] = ()
    abbreviate: str | None = None
    headed: bool = True

    def lines(self, width: int | None) -> list[str]:
        """The widest lines that fit ``width``, else the narrowest; None is any width."""
        return first_fitting([self], width)

    def layouts(self) -> Iterator[list[str]]:
        """The lines of this table, from the widest to the narrowest layout."""
        rows, legend = [list(row) for row in self.rows], list[str]()
        if self.abbreviate is not None:
            yield self._layout(rows)
            column = self.headings.index(self.abbreviate)
            labels = short_labels(row[column] for row in rows if row[column])
            rows = [[*row[:column], labels.get(row[column], ""), *row[column + 1 :]] for row in rows]
            legend = [f"{label}: {printable(name)}" for name, label in labels.items()]
        for count in range(len(self.optional) + 1):
            yield self._layout(rows, self.optional[:count]) + legend

    def _layout(self, rows: Sequence[Sequence[str]], left_out: Collection[str] = ()) -> list[str]:
        kept = [number for number, heading in enumerate(self.headings) if heading not in left_out]
        shown = [self.headings, *rows] if self.headed else rows
        return in_columns([[row[number] for number in kept] for row in shown])


def first_fitting(tables: Iterable[Table], width: int | None) -> list[str]:
    """The first layout of ``tables`` that fits ``width``, else the last one."""
    lines: list[str] = []
    for lines in (layout for table in tables for layout in table.layouts()):
        if width is None or max(map(len, lines), default=0) <= width:
            break
    return lines


def short_labels(names: Iterable[str]) -> dict[str, str]:
    """A short label for each of ``names``, in their order: a to z, then numbers from 27."""
    distinct = enumerate(dict.fromkeys(names))
    return {name: chr(ord("a") + number) if number < 26 else str(number + 1) for number, name in distinct}


def wrap(text: str, width: int) -> str:
    """``text`` with lines longer than ``width`` wrapped between words.

    The rest of a line is aligned with its last column if that is wide enough, else indented by two. Words are
    not broken, so that a path or a key stays whole.
    """
    return "\n".join(part for line in text.split("\n") for part in _wrap_line(line, width))


def _wrap_line(line: str, width: int) -> list[str]:
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
