"""Waiting for data: waiters, watches, and the message filter (tf2_ros ``MessageFilter``). Nothing polls.

An insert wakes exactly the waiters whose samples it brings. A waiter registers with the ``WaiterRegistry`` of
the buffer and sets its ``WakeCondition``: the samples or the change of the tree after which a failed lookup
may succeed.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import (
    AsyncIterable,
    AsyncIterator,
    Awaitable,
    Callable,
    Generator,
    Iterable,
    Mapping,
    Sequence,
)
from contextlib import ExitStack, contextmanager
from numbers import Real
from types import MappingProxyType
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeAlias, TypeVar

from zstate import se3
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.frame_tree import FrameTree, PathDependencies
from zstate.buffer.history import FastPath
from zstate.buffer.tracks import JointTrack, Track
from zstate.errors import InvalidInput, LookupFailed
from zstate.transform import Transform

if TYPE_CHECKING:
    from zstate._kernel import NewerTransforms

S = TypeVar("S")

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


class TransformWatch(Closeable):
    """Calls ``callback(transform)`` with each newest transform of a pair, until closed.

    With ``translation_m`` or ``rotation_rad``, only once the source has moved or rotated so far in the target
    since the last call. ``lookup_newest`` also sets the condition for a newer transform. The callback runs on
    the thread whose insert brought the sample: keep it short. Its exceptions are counted in ``failures``;
    ``last_failure`` is the last of them. A context manager.
    """

    def __init__(
        self,
        waiters: WaiterRegistry,
        names: tuple[str, str],
        lookup_newest: Callable[[Waiter], Transform | LookupFailed],
        callback: Callable[[Transform], object],
        *,
        translation_m: float | None,
        rotation_rad: float | None,
    ) -> None:
        for name, value in (("translation_m", translation_m), ("rotation_rad", rotation_rad)):
            if value is not None and not (isinstance(value, Real) and 0.0 <= value < math.inf):
                raise InvalidInput(f"{name} is zero or more; got {value!r}")
        self.target, self.source = names
        self.failures = 0
        self.last_failure: Exception | None = None
        self._tree = waiters.tree
        self._lookup_newest = lookup_newest
        self._callback = callback
        self._thresholds = (translation_m, rotation_rad)
        self._has_thresholds = self._thresholds != (None, None)
        self._last: Transform | None = None
        self._is_pending = False
        self._lock = fork_safe_lock()
        self._registration = ExitStack()
        self._waiter = self._registration.enter_context(waiters.register(self._on_insert))
        self._on_insert()

    def __repr__(self) -> str:
        failures = f", {self.failures} failures" if self.failures else ""
        return f"<TransformWatch of {self.source!r} in {self.target!r}{failures}>"

    def close(self) -> None:
        """No more calls. A second call does nothing."""
        self._registration.close()

    def _on_insert(self) -> None:
        """Runs with each insert that may bring a newer transform, on any thread; calls never overlap."""
        self._is_pending = True
        while self._is_pending and self._lock.acquire(False):
            # A thread that finds the lock taken leaves its transform to the thread that holds it.
            try:
                self._is_pending = False
                newer = self._waiter.newer
                transform = newer and newer.take(self._tree.version)
                if transform is None:
                    transform = self._lookup_changed()
                if transform is not None and (not self._has_thresholds or self._has_moved(transform)):
                    self._last = transform
                    self._callback(transform)
            except Exception as error:
                # It belongs to the author of the callback, not to the caller of the insert.
                self.failures += 1
                self.last_failure = error
            finally:
                self._lock.release()

    def _lookup_changed(self) -> Transform | None:
        """The newest transform, unless it is the last one; None if there is none."""
        try:
            transform = self._lookup_newest(self._waiter)
        except LookupFailed:
            return None  # an ambiguous name; a change of the tree may resolve it
        return transform if isinstance(transform, Transform) and transform != self._last else None

    def _has_moved(self, transform: Transform) -> bool:
        last = self._last
        if last is None:
            return True
        translation_m, rotation_rad = self._thresholds
        (x, y, z, *qa), (*at, bx, by, bz, bw) = last.pose7.tolist(), transform.pose7.tolist()
        turned = se3.multiply(se3.conjugate((qa[0], qa[1], qa[2], qa[3])), (bx, by, bz, bw))
        return (translation_m is not None and math.dist((x, y, z), at) >= translation_m) or (
            rotation_rad is not None and math.hypot(*se3.rotation_vector(turned, se3.SCALARS)) >= rotation_rad
        )


class MessageFilter(Generic[S]):
    """``async for sample, transform in filter``: samples in their order, each with ``target_from_frame``.

    A sample waits up to ``timeout_s`` for the transform at its stamp. One that gets none is left out
    and counted in ``dropped`` by the name of the error; ``last_reason`` is the last of these errors.
    """

    def __init__(
        self,
        wait_async: Callable[[str, str, int, float], Awaitable[Transform]],
        samples: AsyncIterable[S],
        target: str,
        *,
        frame: Callable[[S], str],
        stamp: Callable[[S], int],
        timeout_s: float,
    ) -> None:
        self.target = target
        self.joined = 0
        self.dropped: Counter[str] = Counter()
        self.last_reason: LookupFailed | None = None
        self._wait_async = wait_async
        # One iterator, so that a loop over the filter can be left and continued.
        self._samples = samples.__aiter__()
        self._frame = frame
        self._stamp = stamp
        self._timeout_s = timeout_s

    def __repr__(self) -> str:
        reasons = ", ".join(f"{count} {name}" for name, count in self.dropped.items())
        dropped = f", {self.dropped.total()} dropped ({reasons})" if reasons else ""
        return f"<MessageFilter for {self.target!r}: {self.joined} joined{dropped}>"

    def __aiter__(self) -> AsyncIterator[tuple[S, Transform]]:
        return self

    async def __anext__(self) -> tuple[S, Transform]:
        async for sample in self._samples:
            frame, stamp = self._frame(sample), self._stamp(sample)
            try:
                transform = await self._wait_async(self.target, frame, stamp, self._timeout_s)
            except LookupFailed as reason:
                self.last_reason = reason
                # A timeout is counted under the error that the lookup ended with.
                self.dropped[type(reason).__name__.removesuffix("Timeout")] += 1
            else:
                self.joined += 1
                return sample, transform
        raise StopAsyncIteration
