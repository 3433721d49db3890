"""Waiting for data: woken by the insert that brings it, never by a clock that ticks."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

from zstate.buffer.footing import Footing
from zstate.buffer.tracks import Track
from zstate.buffer.tree import Tree
from zstate.locks import new_lock

Marks: TypeAlias = Mapping[Track, int | None]
"""How new each track has to be [ns]; None is reached by any sample at all."""


class Expected(NamedTuple):
    """What ends a wait: another footing in the tree, or each track at its mark and around ``instant``.

    A track that accepts no more samples as old as ``instant`` ends it too: no answer can come any more.
    """

    footing: Footing = Footing()
    marks: Marks = MappingProxyType({})
    instant: int | None = None

    def has_come(self) -> bool:
        """Whether samples have, or can never. Runs with each insert into one of the tracks."""
        instant, missing = self.instant, not self.marks
        for track, stamp in self.marks.items():
            history = track.history
            newest, oldest = history.newest, history.oldest
            if newest is None or oldest is None:
                missing = True
            elif (stamp is not None and newest < stamp) or (instant is not None and instant < oldest):
                missing = True
                if instant is not None and not history.reaches(instant):
                    return True
        return not missing

    def is_hopeless(self) -> bool:
        """Whether a track accepts no more samples as old as ``instant``."""
        instant = self.instant
        return instant is not None and not all(track.history.reaches(instant) for track in self.marks)


class Waiter:
    """Somebody who sleeps until what is expected has come. ``wake`` may be called once too often."""

    def __init__(self, room: WaitingRoom, wake: Callable[[], None]) -> None:
        self.wake = wake
        self.expected = Expected()
        self.tracks = self.expected.marks.keys()
        """Where the room has it; the room's business."""
        self._room = room

    def expect(self, expected: Expected, version: int) -> None:
        """Sleep; or be woken at once where what is expected has come by now.

        ``version`` is that of the tree before the question was asked: a change since then may be one that
        the expectation does not know of, and of which nobody will tell again.
        """
        self.expected = expected
        if expected.marks.keys() != self.tracks:
            self._room.sort(self)
        if self._room.tree.version != version or expected.has_come():
            self.wake()


class WaitingRoom:
    """Everybody who waits for this buffer, sorted by the tracks they wait for.

    A sample is the business of those who wait for its track; a change of the tree is shown to everybody.
    """

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self._lock = new_lock()
        # Tuples that are replaced, never changed: ``notify`` takes no lock.
        self._waiters: tuple[Waiter, ...] = ()
        self._by_track: dict[Track, tuple[Waiter, ...]] = {}
        self._shown = tree.version

    @contextmanager
    def seat(self, wake: Callable[[], None]) -> Generator[Waiter]:
        """A waiter that is told of inserts for as long as the context lasts."""
        waiter = Waiter(self, wake)
        with self._lock:
            self._waiters = (*self._waiters, waiter)
        try:
            yield waiter
        finally:
            with self._lock:
                self._waiters = _without(self._waiters, waiter)
                self._put(waiter, {})

    def sort(self, waiter: Waiter) -> None:
        """Have ``waiter`` where the tracks are that it expects samples of."""
        with self._lock:
            # A watch that was closed meanwhile must not come back.
            if waiter in self._waiters:
                self._put(waiter, waiter.expected.marks)

    def _put(self, waiter: Waiter, marks: Marks) -> None:
        before, waiter.tracks = waiter.tracks, marks.keys()
        for track in marks.keys() - before:
            self._by_track[track] = (*self._by_track.get(track, ()), waiter)
        for track in before - marks.keys():
            left = _without(self._by_track[track], waiter)
            # In one step: whoever notifies meanwhile finds those who stay.
            if left:
                self._by_track[track] = left
            else:
                del self._by_track[track]

    def notify(self, *tracks: Track) -> None:
        """Wake those whose data is there: samples of ``tracks`` have come, or the tree has changed."""
        if self._shown != self.tree.version:
            self._shown = self.tree.version
            self._show_tree()
        elif self._by_track:
            for waiter in self._at(tracks):
                if waiter.expected.has_come():
                    waiter.wake()

    def _show_tree(self) -> None:
        for waiter in self._waiters:
            expected = waiter.expected
            if not self.tree.holds(expected.footing) or expected.has_come():
                waiter.wake()

    def begin_anew(self, *tracks: Track) -> None:
        """Wake whoever waits for ``tracks``: their samples are gone, and newer ones may have older stamps."""
        for waiter in self._at(tracks):
            waiter.wake()

    def _at(self, tracks: Sequence[Track]) -> Iterable[Waiter]:
        if len(tracks) == 1:
            return self._by_track.get(tracks[0], ())
        # Once each, though many wait for several of them.
        return dict.fromkeys(waiter for track in tracks for waiter in self._by_track.get(track, ()))


def _without(waiters: tuple[Waiter, ...], waiter: Waiter) -> tuple[Waiter, ...]:
    return tuple(other for other in waiters if other is not waiter)
