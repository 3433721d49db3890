"""Dictionary and queue of bounded size, for what comes from the network."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Generic, Self, TypeVar

K = TypeVar("K")
V = TypeVar("V")
T = TypeVar("T")

MAX_ENTRIES = 4096


class BoundedDict(dict[K, V]):
    """A dict of the 4096 newest entries. Assigning to a key makes its entry the newest.

    Safe from any thread without a lock; while a key is assigned again, readers may find no entry of it.
    """

    def __setitem__(self, key: K, value: V) -> None:
        if key in self:
            self.pop(key, None)
        elif len(self) >= MAX_ENTRIES:
            self._drop_oldest()
        dict.__setitem__(self, key, value)  # pyright: ignore[reportUnknownMemberType]  # faster than super()

    def setdefault(self, key: K, default: V) -> V:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The value of ``key``, which is ``default`` if there was none. All threads get the same one."""
        if key not in self and len(self) >= MAX_ENTRIES:
            self._drop_oldest()
        return super().setdefault(key, default)

    def update(self, entries: Mapping[K, V]) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Assign each of ``entries``."""
        for key, value in entries.items():
            self[key] = value

    def __ior__(self, entries: Mapping[K, V]) -> Self:  # pyright: ignore[reportIncompatibleMethodOverride]
        self.update(entries)
        return self

    def _drop_oldest(self) -> None:
        while len(self) >= MAX_ENTRIES:
            with suppress(KeyError, RuntimeError, StopIteration):  # another thread was faster
                del self[next(iter(self))]


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
