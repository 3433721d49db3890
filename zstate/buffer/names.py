"""Names: what frames are called, and what questions may call them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from functools import partial


class Names:
    """The names of all frames in the order of their first mention; none is ever forgotten.

    A robot's frame, ``robot/link``, answers to its bare name too while no other has the same.
    """

    def __init__(self) -> None:
        self._all: list[str] = []
        self._by_bare: defaultdict[str, list[str]] = defaultdict(list)

    def __len__(self) -> int:
        return len(self._all)

    def add(self, name: str) -> None:
        """Know a name that was not known."""
        self._all.append(name)
        bare = _bare(name)
        if bare:
            self._by_bare[bare].append(name)

    def cut(self, count: int) -> list[str]:
        """Unlearn all but the first ``count``, as though they had never been added; these are returned."""
        added = self._all[count:]
        for name in reversed(added):
            bare = _bare(name)
            if bare:
                self._by_bare[bare].pop()
        del self._all[count:]
        return added

    def with_bare(self, name: str) -> tuple[str, ...]:
        """The frames that have the bare name ``name``."""
        return tuple(self._by_bare.get(name, ()))

    def near(self, name: str) -> Callable[[], list[str]]:
        """What finds the names that look like ``name``, best first, bare ones where those do.

        It takes milliseconds among thousands, so it is left to whoever reads the answer; that is of the
        names there are now, however many come in between.
        """
        return partial(_near, name, self._all, len(self._all))


def _near(name: str, names: list[str], count: int) -> list[str]:
    known = names[:count]
    return get_close_matches(name, known if "/" in name else _shortest(known), n=3, cutoff=0.7)


def _shortest(names: Iterable[str]) -> list[str]:
    """What each frame may be called in the shortest way."""
    frames = list(names)
    counts: defaultdict[str, int] = defaultdict(int)
    for frame in frames:
        counts[_bare(frame)] += 1
    bares = map(_bare, frames)
    return [bare if bare and counts[bare] == 1 else frame for frame, bare in zip(frames, bares, strict=True)]


def _bare(name: str) -> str:
    """The name without its robot; empty where there is none, or what is left would be no name."""
    bare = name.partition("/")[2]
    return "" if bare.startswith("/") else bare
