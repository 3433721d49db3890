"""Dictionary of bounded size, for keys that come from the network."""

from __future__ import annotations

from typing import TypeVar

K = TypeVar("K")
V = TypeVar("V")

MAX_ENTRIES = 4096


class BoundedDict(dict[K, V]):
    """A dict of at most 4096 entries. Assigning to a key makes it the newest; the oldest are dropped."""

    def __setitem__(self, key: K, value: V) -> None:
        self.pop(key, None)
        super().__setitem__(key, value)
        while len(self) > MAX_ENTRIES:
            del self[next(iter(self))]
