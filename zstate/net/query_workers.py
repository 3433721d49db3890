"""Threads of a session that answer queries: as many as are busy at the same time, and one that waits.

A robot has several queryables that are rarely queried. With a thread each, the publishers of fifty robots in
one process are hundreds of threads, which compete for the interpreter lock and leave less time to publish.

A worker that begins a turn while no other waits starts another one first. So a slow answer, or a reply that
waits up to 5 s for a reader that is frozen, delays no other queryable; and a flood of quick queries starts
few threads, because only workers start them. Workers that are not needed end after ``IDLE_S``; the last one
waits without waking up.
"""

from __future__ import annotations

import queue
import threading
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import TypeAlias

from zstate._util.fork_safe import fork_safe_lock
from zstate.net.at_exit import join_at_exit
from zstate.net.session import Session

IDLE_S = 5.0

Turn: TypeAlias = Callable[[], object]
"""Answers the queries that wait at one queryable. Raises nothing."""


class QueryWorkers:
    """The workers of one session, which take turns from a queue. Used by ``users`` queryables."""

    def __init__(self) -> None:
        self.users = 0
        self._turns: queue.SimpleQueue[Turn | None] = queue.SimpleQueue()
        self._lock = fork_safe_lock()
        self._threads = 0
        self._waiting = 0
        """Workers that are in no turn."""
        self._has_ended = False
        self._start()

    def submit(self, turn: Turn) -> None:
        """Run ``turn`` in a worker, soon. Does not wait."""
        self._turns.put(turn)

    def close(self) -> None:
        """End all workers, after the turns that wait."""
        with self._lock:
            self._has_ended = True
            threads = self._threads
        for _ in range(threads):
            self._turns.put(None)

    def _start(self) -> None:
        with self._lock:
            if self._has_ended:
                return
            self._threads += 1
            self._waiting += 1
        thread = threading.Thread(target=self._run, name="zstate queries", daemon=True)
        try:
            join_at_exit(thread).start()
        except RuntimeError:  # the interpreter is ending and starts no more threads
            with self._lock:
                self._threads -= 1
                self._waiting -= 1

    def _run(self) -> None:
        while True:
            with self._lock:
                idle_s = IDLE_S if self._waiting > 1 else None
            turn: Turn | None = None
            has_turn = False
            with suppress(queue.Empty):
                turn, has_turn = self._turns.get(timeout=idle_s), True
            with self._lock:
                if turn is None and (has_turn or self._waiting > 1):  # the end, or not needed
                    self._threads -= 1
                    self._waiting -= 1
                    return
                if turn is None:
                    continue
                self._waiting -= 1
                is_last = not self._waiting
            if is_last:
                self._start()
            turn()
            del turn
            with self._lock:
                self._waiting += 1


_WORKERS: weakref.WeakKeyDictionary[Session, QueryWorkers] = weakref.WeakKeyDictionary()
_LOCK = fork_safe_lock()


def use_workers(session: Session) -> QueryWorkers:
    """The workers of ``session``, for one more queryable until ``leave_workers``."""
    with _LOCK:
        workers = _WORKERS.get(session)
        if workers is None:
            workers = _WORKERS[session] = QueryWorkers()
        workers.users += 1
        return workers


def leave_workers(session: Session, workers: QueryWorkers) -> None:
    """Note that a queryable has ended; the last one ends the workers."""
    with _LOCK:
        workers.users -= 1
        if workers.users:
            return
        _WORKERS.pop(session, None)
    workers.close()
