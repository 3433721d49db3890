"""Markdown tables, and numbers rounded to three or four significant digits."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """The lines of a table and an empty line after it; the first column is text, the others are numbers."""
    yield _line(head)
    yield _line(["---", *["--:"] * (len(head) - 1)])
    yield from map(_line, rows)
    yield ""


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def number(value: float) -> str:
    """Three or four significant digits, more only before the point: 0.513, 12.3, 123.4, 12,345."""
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    if abs(value) >= 100:
        return f"{value:.1f}".removesuffix(".0")
    return f"{value:.3g}"


def dash(value: T | None, text: Callable[[T], str]) -> str:
    """``text(value)``, or a dash if the value is None; missing values are never filled in."""
    return "-" if value is None else text(value)
