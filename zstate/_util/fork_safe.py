"""Locks that are free in a forked child, whoever of the parent's threads held them."""

from __future__ import annotations

import os
import threading
import weakref
from typing import Any, TypeVar

_Lock = TypeVar("_Lock", bound="threading.Lock | Any")  # what threading.RLock gives has no public type
_LOCKS: weakref.WeakSet[Any] = weakref.WeakSet()


def fork_safe(lock: _Lock) -> _Lock:
    """``lock``, which may also be an RLock, a Condition or an Event, but is new in a forked child.

    The threads that held it, or would have set it, are not there.
    """
    _LOCKS.add(lock)
    return lock


def fork_safe_lock() -> threading.Lock:
    """A lock that outlives a fork."""
    return fork_safe(threading.Lock())


def _renew() -> None:
    for lock in _LOCKS:
        lock._at_fork_reinit()  # pyright: ignore  # as the standard library does


os.register_at_fork(after_in_child=_renew)
