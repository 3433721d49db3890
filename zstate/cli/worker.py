"""Worker: something that takes its time, and a wait for it that a signal ends."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

from zstate.clock import wait_in_slices

Result = TypeVar("Result")


class Worker(Generic[Result]):
    """Does ``work`` in a thread of its own; signals interrupt only the main thread, which may wait for it."""

    def __init__(self, name: str, work: Callable[[], Result]) -> None:
        self._outcome: Future[Result] = Future()
        self._is_done = threading.Event()
        threading.Thread(target=self._run, args=(work,), name=name, daemon=True).start()

    def _run(self, work: Callable[[], Result]) -> None:
        try:
            self._outcome.set_result(work())
        except Exception as error:  # raised again where it is waited for
            self._outcome.set_exception(error)
        finally:
            self._is_done.set()

    def result(self, timeout_s: float | None = None) -> Result:
        """What ``work`` returned, or the error it raised. Raises TimeoutError after ``timeout_s``."""
        if not wait_in_slices(self._is_done, timeout_s):
            raise TimeoutError(f"the work took longer than {timeout_s} s")
        return self._outcome.result()
