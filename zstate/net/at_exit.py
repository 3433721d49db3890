"""The end of a process: sessions are closed, and threads are out of Zenoh, before Python is finalized.

A thread that asks for the interpreter's lock during finalization is unwound and ended. Where it comes from
Zenoh, and so has Rust on its stack, that aborts the process ("FATAL: exception not rethrown", SIGABRT).
Receivers ask for the lock with each sample and every 0.1 s. Therefore one thread of each process with a
session, started before the first of them because Python starts none at its end, does the following when
``atexit`` runs, and the main thread waits for it, at most ``WITHIN_S``:

1. no more sessions are opened;
2. each session that is open is closed, so that whatever is received from it ends;
3. the threads that stay inside Zenoh are joined, and those of the program that use a session just then.

A callback given to Zenoh itself (``session.zenoh.declare_subscriber(key, callback)``) has a thread that is no
daemon: Python waits for it before ``atexit``. Once the main thread has ended, and nothing but such threads is
left to be waited for, the sessions are closed then.

What becomes, in a process forked from one with a session, of that session's belongings.
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
from contextlib import AbstractContextManager, contextmanager
from types import FrameType
from typing import Protocol

import zenoh

from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import Closed


def leak(entity: object) -> None:
    """Never free ``entity``, not even at the interpreter's end.

    Freeing it would have Zenoh take it back from the network, with threads that fork left behind in
    the parent: the child would wait for them until it is killed.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(entity))


def forked_text(what: str) -> str:
    """``what`` does not work in a forked process, and the two ways out."""
    return (
        f"{what}; Zenoh does not work after a fork: call connect() in the child processes alone, once they "
        "have started, or start them with the 'spawn' or 'forkserver' method (for instance "
        "multiprocessing.get_context('spawn'), DataLoader(..., multiprocessing_context='spawn'))"
    )


WITHIN_S = 1.5
THREAD_NAME = "zstate exit"

_MOMENT_S = 0.02
_USERS_END_WITHIN_S = 0.5

_CALLBACKS = "pyo3-closure"
"""What the name of a thread has in it that Zenoh started for a callback."""


class Session(Protocol):
    """What is closed at the end."""

    def leave(self) -> None:
        """Close; may take long."""

    def keep_for_ever(self) -> None:
        """Never free what Zenoh's threads, which a fork left behind, would have to take back."""


class _Process:
    """The sessions of this process, and its end. A forked child has its own."""

    def __init__(self, zenoh_started_in: int | None = None) -> None:
        self.zenoh_started_in = zenoh_started_in
        self.sessions: weakref.WeakSet[Session] = weakref.WeakSet()
        self.threads: weakref.WeakSet[threading.Thread] = weakref.WeakSet()
        self.opening = 0
        self.is_ending = False
        self._lock = fork_safe_lock()
        self._leaving: list[Callable[[], None]] = []
        self._requested = threading.Event()
        self._done = threading.Event()
        self._none_opening = threading.Event()
        self._none_opening.set()
        self._thread: threading.Thread | None = None

    @contextmanager
    def session_opening(self) -> Generator[None]:
        with self._lock:
            if self.is_ending:
                raise Closed("no session can be opened any more: this process is ending")
            if self.zenoh_started_in not in (None, os.getpid()):
                what = f"process {self.zenoh_started_in} used Zenoh before this one was forked from it"
                raise Closed(forked_text(what))
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name=THREAD_NAME, daemon=True)
                self._thread.start()
            self.zenoh_started_in = os.getpid()
            self.opening += 1
            self._none_opening.clear()
        try:
            yield
        finally:
            with self._lock:
                self.opening -= 1
                if not self.opening:
                    self._none_opening.set()

    def close_all(self, leave: Callable[[], None] | None = None) -> None:
        if leave is not None:
            self._leaving.append(leave)
        self._requested.set()
        if self._thread is not None:
            self._done.wait(WITHIN_S)

    def _run(self) -> None:
        threading.main_thread().join()
        self._ignore_what_is_no_news()
        _join_the_program()
        if not any(_runs_callbacks(thread) and not thread.daemon for thread in threading.enumerate()):
            self._requested.wait()
        self._close_all()
        self._done.set()

    def _close_all(self) -> None:
        with self._lock:
            self.is_ending = True
        deadline = time.monotonic() + WITHIN_S
        for leave in (*self._leaving, *(session.leave for session in tuple(self.sessions))):
            leave()
        self._none_opening.wait(max(0.0, deadline - time.monotonic()))
        for session in tuple(self.sessions):  # what was just being opened
            session.leave()
        for thread in threading.enumerate():
            if thread in self.threads or _runs_callbacks(thread):
                thread.join(max(0.0, deadline - time.monotonic()))
        _join_users(min(deadline, time.monotonic() + _USERS_END_WITHIN_S))

    def _ignore_what_is_no_news(self) -> None:
        """Threads that go on to the last find their session closed, and start no more threads themselves."""
        report = threading.excepthook

        def report_others(args: threading.ExceptHookArgs) -> None:
            is_of_python = args.exc_type is RuntimeError and "interpreter shutdown" in str(args.exc_value)
            is_closed = self.is_ending and issubclass(args.exc_type, (Closed, zenoh.ZError))
            if not (is_of_python or is_closed):
                report(args)

        threading.excepthook = report_others


def _join_the_program() -> None:
    """Return when no thread runs that Python waits for, apart from those that call back for Zenoh."""
    while threads := [one for one in threading.enumerate() if one.is_alive() and _is_program_thread(one)]:
        for thread in threads:
            thread.join()


def _is_program_thread(thread: threading.Thread) -> bool:
    return not thread.daemon and not _runs_callbacks(thread)


def _runs_callbacks(thread: threading.Thread) -> bool:
    return _CALLBACKS in thread.name


def _join_users(deadline: float) -> None:
    """Join daemon threads of the program that are in the middle of something on a session.

    That is closed, so they get Closed or ZError at the next step. A moment for those of which no frame shows
    it, as they use Zenoh directly.
    """
    frames = sys._current_frames()  # pyright: ignore[reportPrivateUsage]  # but documented
    for thread in threading.enumerate():
        is_ours = not thread.daemon or thread.name.startswith("zstate ")
        if not is_ours and _uses_a_session(frames.get(thread.ident or 0)):
            thread.join(max(0.0, deadline - time.monotonic()))
    if any(thread.daemon and thread.name != THREAD_NAME for thread in threading.enumerate()):
        time.sleep(_MOMENT_S)


def _uses_a_session(frame: FrameType | None) -> bool:
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module.startswith("zstate.") and not module.startswith("zstate.buffer."):
            return True
        frame = frame.f_back
    return False


_process = _Process()


def close_at_exit(session: Session) -> None:
    """Have ``session`` closed when the process ends, if it exists by then."""
    _process.sessions.add(session)


def join_at_exit(thread: threading.Thread) -> threading.Thread:
    """``thread``, which stays inside Zenoh until its session is closed, and is joined at the end."""
    _process.threads.add(thread)
    return thread


def session_opening() -> AbstractContextManager[None]:
    """A context in which a session is opened. Raises Closed where the process ends.

    And in a process forked from one where Zenoh was used, even if nothing of that is open any more: Zenoh
    starts its threads once, and what is opened here would wait for ever for those of the parent.
    """
    return _process.session_opening()


def end_sessions(leave: Callable[[], None] | None = None) -> None:
    """The process ends: ``leave()``, and close all sessions, within ``WITHIN_S``."""
    _process.close_all(leave)


def _reset_after_fork() -> None:
    global _process  # noqa: PLW0603  # the one of the parent stays as it was
    for session in tuple(_process.sessions):
        session.keep_for_ever()
    _process = _Process(_process.zenoh_started_in)


atexit.register(end_sessions)
os.register_at_fork(after_in_child=_reset_after_fork)
