"""Text that keeps up to date in its place on a terminal."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NoReturn

from rich.live import Live
from rich.text import Text


def keep_showing(text: Callable[[], str], every_s: float = 0.5) -> NoReturn:
    """Show ``text()`` again and again, as much of it as fits the terminal."""
    with Live(auto_refresh=False) as live:
        while True:
            live.update(Text(text(), no_wrap=True, overflow="crop"), refresh=True)
            time.sleep(every_s)
