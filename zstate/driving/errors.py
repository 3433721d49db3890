"""Errors of drivers and motions."""

from __future__ import annotations

from collections.abc import Sequence

from zstate.errors import ZStateError, printable


class DriverFault(ZStateError):
    """The driver of ``robot`` failed too often in a row; it was stopped, and stays so until a release."""

    def __init__(self, message: str, *, robot: str) -> None:
        super().__init__(message)
        self.robot = robot


class MotionRefused(ZStateError):
    """A driver has refused a motion; nothing moves by it. ``findings`` are all reasons."""

    def __init__(self, robot: str, findings: Sequence[str]) -> None:
        self.findings = tuple(map(printable, findings))
        count = f"{len(self.findings)} finding{'s' if len(self.findings) != 1 else ''}"
        super().__init__(
            "\n  ".join((f"the driver of {robot!r} refuses the motion ({count})", *self.findings))
        )


class MotionTimeout(ZStateError, TimeoutError):
    """A motion is still under way after the time to wait; ``progress`` is 0 to 1."""

    def __init__(self, message: str, *, progress: float) -> None:
        super().__init__(message)
        self.progress = progress
