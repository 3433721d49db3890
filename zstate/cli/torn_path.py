"""A path with a space in it, which the shell has made two arguments of."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path


def torn_path_hint(arguments: Sequence[str]) -> str:
    """What to write instead, where neighbours among ``arguments`` are a path that exists; else nothing."""
    for first, end in combinations(range(len(arguments) + 1), 2):
        path = " ".join(arguments[first:end])
        if end - first > 1 and not path.startswith("-") and _exists(path):
            return f"{path!r} is one path with a space in it; write it in quotes: {shlex.quote(path)}"
    return ""


def _exists(path: str) -> bool:
    try:
        return Path(path).exists()
    except (OSError, ValueError):
        return False
