"""What the shell offers for an argument when Tab is pressed: robots, models and files.

Commands are taught this only while the shell asks, so that others need not load it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

# Who is announced on this host answers in a fraction of this; nobody waits longer at a prompt.
_ROBOTS_WITHIN_S = 0.4

_MODELS = {"check": "file", "demo": "robot", "init": "robot", "joints": "robot", "publish": "robot"}
_FILES = ("file", "folder")


class ModelName(click.types.StringParamType):
    """A name of the catalog, or a file."""

    name = "model"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        from zstate.model.known import catalog

        found = [CompletionItem(entry.name) for entry in catalog() if entry.name.startswith(incomplete)]
        return found or [CompletionItem(incomplete, type="file")]


class RobotName(click.types.StringParamType):
    """A robot that is announced."""

    name = "robot"

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(name) for name in _announced(ctx) if name.startswith(incomplete)]


class ParameterSetting(click.types.StringParamType):
    """KEY=VALUE of a parameter that the file of `zstate up` has, as it is there."""

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


def taught(command: click.Command) -> click.Command:
    """``command``, whose arguments know what to offer."""
    if isinstance(command, click.Group):
        for inner in command.commands.values():
            taught(inner)
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
    from zstate.cli.network import Network
    from zstate.errors import ZStateError
    from zstate.net.presence import discover
    from zstate.net.session import connect

    said = {name: ctx.params.get(name) for name in ("mode", "connect", "listen", "config")}
    network = Network(said["mode"], said["connect"] or (), said["listen"] or (), said["config"])
    # Whatever is wrong, the command itself will tell.
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
