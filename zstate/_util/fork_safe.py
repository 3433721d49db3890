"""Locks that are free in a forked child, even if a thread of the parent held them."""

from __future__ import annotations

import os
import threading
import weakref
from typing import Any, TypeVar

_Lock = TypeVar("_Lock", bound="threading.Lock | Any")  # the type of threading.RLock() is not public
_LOCKS: weakref.WeakSet[Any] = weakref.WeakSet()


def fork_safe(lock: _Lock) -> _Lock:
    """``lock`` (also an RLock, Condition or Event), which is re-initialised in a forked child.

    The threads that hold or set it do not exist there. Other objects may have its method, too.
    """
    _LOCKS.add(lock)
    return lock


def fork_safe_lock() -> threading.Lock:
    """A new fork-safe lock."""
    return fork_safe(threading.Lock())


def _reinitialise() -> None:
    for lock in _LOCKS:
        lock._at_fork_reinit()  # pyright: ignore  # as the standard library does


os.register_at_fork(after_in_child=_reinitialise)
