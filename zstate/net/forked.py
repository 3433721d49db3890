"""What becomes, in a process forked from one with a session, of that session's belongings."""

from __future__ import annotations

import ctypes


def keep_for_ever(entity: object) -> None:
    """Never free ``entity``, not even at the interpreter's end.

    Freeing it would have Zenoh take it back from the network, with threads that fork left behind in
    the parent: the child would wait for them until it is killed.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(entity))
