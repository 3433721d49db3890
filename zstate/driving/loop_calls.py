"""Calls of other threads that the thread of a control loop makes at its next tick."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotDone

from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import MessageError

_TICK_WITHIN_S = 1.0


class LoopCalls:
    """Runs one action at a time in the thread of the loop, which calls ``run_waiting`` at each tick."""

    def __init__(self) -> None:
        self._one_at_a_time = fork_safe_lock()
        """Held while a caller waits for the loop."""
        self._lock = fork_safe_lock()
        self._waiting: tuple[Future[None], Callable[[int], None]] | None = None

    def call(self, action: Callable[[int], None]) -> None:
        """Let the loop call ``action`` with the instant of its next tick; from any other thread.

        Raises MessageError, also that of ``action``.
        """
        done: Future[None] = Future()
        with self._one_at_a_time:
            with self._lock:
                self._waiting = (done, action)
            try:
                done.result(_TICK_WITHIN_S)
            except NotDone:
                if done.cancel():
                    text = f"the control loop has not begun a tick within {_TICK_WITHIN_S:g} s"
                    raise MessageError(text, reason="no tick") from None
                done.result()

    def run_waiting(self, now: int) -> None:
        """Call the action that waits, if any."""
        if self._waiting is None:
            return
        with self._lock:
            waiting, self._waiting = self._waiting, None
        assert waiting is not None, "only this thread takes it away"
        done, action = waiting
        if not done.set_running_or_notify_cancel():
            return
        try:
            action(now)
        except BaseException as error:
            done.set_exception(error)
            if not isinstance(error, MessageError):
                raise
        else:
            done.set_result(None)
