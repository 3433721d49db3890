"""The commands, named as they are called; ``load_command`` imports one."""

from __future__ import annotations

from importlib import import_module

import click

_SHARED_MODULES = {"stop": "move"}
"""Commands that are in the module of another one; all others have a module of their own name."""


def load_command(name: str) -> click.Command:
    """``zstate NAME``, which is ``NAME_command`` of its module."""
    module = import_module(f"{__name__}.{_SHARED_MODULES.get(name, name)}")
    command = getattr(module, f"{name}_command")
    assert isinstance(command, click.Command)
    return command
