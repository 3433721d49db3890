"""Watch: a call whenever a pair of frames has moved."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from numbers import Real

from zstate import se3
from zstate.buffer.waiting import Waiter, WaitingRoom
from zstate.closing import Closing
from zstate.errors import InvalidInput, LookupFailed
from zstate.locks import new_lock
from zstate.transform import Transform

Look = Callable[[Waiter], Transform | LookupFailed]
"""The newest answer, the waiter told what would be newer; or why there is none."""


class Watch(Closing):
    """Calls ``callback(transform)`` with each newest transform of a pair, until closed.

    With ``translation_m`` or ``rotation_rad``, only once the source has moved so far or turned so far in
    the target since the last call. The callback runs on the thread whose insert brought the sample: keep it
    short. What it raises is counted in ``failures`` and kept in ``last_failure``. A context manager.
    """

    def __init__(
        self,
        room: WaitingRoom,
        names: tuple[str, str],
        look: Look,
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
        self._look_now = look
        self._callback = callback
        self._thresholds = (translation_m, rotation_rad)
        self._last: Transform | None = None
        self._pending = False
        self._lock = new_lock()
        self._seat = ExitStack()
        self._waiter = self._seat.enter_context(room.seat(self._look))
        self._look()

    def __repr__(self) -> str:
        failures = f", {self.failures} failures" if self.failures else ""
        return f"<Watch of {self.source!r} in {self.target!r}{failures}>"

    def close(self) -> None:
        """No more calls. A second call does nothing."""
        self._seat.close()

    def _look(self) -> None:
        """Called by each insert that may be news, on any thread; calls never overlap or swap."""
        self._pending = True
        while self._pending and self._lock.acquire(blocking=False):
            # Whoever finds the lock taken leaves its news to the thread that holds it.
            try:
                self._pending = False
                self._tell()
            finally:
                self._lock.release()

    def _tell(self) -> None:
        try:
            transform = self._look_now(self._waiter)
        except LookupFailed:
            return  # an ambiguous name; a change of the tree may mend it
        if not isinstance(transform, Transform) or not self._is_news(transform):
            return
        self._last = transform
        try:
            self._callback(transform)
        except Exception as error:
            # It belongs to the callback's author, not to whoever inserted the sample.
            self.failures += 1
            self.last_failure = error

    def _is_news(self, transform: Transform) -> bool:
        last = self._last
        if last is None:
            return True
        if last.stamp == transform.stamp and last == transform:
            return False
        translation_m, rotation_rad = self._thresholds
        if translation_m is None and rotation_rad is None:
            return True
        moved, turned = _difference(last.pose7.tolist(), transform.pose7.tolist())
        return (translation_m is not None and moved >= translation_m) or (
            rotation_rad is not None and turned >= rotation_rad
        )


def _difference(a: list[float], b: list[float]) -> tuple[float, float]:
    """How far two poses are apart [m], and how far they are turned [rad]."""
    qa, qb = (a[3], a[4], a[5], a[6]), (b[3], b[4], b[5], b[6])
    between = se3.rotation_vector(se3.multiply(se3.conjugate(qa), qb), se3.SCALARS)
    return math.dist(a[:3], b[:3]), math.hypot(*between)
