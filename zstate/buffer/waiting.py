"""Waiting for data: woken by the insert that brings it, never by a clock that ticks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager

from zstate.buffer.tracks import Track
from zstate.buffer.tree import Tree


class Waiter:
    """What somebody waits for: every track as new as its mark, one of them beyond hope, or another tree."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self.wake = wake
        self._marks: Sequence[tuple[Track, int | None]] = ()
        self._instant: int | None = None
        self._version = -1

    def expect(
        self, version: int, marks: Sequence[tuple[Track, int | None]], instant: int | None = None
    ) -> None:
        """Sleep until the tree is of another version, or each track has reached its stamp.

        A track's mark of None is reached by any sample at all. A track whose samples all lie after
        ``instant`` ends the sleep too, for then there will never be an answer.
        """
        self._marks = marks
        self._instant = instant
        self._version = version

    def is_met(self, version: int) -> bool:
        """Whether it is worth looking again."""
        if version != self._version:
            return True
        return bool(self._marks) and (all(map(self._reached, self._marks)) or self._is_hopeless())

    def _is_hopeless(self) -> bool:
        if self._instant is None:
            return False
        views = [track.history.view for track, _ in self._marks]
        return any(view.size and view.oldest > self._instant for view in views)

    @staticmethod
    def _reached(mark: tuple[Track, int | None]) -> bool:
        track, stamp = mark
        view = track.history.view
        return view.size > 0 and (stamp is None or view.newest >= stamp)


class WaitingRoom:
    """Everybody who waits for this buffer. ``notify`` is called after each insert."""

    def __init__(self, tree: Tree) -> None:
        self._tree = tree
        self._lock = threading.Lock()
        self._waiters: tuple[Waiter, ...] = ()

    @contextmanager
    def seat(self, wake: Callable[[], None]) -> Generator[Waiter]:
        """A waiter that is told of inserts for as long as the context lasts."""
        waiter = Waiter(wake)
        with self._lock:
            self._waiters = (*self._waiters, waiter)
        try:
            yield waiter
        finally:
            with self._lock:
                self._waiters = tuple(other for other in self._waiters if other is not waiter)

    def notify(self) -> None:
        """Wake those whose data is there."""
        for waiter in self._waiters:
            if waiter.is_met(self._tree.version):
                waiter.wake()
