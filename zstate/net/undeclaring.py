"""Undeclaring: taking back what was declared on a Zenoh session, whoever uses it just then."""

from __future__ import annotations

import time
from typing import Any, Protocol

_WITHIN_S = 0.5


class Undeclarable(Protocol):
    """Whatever was declared on a Zenoh session."""

    def undeclare(self) -> Any: ...


def undeclare(entity: Undeclarable) -> None:
    """Take ``entity`` back, as soon as no other thread is using it."""
    deadline = time.monotonic() + _WITHIN_S
    while not _let_go(entity) and time.monotonic() < deadline:
        time.sleep(0.001)


def _let_go(entity: Undeclarable) -> bool:
    try:
        entity.undeclare()
    except RuntimeError as error:
        if "borrowed" not in str(error):
            raise
        return False  # another thread is using it at this very moment
    return True
