"""Placements: which static writers place which frames."""

from __future__ import annotations

from zstate.following.bounded import MOST

StaticWriter = tuple[str, str]
"""A robot, and the name under which some of its static edges are written."""


class Placements:
    """The frames that each static writer places, and who places the same."""

    def __init__(self) -> None:
        self._children: dict[StaticWriter, frozenset[str]] = {}
        self._writers: dict[str, set[StaticWriter]] = {}

    def replace(self, writer: StaticWriter, children: frozenset[str]) -> list[tuple[str, list[StaticWriter]]]:
        """``writer`` places ``children`` now, and no others; those that somebody else places, with whom."""
        for child in self._children.pop(writer, frozenset()) - children:
            self._writers[child].discard(writer)
            if not self._writers[child]:
                del self._writers[child]
        for child in children:
            self._writers.setdefault(child, set()).add(writer)
        if children:
            self._children[writer] = children
            while len(self._children) > MOST:
                self.replace(next(iter(self._children)), frozenset())
        others = [(child, sorted(self._writers[child] - {writer})) for child in sorted(children)]
        return [(child, writers) for child, writers in others if writers]
