"""Calls a reader's user after a sample has entered the buffer; standard library only."""

from __future__ import annotations

import threading
from collections.abc import Callable

from bench.job import Job

Answer = Callable[[int], None]


class WakeupReader:
    """Calls ``answer(stamp)`` for each sample in the receiving thread.

    A slow user would block the system's receiving thread: under the load "slow" a separate thread answers
    the newest stamp in a loop, as such a user's program does.
    """

    def __init__(self, job: Job, answer: Answer) -> None:
        self._answer = answer
        self._newest: int | None = None
        self._changed = threading.Condition()
        self._is_closed = False
        self.on_sample: Answer = answer
        if job.load == "slow":
            self.on_sample = self._store
            self._thread = threading.Thread(target=self._answer_newest, daemon=True)
            self._thread.start()

    def _store(self, stamp: int) -> None:
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
        """Ends the loop."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
