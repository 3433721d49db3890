"""The optional C extension: whether it is used, and why not.

``ZSTATE_KERNEL=reference`` in the environment forces the reference in Python, ``ZSTATE_KERNEL=c`` refuses to
do without the extension. Both give the same answers.
"""

from __future__ import annotations

import os
from typing import Literal

from zstate.errors import InvalidInput

VARIABLE = "ZSTATE_KERNEL"
REVISION = 6
"""What the extension's own REVISION has to be; see there."""


class Kernel(str):
    """Which kernel the buffer runs on, "c" or "reference"; ``reason`` says why."""

    __slots__ = ("reason",)

    reason: str

    def __new__(cls, name: Literal["c", "reference"], reason: str) -> Kernel:
        kernel = super().__new__(cls, name)
        kernel.reason = reason
        return kernel


def select_kernel(wish: str) -> Kernel:
    """The kernel for what the environment wishes; raises InvalidInput where that cannot be."""
    if wish not in ("", "c", "reference"):
        raise InvalidInput(f"{VARIABLE} is 'c', 'reference' or not set; got {wish!r}")
    if wish == "reference":
        return Kernel("reference", f"{VARIABLE} asks for it")
    problem = _problem()
    if not problem:
        return Kernel("c", "the extension is there")
    if wish == "c":
        raise InvalidInput(f"{VARIABLE} asks for 'c', but {problem}")
    return Kernel("reference", problem)


def _problem() -> str:
    """Why the extension cannot be used; nothing when it can."""
    try:
        from zstate import _kernel  # noqa: PLC0415 - it may be missing
    except ImportError as error:
        return f"the extension cannot be loaded ({error}); installing zstate with a C compiler builds it"
    if _kernel.REVISION != REVISION:
        return f"the extension is of revision {_kernel.REVISION}, not {REVISION}; install zstate again"
    return ""


kernel = select_kernel(os.environ.get(VARIABLE, ""))
