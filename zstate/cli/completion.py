"""Shell completion of arguments: robots, models, files and parameters.

Attached to commands only while a shell completes, so that other invocations do not load it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

# Robots on this host are discovered in a fraction of this; a longer delay is annoying at a prompt.
_ROBOTS_WITHIN_S = 0.4

_MODELS = {"check": "file", "demo": "robot", "init": "robot", "joints": "robot", "publish": "robot"}
_FILES = ("file", "folder")


class ModelName(click.types.StringParamType):
    """A catalog name or a file."""

    name = "model"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        from zstate.model.catalog import catalog

        found = [CompletionItem(entry.name) for entry in catalog() if entry.name.startswith(incomplete)]
        return found or [CompletionItem(incomplete, type="file")]


class RobotName(click.types.StringParamType):
    """An announced robot."""

    name = "robot"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(name) for name in _announced(ctx) if name.startswith(incomplete)]


class ParameterSetting(click.types.StringParamType):
    """KEY=VALUE with the parameters of the file of `zstate up` and their current values."""

    name = "setting"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        from zstate.cli.up.toml_file import TomlFile
        from zstate.errors import ConfigError

        with suppress(ConfigError):
            known = TomlFile(Path(str(ctx.params.get("file")))).tables.get("parameters", {})
            return [CompletionItem(f"{k}={value}") for k, value in known.items() if k.startswith(incomplete)]
        return []


def with_completion(command: click.Command) -> click.Command:
    """``command`` with completion for its arguments."""
    if isinstance(command, click.Group):
        for inner in command.commands.values():
            with_completion(inner)
    for parameter in command.params:
        if isinstance(parameter, click.Argument):
            parameter.type = _kind(command.name or "", parameter)
    return command


def _kind(command: str, argument: click.Argument) -> Any:
    if _MODELS.get(command) == argument.name:
        return ModelName()
    if command == "up" and argument.name == "parameters":
        return ParameterSetting()
    if argument.name in ("robot", "robots"):
        return RobotName()
    return click.Path() if argument.name in _FILES else argument.type


def _announced(ctx: click.Context) -> Iterator[str]:
    from zstate.cli.session import SessionOptions
    from zstate.errors import ZStateError
    from zstate.net.presence import discover
    from zstate.net.session import connect

    get = ctx.params.get
    network = SessionOptions(get("mode"), get("connect") or (), get("listen") or (), get("config"))
    # Errors are left to the command itself.
    with (
        suppress(ZStateError),
        connect(
            network.config,
            mode=network.joins_as,
            endpoints=network.connect,
            listen=network.listen,
            timeout_s=_ROBOTS_WITHIN_S,
        ) as session,
    ):
        robots = discover(session, _ROBOTS_WITHIN_S, wire=ctx.params.get("wire") or "native")
        yield from (robot.name for robot in robots)
