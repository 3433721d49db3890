"""Where the environments of other systems live: ``.bench`` in the checkout, or ``ZSTATE_BENCH_HOME``."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

HOME = Path(os.environ.get("ZSTATE_BENCH_HOME") or Path(__file__).parents[1] / ".bench")


def place(name: str) -> str:
    """Where ``name`` lives, as a command names it that is run in the checkout."""
    return shlex.quote(os.environ.get("ZSTATE_BENCH_HOME", ".bench") + f"/{name}")


def venv_python(name: str) -> str | None:
    """The interpreter of the environment ``name`` made by ``python -m bench setup``, if it is there."""
    python = HOME / name / "bin" / "python"
    return str(python) if python.exists() else None
