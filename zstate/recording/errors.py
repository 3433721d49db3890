"""Errors of recordings."""

from __future__ import annotations

from zstate.errors import ZStateError


class RecordingError(ZStateError):
    """A recording that cannot be read or written; ``path`` is the file or folder at fault."""

    def __init__(self, message: str, *, path: str) -> None:
        super().__init__(message)
        self.path = path
