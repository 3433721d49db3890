"""Suggestions for misspelled names, in one form for all messages."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def did_you_mean(name: str, candidates: Iterable[str], *, count: int = 1) -> str:
    """``; did you mean 'x'?`` with the ``candidates`` most similar to ``name``; empty without any."""
    return suggestion_text(*get_close_matches(name, list(candidates), n=count))


def suggestion_text(*names: str | None) -> str:
    """``; did you mean 'x' or 'y'?``; empty without names. None stands for no name."""
    found = [repr(name) for name in names if name is not None]
    return f"; did you mean {' or '.join(found)}?" if found else ""
