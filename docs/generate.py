"""Writes the pages that are generated from the code: python docs/generate.py."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from api_overview import api_overview
from command_reference import command_reference

PAGES: Mapping[str, Callable[[], str]] = {"commands.md": command_reference, "api/overview.md": api_overview}
"""By path in docs/."""

if __name__ == "__main__":
    for page, text in PAGES.items():
        (Path(__file__).parent / page).write_text(text() + "\n", encoding="utf-8")
