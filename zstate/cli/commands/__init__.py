"""The commands, named as they are called; ``load_command`` imports one."""

from __future__ import annotations

import pkgutil
from importlib import import_module

import click

from zstate.cli.output.console import fail

_SHARED_MODULES = {"stop": "move"}
"""Commands that are in the module of another one; all others have a module of their own name."""


def command_names() -> set[str]:
    """The names of the commands of zstate."""
    return {*(module.name for module in pkgutil.iter_modules(__path__)), *_SHARED_MODULES}


def load_command(name: str) -> click.Command:
    """``zstate NAME``, which is ``NAME_command`` of its module."""
    module = import_module(f"{__name__}.{_SHARED_MODULES.get(name, name)}")
    command = getattr(module, f"{name}_command")
    assert isinstance(command, click.Command)
    return command


def load_other_command(name: str) -> click.Command | None:
    """The command ``name`` that another package brings; None if none does. Fails if it cannot be loaded."""
    from zstate.plugins import found_plugins

    for one in found_plugins():
        if name in one.plugin.commands:
            place = one.plugin.commands[name]
            module, _, attribute = place.partition(":")
            try:
                command = getattr(import_module(module), attribute)
            except Exception as error:  # whatever another package's module does when it is imported
                problem = f"cannot be loaded: {type(error).__name__}: {error}"
                fail(f"the command {name!r} of {one.distribution} ({place}) {problem}")
            if not isinstance(command, click.Command):
                fail(f"the command {name!r} of {one.distribution} ({place}) is no click.Command")
            return command
    return None
