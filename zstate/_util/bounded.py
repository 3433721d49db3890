"""Dictionary and queue of bounded size, for what comes from the network."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")
T = TypeVar("T")

MAX_ENTRIES = 4096


class BoundedDict(dict[K, V]):
    """A dict of the 4096 newest entries. Assigning to a key makes its entry the newest.

    Threads that assign at the same time need a lock. Reading needs none.
    """

    def __setitem__(self, key: K, value: V) -> None:
        if key in self:
            del self[key]
        elif len(self) >= MAX_ENTRIES:
            del self[next(iter(self))]
        dict.__setitem__(self, key, value)  # pyright: ignore[reportUnknownMemberType]  # faster than super()


class BoundedQueue(Generic[T]):
    """A queue of at most ``max_items`` items and ``max_bytes`` bytes; drops its oldest. Not thread-safe."""

    def __init__(self, max_items: int, max_bytes: int) -> None:
        self._max_items, self._max_bytes = max_items, max_bytes
        self._items: deque[tuple[T, int]] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[T]:
        return (item for item, _ in self._items)

    def __reversed__(self) -> Iterator[T]:
        return (item for item, _ in reversed(self._items))

    def __getitem__(self, index: int) -> T:
        return self._items[index][0]

    def append(self, item: T, size: int) -> int:
        """Add ``item`` of ``size`` bytes. Returns how many items were dropped for it."""
        self._items.append((item, size))
        self._bytes += size
        count = len(self._items)
        while len(self._items) > self._max_items or self._bytes > self._max_bytes:
            self._bytes -= self._items.popleft()[1]
        return count - len(self._items)

    def popleft(self) -> T:
        """Remove the oldest item and return it. Raises IndexError if there is none."""
        item, size = self._items.popleft()
        self._bytes -= size
        return item

    def clear(self) -> None:
        """Drop all items."""
        self._items.clear()
        self._bytes = 0
