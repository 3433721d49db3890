"""Environments of the other systems: ``.bench`` in the checkout, or ``ZSTATE_BENCH_HOME``."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

ENVIRONMENTS = Path(os.environ.get("ZSTATE_BENCH_HOME") or Path(__file__).parents[1] / ".bench")
ROS1_LISTENER = ENVIRONMENTS / "ros1_cpp" / "libros1_listener.so"
"""The compiled ``bench/subjects/ros1_listener.cpp``."""


def environment_path(name: str) -> str:
    """The path of the environment ``name``, quoted for a command that is run in the checkout."""
    return shlex.quote(os.environ.get("ZSTATE_BENCH_HOME", ".bench") + f"/{name}")


def venv_python(name: str) -> str | None:
    """The interpreter of the environment ``name``, as made by ``python -m bench setup``; None if absent."""
    python = ENVIRONMENTS / name / "bin" / "python"
    return str(python) if python.exists() else None
