"""The command reference: Markdown, generated from the click commands by docs/generate.py."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from functools import cache
from itertools import groupby

import click

from zstate.cli import main
from zstate.cli.commands import own_commands

_INTRODUCTION = """# Commands

These are the texts of `zstate COMMAND --help`. An option can also be an environment variable, such as
`ZSTATE_PUBLISH_RATE` for `zstate publish --rate`; `zstate config` shows the settings in effect. Exit codes:
0 after success, 1 after a failure, 2 for wrong usage, 130 after Ctrl-C."""

_NETWORK_OPTIONS = """## Network options

Every command that joins the network has these options."""

Option = tuple[str, str]
"""An option with its metavar, and its help."""


def command_reference() -> str:
    """The page: a section for each section of ``zstate --help``, and in it a part for each command."""
    top = click.Context(main.group, info_name="zstate")
    names = main.group.list_commands(top)
    contexts = {name: _context(main.group, name, top) for name in names}
    parts = [_INTRODUCTION]
    for section, named in groupby(names, key=lambda name: own_commands()[name].section):
        parts.append(f"## {section}")
        for name in named:
            parts += _command_parts(contexts[name], "###")
    return "\n\n".join([*parts, _NETWORK_OPTIONS, *_option_parts(_network_options())])


def _context(group: click.Group, name: str, parent: click.Context) -> click.Context:
    command = group.get_command(parent, name)
    assert command is not None
    return click.Context(command, parent, info_name=name)


def _command_parts(context: click.Context, heading: str) -> Iterator[str]:
    command = context.command
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    yield f"{heading} {context.command_path}"
    yield f"```text\n{usage}\n```"
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        yield _block(paragraph[2:]) if paragraph.startswith("\b\n") else _escaped(paragraph)
    options = _options(context)
    yield from _option_parts([one for one in options if not _is_network(one)])
    if any(map(_is_network, options)):
        yield "And the [network options](#network-options)."
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            yield from _command_parts(_context(command, name, context), f"{heading}#")


def _block(lines: str) -> str:
    """Examples, or a file in TOML."""
    language = "toml" if re.match(r"\[|\w+ = ", lines) else "sh"
    return f"```{language}\n{lines}\n```"


def _options(context: click.Context) -> list[Option]:
    records = (
        one.get_help_record(context) for one in context.command.params if isinstance(one, click.Option)
    )
    return [record for record in records if record is not None]


@cache
def _network_options() -> list[Option]:
    """The options that commands share; some have one of the same name with a meaning of its own."""
    context = _context(main.group, "ls", click.Context(main.group, info_name="zstate"))
    return [option for option in _options(context) if option[0].split(" ")[0] in main._NETWORK]


def _is_network(option: Option) -> bool:
    return option in _network_options()


def _option_parts(options: list[Option]) -> Iterator[str]:
    if options:
        yield "\n".join(f"- `{names}`: {_escaped(text)}" for names, text in options)


def _escaped(text: str) -> str:
    """Plain text with code in backticks, as Markdown."""
    code = re.split(r"(`[^`]*`)", text)
    return "".join(
        part if part.startswith("`") else re.sub(r"([\\*_\[\]<>#{}$|]|^%)", r"\\\1", part, flags=re.MULTILINE)
        for part in code
    )
