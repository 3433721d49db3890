"""Waiting for data: waiters, and the conditions that wake them. Nothing polls.

An insert wakes exactly the waiters whose samples it brings. A waiter registers with the ``WaiterRegistry`` of
the buffer and sets its ``WakeCondition``: the samples or the change of the tree after which a failed lookup
may succeed.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.frame_tree import FrameTree, PathDependencies
from zstate.buffer.history import FastPath
from zstate.buffer.tracks import JointTrack, Track

if TYPE_CHECKING:
    from zstate._kernel import NewerTransforms

RequiredStamps: TypeAlias = Mapping[Track, int | None]
"""The stamp that each track has to reach [ns]; None is reached by any sample."""


class WakeCondition(NamedTuple):
    """Wakes when the dependencies change, or when each track has reached its stamp and covers ``instant``.

    A track that accepts no more samples as old as ``instant`` wakes too: no transform can come any more.
    """

    dependencies: PathDependencies = PathDependencies()
    required: RequiredStamps = MappingProxyType({})
    instant: int | None = None

    def is_met(self) -> bool:
        """Whether the samples are there, or can never come. Runs with each insert into one of the tracks."""
        instant, is_missing = self.instant, not self.required
        for track, stamp in self.required.items():
            history = track.history
            newest, oldest = history.newest, history.oldest
            if newest is None or oldest is None:
                is_missing = True
            elif (stamp is not None and newest < stamp) or (instant is not None and instant < oldest):
                is_missing = True
                if instant is not None and not history.reaches(instant):
                    return True
        return not is_missing

    def is_hopeless(self) -> bool:
        """Whether a track accepts no more samples as old as ``instant``."""
        instant = self.instant
        return instant is not None and not all(track.history.reaches(instant) for track in self.required)


class Waiter:
    """A waiting thread or task. ``wake`` may be called spuriously."""

    def __init__(self, registry: WaiterRegistry, wake: Callable[[], None]) -> None:
        self.wake = wake
        self.condition = WakeCondition()
        self.is_met = self.condition.is_met
        """Whether the condition is met."""
        self.newer: NewerTransforms | None = None
        """The transforms for which the condition waits, if the extension finds them at once."""
        self.tracks = self.condition.required.keys()
        """The tracks that the registry lists it under; changed only by the registry."""
        self._registry = registry

    def expect(self, condition: WakeCondition, version: int, newer: NewerTransforms | None = None) -> None:
        """Set the condition; wakes at once if it is met by now.

        ``version`` is that of the tree before the lookup: a change since then may be one that the
        condition does not cover, and no later notification would report it. ``newer`` is met when the
        condition is, and with each transform that is taken from it, it waits for the one after that.
        """
        self.condition, self.newer = condition, newer
        self.is_met = condition.is_met if newer is None else newer.is_met
        if condition.required.keys() != self.tracks:
            self._registry.update(self)
        if self._registry.tree.version != version or self.is_met():
            self.wake()


class WaiterRegistry:
    """All waiters of a buffer, by the tracks they wait for.

    A sample concerns only the waiters for its track; a change of the tree is checked for all of them.
    """

    def __init__(self, tree: FrameTree) -> None:
        self.tree = tree
        self._lock = fork_safe_lock()
        # Tuples that are replaced, never changed: ``notify`` takes no lock.
        self._waiters: tuple[Waiter, ...] = ()
        self._by_track: dict[Track, tuple[Waiter, ...]] = {}
        self._notified_version = tree.version

    def __len__(self) -> int:
        return len(self._waiters)

    @contextmanager
    def register(self, wake: Callable[[], None]) -> Generator[Waiter]:
        """A waiter that is notified while the context lasts."""
        waiter = Waiter(self, wake)
        with self._lock:
            self._waiters = (*self._waiters, waiter)
        try:
            yield waiter
        finally:
            with self._lock:
                self._waiters = _without(self._waiters, waiter)
                self._list_under(waiter, {})

    def update(self, waiter: Waiter) -> None:
        """List ``waiter`` under the tracks of its condition."""
        with self._lock:
            # A watch that was closed since then must not come back.
            if waiter in self._waiters:
                self._list_under(waiter, waiter.condition.required)

    def _list_under(self, waiter: Waiter, required: RequiredStamps) -> None:
        before, waiter.tracks = waiter.tracks, required.keys()
        for track in required.keys() - before:
            self._by_track[track] = (*self._by_track.get(track, ()), waiter)
        for track in before - required.keys():
            left = _without(self._by_track[track], waiter)
            # In one step: a concurrent ``notify`` finds the remaining waiters.
            if left:
                self._by_track[track] = left
            else:
                del self._by_track[track]

    def notify(self, *tracks: Track) -> None:
        """Wake the waiters whose condition is met: ``tracks`` have new samples, or the tree has changed."""
        if self._notified_version != self.tree.version:
            self._notified_version = self.tree.version
            for waiter in self._waiters:
                if not self.tree.is_current(waiter.condition.dependencies) or waiter.is_met():
                    waiter.wake()
        elif self._by_track:
            for waiter in self._waiting_for(tracks):
                if waiter.is_met():
                    waiter.wake()

    def fast_path(self, counts: dict[str, int], *sources: object) -> FastPath[Waiter]:
        """A fast path for samples of one track; ``counts`` and ``sources`` as in ``FastPath``."""
        return FastPath(self._by_track, counts, (self.tree, *sources))

    def expect_next(
        self, fast_path: FastPath[Waiter], track: Track, message: bytes, versions: tuple[int, ...]
    ) -> None:
        """Let ``fast_path`` insert the message after ``message``, whose sample was inserted into ``track``.

        Ends with the next change of the tree, because ``notify`` checks all waiters after one.
        """
        position_count = track.position_count if isinstance(track, JointTrack) else -1
        versions = self._notified_version, *versions
        fast_path.expect(message, track, track.history, position_count, versions)

    def notify_restart(self, *tracks: Track) -> None:
        """Wake all waiters for ``tracks``: their samples are gone, and newer ones may have older stamps."""
        for waiter in self._waiting_for(tracks):
            waiter.wake()

    def _waiting_for(self, tracks: Sequence[Track]) -> Iterable[Waiter]:
        if len(tracks) == 1:
            return self._by_track.get(tracks[0], ())
        # Once each, though many wait for several of them.
        return dict.fromkeys(waiter for track in tracks for waiter in self._by_track.get(track, ()))


def _without(waiters: tuple[Waiter, ...], waiter: Waiter) -> tuple[Waiter, ...]:
    return tuple(other for other in waiters if other is not waiter)
