"""Watches: a callback with each newest transform of a pair."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from numbers import Real

from zstate import se3
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.waiting import Waiter, WaiterRegistry
from zstate.errors import InvalidInput, LookupFailed
from zstate.transform import Transform


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
