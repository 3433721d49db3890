"""Setting: one value that commands go by, and where it comes from."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, cast

import click
from click.core import ParameterSource


@dataclass(frozen=True, slots=True)
class Setting:
    """``value`` is None where there is none; ``origin`` names the option, variable or file it comes from."""

    name: str
    value: Any
    origin: str

    @property
    def text(self) -> str:
        """The value for a person."""
        value: object = self.value
        if isinstance(value, list):
            return " ".join(map(str, cast("list[object]", value))) or "-"
        return "-" if value is None else str(value)


def of_option(context: click.Context, name: str) -> Setting:
    """What the option ``name`` of the running command is, and who said so."""
    value: Any = context.params[name]
    option = next(one for one in context.command.params if one.name == name)
    if isinstance(value, tuple):
        value = list(value)  # pyright: ignore[reportUnknownArgumentType,reportUnknownVariableType]
    return Setting(option.opts[0].lstrip("-"), value, _origin(context, option))


def _origin(context: click.Context, option: click.Parameter) -> str:
    source = context.get_parameter_source(option.name or "")
    if source == ParameterSource.COMMANDLINE:
        return f"option {option.opts[0]}"
    if source == ParameterSource.ENVIRONMENT:
        return f"environment {_variable(context, option)}"
    return "default"


def _variable(context: click.Context, option: click.Parameter) -> str:
    """The variable that counted: its own name comes before the one that any option has."""
    own = option.envvar
    if isinstance(own, str) and os.environ.get(own):
        return own
    return f"{context.auto_envvar_prefix}_{(option.name or '').upper()}"


def of_variable(name: str, variable: str, default: Any) -> Setting:
    """What an environment variable is, or what stands in for it."""
    value = os.environ.get(variable)
    return Setting(name, value, f"environment {variable}") if value else Setting(name, default, "default")
