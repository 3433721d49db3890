"""Who calls a reader's user when a sample has come into the buffer; nothing but the standard library."""

from __future__ import annotations

import threading
from collections.abc import Callable

from bench.job import Job

Answer = Callable[[int], None]


class Awakening:
    """Calls ``answer(stamp)`` for each sample in the thread that heard it.

    A user who is slow would hold up the system's own thread: under that load one of ours takes the newest
    stamp, again and again, as such a user's loop does.
    """

    def __init__(self, job: Job, answer: Answer) -> None:
        self._answer = answer
        self._newest: int | None = None
        self._changed = threading.Condition()
        self._is_closed = False
        self.heard: Answer = answer
        if job.load == "slow":
            self.heard = self._leave
            self._thread = threading.Thread(target=self._answer_newest, daemon=True)
            self._thread.start()

    def _leave(self, stamp: int) -> None:
        with self._changed:
            self._newest = stamp
            self._changed.notify()

    def _answer_newest(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._is_closed)
                stamp, self._newest = self._newest, None
            if self._is_closed or stamp is None:
                return
            self._answer(stamp)

    def close(self) -> None:
        """Let the loop end."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
