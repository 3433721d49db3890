"""What is wrong with what commands are told from outside."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import click

from zstate._util.suggestions import did_you_mean
from zstate.cli.config.settings import network_of
from zstate.cli.logs import FORMAT_VARIABLE, FORMATS
from zstate.cli.options import PASSWORD_VARIABLE
from zstate.errors import ZStateError
from zstate.extension import VARIABLE as KERNEL_VARIABLE
from zstate.net.config import CONFIG_VARIABLE, endpoint_list
from zstate.net.rendezvous import RENDEZVOUS_VARIABLE, rendezvous_addresses

_PREFIX = "ZSTATE_"
_VARIABLES = (
    RENDEZVOUS_VARIABLE,
    PASSWORD_VARIABLE,
    KERNEL_VARIABLE,
    FORMAT_VARIABLE,
    "ZSTATE_USERS",
)


def problems(context: click.Context) -> list[str]:
    """Each in a sentence; commands would fail with most of them, or go on without what was meant."""
    network_said = context.params
    checks: tuple[Callable[[], object], ...] = (
        lambda: endpoint_list((*network_said["connect"], *network_said["listen"])),
        rendezvous_addresses,
        lambda: network_of(context),
    )
    found = [text for check in checks if (text := _objection(check))]
    return [*found, *_contradictions(context), *_unread(context)]


def _objection(check: Callable[[], object]) -> str:
    try:
        check()
    except ZStateError as error:
        return str(error)
    except click.ClickException as error:
        return error.format_message()
    return ""


def _contradictions(context: click.Context) -> Iterator[str]:
    said = context.params
    file = said["config"] or os.environ.get(CONFIG_VARIABLE)
    if said["config"] and os.environ.get(CONFIG_VARIABLE):
        yield f"{CONFIG_VARIABLE} names a file, too; that of --config counts"
    if said["mode"] == "loopback" and file:
        yield f"mode 'loopback' stays on this host, and the configuration {file!r} could leave it: choose one"
    if said["mode"] == "client" and not said["connect"] and not file:
        yield "mode 'client' needs --connect, for instance tcp/192.168.1.10:7447"
    form = os.environ.get(FORMAT_VARIABLE)
    if form and form not in FORMATS:
        yield f"{FORMAT_VARIABLE} is {form!r}; it is {' or '.join(FORMATS)}"


def _unread(context: click.Context) -> Iterator[str]:
    known = {*_VARIABLES, *(str(one.envvar) for one in context.command.params if one.envvar)}
    for variable in sorted(os.environ):
        if variable.startswith(_PREFIX) and variable not in known and not _is_of_command(context, variable):
            yield f"nothing reads {variable}{did_you_mean(variable, known)}"


def _is_of_command(context: click.Context, variable: str) -> bool:
    """Whether it is an option of one command, ZSTATE_COMMAND_OPTION, as all of them have one."""
    group = context.find_root().command
    assert isinstance(group, click.Group)
    name, _, option = variable.removeprefix(_PREFIX).partition("_")
    command = group.get_command(context, name.lower())
    return command is not None and option in {(one.name or "").upper() for one in command.params}
