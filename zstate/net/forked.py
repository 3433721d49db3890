"""What becomes, in a process forked from one with a session, of that session's belongings."""

from __future__ import annotations

import ctypes
import os
import threading
import weakref

_LOCKS: weakref.WeakSet[threading.Lock] = weakref.WeakSet()


def keep_for_ever(entity: object) -> None:
    """Never free ``entity``, not even at the interpreter's end.

    Freeing it would have Zenoh take it back from the network, with threads that fork left behind in
    the parent: the child would wait for them until it is killed.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(entity))


def new_lock() -> threading.Lock:
    """A lock that is free in a forked child, whoever of the parent's threads held it."""
    lock = threading.Lock()
    _LOCKS.add(lock)
    return lock


def _free_locks() -> None:
    for lock in _LOCKS:
        lock._at_fork_reinit()  # type: ignore[attr-defined]  # pyright: ignore  # as the standard library does


os.register_at_fork(after_in_child=_free_locks)
