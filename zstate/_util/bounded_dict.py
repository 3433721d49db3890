"""Dictionary of bounded size, for keys that come from the network."""

from __future__ import annotations

from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")

MAX_ENTRIES = 4096


class BoundedDict(dict[K, V]):
    """A dict of the 4096 newest entries. Assigning to a key makes its entry the newest."""

    def __setitem__(self, key: K, value: V) -> None:
        if key in self:
            del self[key]
        elif len(self) >= MAX_ENTRIES:
            del self[next(iter(self))]
        dict.__setitem__(self, key, value)  # pyright: ignore[reportUnknownMemberType]  # faster than super()
