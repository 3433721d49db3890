"""Search: the frames that somebody means who types a part of a name."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches


def found_frames(names: Sequence[str], query: str) -> tuple[str, ...]:
    """The ``names`` in which every word of ``query`` occurs, the best first; all of them for no word.

    Case does not count, nor whether words are parted by spaces, underlines or slashes. A frame that is
    called so comes before those that begin so, and these before the rest, each in the given order. Where
    nothing fits, what is spelt nearly so.
    """
    words = query.lower().replace("_", " ").replace("/", " ").split()
    if not words:
        return tuple(names)
    found = [name for name in names if all(word in name.lower() for word in words)]
    if not found:
        return _nearly(names, query.strip().lower())
    wanted = query.strip().lower()
    return tuple(sorted(found, key=lambda name: _rank(name.lower(), wanted)))


def _rank(name: str, wanted: str) -> int:
    bare = name.rpartition("/")[2]
    if wanted in (name, bare):
        return 0
    return 1 if bare.startswith(wanted) else 2


def _nearly(names: Sequence[str], wanted: str) -> tuple[str, ...]:
    full = {name.rpartition("/")[2].lower(): name for name in reversed(names)}
    return tuple(full[bare] for bare in get_close_matches(wanted, full, n=8))
