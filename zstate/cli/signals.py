"""The end of a command by a signal."""

from __future__ import annotations


class SignalExit(SystemExit):
    """Raised by the handlers of signals; a SystemExit of another kind is that of a user's program."""
