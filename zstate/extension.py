"""Selection of the C extension or the reference in Python.

``ZSTATE_KERNEL=reference`` in the environment forces the reference, ``ZSTATE_KERNEL=c`` is an error without
the extension. Both give the same results.
"""

from __future__ import annotations

import os
from typing import Literal

from zstate.errors import InvalidInput

VARIABLE = "ZSTATE_KERNEL"
REVISION = 12
"""The REVISION that the extension must have; see there."""


class Kernel(str):
    """Name of the kernel of the buffer, "c" or "reference"; ``reason`` explains the choice."""

    __slots__ = ("reason",)

    reason: str

    def __new__(cls, name: Literal["c", "reference"], reason: str) -> Kernel:
        kernel = super().__new__(cls, name)
        kernel.reason = reason
        return kernel


def select_kernel(setting: str) -> Kernel:
    """The kernel for a value of ``ZSTATE_KERNEL``. Raises InvalidInput for another value, or without it."""
    if setting not in ("", "c", "reference"):
        raise InvalidInput(f"{VARIABLE} is 'c', 'reference' or not set; got {setting!r}")
    if setting == "reference":
        return Kernel("reference", f"{VARIABLE} selects it")
    try:
        from zstate import _kernel  # noqa: PLC0415 - it may be missing
    except ImportError as error:
        problem = f"the extension cannot be loaded ({error}); installing zstate with a C compiler builds it"
    else:
        if _kernel.REVISION == REVISION:
            return Kernel("c", "the extension is installed")
        problem = f"the extension is of revision {_kernel.REVISION}, not {REVISION}; install zstate again"
    if setting == "c":
        raise InvalidInput(f"{VARIABLE} selects 'c', but {problem}")
    return Kernel("reference", problem)


kernel = select_kernel(os.environ.get(VARIABLE, ""))
