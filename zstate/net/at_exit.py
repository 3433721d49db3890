"""Process exit: closes all sessions and takes threads out of Zenoh before Python is finalized.

A thread that requests the interpreter lock during finalization is unwound. If Zenoh started it, its stack
holds Rust frames and the process aborts ("FATAL: exception not rethrown", SIGABRT). Receivers request the
lock with each sample and every 0.1 s. So each process with a session has one exit thread, started before the
first session because Python starts no threads at exit. When ``atexit`` runs, the exit thread does the
following, and the main thread waits for it for at most ``TIMEOUT_S``:

1. refuse to open sessions;
2. close each open session, which ends everything that receives from it;
3. join the threads that stay inside Zenoh, and the program's threads that are using a session.

A callback given to Zenoh itself (``session.zenoh.declare_subscriber(key, callback)``) runs in a non-daemon
thread, which Python joins before ``atexit``. So the sessions are closed as soon as the main thread has ended
and only such threads are left.

In a forked child nothing of the parent's sessions is ever freed, see ``leak``.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import sys
import threading
import time
import weakref
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Protocol

import zenoh

from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import Closed

TIMEOUT_S = 1.5
THREAD_NAME = "zstate exit"

_UNWIND_S = 0.02
_USERS_TIMEOUT_S = 0.5

_CALLBACK_THREAD = "pyo3-closure"
"""Part of the name of each thread that Zenoh starts for a callback."""


# zenoh 1.10, freeing a session in a forked child waits for the parent's threads: delete when fixed
def leak(entity: object) -> None:
    """Never free ``entity``, not even when the interpreter ends.

    Freeing it would make Zenoh undeclare it with threads that exist in the parent process only: the child
    would wait for them until it is killed.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(entity))


def forked_text(fact: str) -> str:
    """Message for a use after a fork: ``fact``, then the two alternatives."""
    return (
        f"{fact}; Zenoh does not work after a fork: call connect() in the child processes alone, once they "
        "have started, or start them with the 'spawn' or 'forkserver' method (for instance "
        "multiprocessing.get_context('spawn'), DataLoader(..., multiprocessing_context='spawn'))"
    )


class ClosedAtExit(Protocol):
    """A session that is closed when the process ends."""

    def close_blocking(self) -> None:
        """Close in this thread; may take long."""

    def leak(self) -> None:
        """Never free the parts that need Zenoh's threads, which a fork leaves behind."""


# CPython before 3.14 unwinds threads of Zenoh at exit, python/cpython#87135: delete with Python 3.13
class _Process:
    """The sessions of this process, and its exit thread. A forked child has its own."""

    def __init__(self, zenoh_started_in: int | None = None) -> None:
        self.zenoh_started_in = zenoh_started_in
        self.sessions: weakref.WeakSet[ClosedAtExit] = weakref.WeakSet()
        self.threads: weakref.WeakSet[threading.Thread] = weakref.WeakSet()
        self.lock = fork_safe_lock()
        self.opening = 0
        self.none_opening = threading.Event()
        self.none_opening.set()
        self.is_ending = False
        self.closing: list[Callable[[], None]] = []
        self.requested = threading.Event()
        self.done = threading.Event()
        self.exit_thread: threading.Thread | None = None

    def run_exit_thread(self) -> None:
        threading.main_thread().join()
        self._hide_exit_errors()
        # Python waits for these threads itself, and they may use their sessions until they end.
        while threads := [
            thread
            for thread in threading.enumerate()
            if thread.is_alive() and not thread.daemon and not _is_callback(thread)
        ]:
            for thread in threads:
                thread.join()
        if not any(_is_callback(thread) and not thread.daemon for thread in threading.enumerate()):
            self.requested.wait()
        with self.lock:
            self.is_ending = True
        deadline = time.monotonic() + TIMEOUT_S
        for close in (*self.closing, *(session.close_blocking for session in tuple(self.sessions))):
            close()
        self.none_opening.wait(max(0.0, deadline - time.monotonic()))
        for session in tuple(self.sessions):  # the sessions that were being opened
            session.close_blocking()
        for thread in threading.enumerate():
            if thread in self.threads or _is_callback(thread):
                thread.join(max(0.0, deadline - time.monotonic()))
        _join_users(min(deadline, time.monotonic() + _USERS_TIMEOUT_S))
        self.done.set()

    def _hide_exit_errors(self) -> None:
        """Do not report threads that find their session closed or cannot start threads any more."""
        report = threading.excepthook

        def report_others(args: threading.ExceptHookArgs) -> None:
            is_shutdown = args.exc_type is RuntimeError and "interpreter shutdown" in str(args.exc_value)
            is_closed = self.is_ending and issubclass(args.exc_type, (Closed, zenoh.ZError))
            if not (is_shutdown or is_closed):
                report(args)

        threading.excepthook = report_others


def _is_callback(thread: threading.Thread) -> bool:
    return _CALLBACK_THREAD in thread.name


def _join_users(deadline: float) -> None:
    """Join the program's daemon threads that are inside a call on a session.

    The sessions are closed, so each gets Closed or ZError at its next step. Threads that use Zenoh directly
    have no frame that shows it; they get ``_UNWIND_S``.
    """
    frames = sys._current_frames()  # pyright: ignore[reportPrivateUsage]  # but documented
    for thread in threading.enumerate():
        if not thread.daemon or thread.name.startswith("zstate "):
            continue
        frame = frames.get(thread.ident or 0)
        while frame is not None:
            module = frame.f_globals.get("__name__", "")
            if module.startswith("zstate.") and not module.startswith("zstate.buffer."):
                thread.join(max(0.0, deadline - time.monotonic()))
                break
            frame = frame.f_back
    if any(thread.daemon and thread.name != THREAD_NAME for thread in threading.enumerate()):
        time.sleep(_UNWIND_S)


_process = _Process()


def close_at_exit(session: ClosedAtExit) -> None:
    """Close ``session`` when the process ends, if it still exists."""
    _process.sessions.add(session)


def join_at_exit(thread: threading.Thread) -> threading.Thread:
    """Join ``thread`` at exit: it stays inside Zenoh until its session is closed. Returns it."""
    _process.threads.add(thread)
    return thread


@contextmanager
def session_opening() -> Generator[None]:
    """Context in which a session is opened.

    Raises Closed while the process ends, and in a process forked from one that has used Zenoh, even if all of
    its sessions are closed: Zenoh starts its threads once, and a session here would wait for the parent's.
    """
    process = _process
    with process.lock:
        if process.is_ending:
            raise Closed("no session can be opened any more: this process is ending")
        if process.zenoh_started_in not in (None, os.getpid()):
            fact = f"process {process.zenoh_started_in} used Zenoh before this one was forked from it"
            raise Closed(forked_text(fact))
        if process.exit_thread is None:
            process.exit_thread = threading.Thread(
                target=process.run_exit_thread, name=THREAD_NAME, daemon=True
            )
            process.exit_thread.start()
        process.zenoh_started_in = os.getpid()
        process.opening += 1
        process.none_opening.clear()
    try:
        yield
    finally:
        with process.lock:
            process.opening -= 1
            if not process.opening:
                process.none_opening.set()


def end_sessions(close: Callable[[], None] | None = None) -> None:
    """End all sessions within ``TIMEOUT_S``, after ``close()``."""
    if close is not None:
        _process.closing.append(close)
    _process.requested.set()
    if _process.exit_thread is not None:
        _process.done.wait(TIMEOUT_S)


def _reset_after_fork() -> None:
    global _process  # noqa: PLW0603  # the one of the parent stays as it was
    for session in tuple(_process.sessions):
        session.leak()
    _process = _Process(_process.zenoh_started_in)


atexit.register(end_sessions)
os.register_at_fork(after_in_child=_reset_after_fork)
