"""Staleness: when a robot counts as silent, and how that is said."""

from __future__ import annotations

import time
from datetime import datetime

_SILENT_AFTER_S = 1.0
_SILENT_PERIODS = 10.0


def is_silent(silent_s: float, rate_hz: float | None) -> bool:
    """Whether a robot that said something ``silent_s`` ago should have said more by now.

    That is after ten of its periods, a second at least.
    """
    allowed_s = _SILENT_AFTER_S if not rate_hz else max(_SILENT_AFTER_S, _SILENT_PERIODS / rate_hz)
    return silent_s > allowed_s


def silence_text(silent_s: float, now_s: float | None = None) -> str:
    """ "silent for 4.2 s, since 14:03:22"; ``now_s`` is the present time, seconds since 1970."""
    since = datetime.fromtimestamp((time.time() if now_s is None else now_s) - silent_s).astimezone()
    return f"silent for {_lasting(silent_s)}, since {since:%H:%M:%S}"


def _lasting(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
