"""A tree as lines of text, with columns beside it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence


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


def in_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines whose columns stand under each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
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
