"""What becomes, in a process forked from one with a session, of that session's belongings."""

from __future__ import annotations

import ctypes


def keep_for_ever(entity: object) -> None:
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
