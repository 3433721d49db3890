"""A table of the file of `zstate up` that is a command: its keys are the options and arguments of that."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import chdir
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import click
import msgspec

from zstate._util.format import did_you_mean
from zstate.cli import options
from zstate.cli.commands import load_command, load_other_command, own_commands
from zstate.cli.up.template import LOOP_KEYS, NO_LOOPS, Located
from zstate.errors import ConfigError, InvalidInput
from zstate.model.load import is_path

Restart = Literal["never", "on-failure", "always"]
Names = str | tuple[str, ...]
Words = Mapping[str, tuple[str, ...]]
"""By parameter of a command: what is on a command line for it, such as ("--wire", "native")."""

_Section = TypeVar("_Section", bound=msgspec.Struct)


@click.command("network")
@options.plain_session_options
def network_command(**_: object) -> None:
    """The parameters of [network]: the session options of every command."""


class ProcessKeys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The keys of every process. It is ready once it prints a line with the text ``ready``."""

    name: str | None = None
    after: Names = ()
    restart: Restart = "never"
    ready: str | None = None
    environment: dict[str, str | int | float] = {}


@dataclass(frozen=True, slots=True)
class CommandTable:
    """A table as a command: its ``words`` on a command line, and the ``values`` that the command gets.

    ``keys`` are those for its process.
    """

    name: str
    command: click.Command
    words: Words
    values: Mapping[str, Any]
    keys: ProcessKeys

    def arguments(self, words: Words) -> tuple[str, ...]:
        """The command line of zstate with ``words``."""
        return (self.name, *in_order(self.command, words))

    def process_name(self) -> str:
        """OWNER/WRITER, OWNER/SENSOR or OWNER/COMMAND, such as "hall/map": the first of them that it has.

        OWNER is its ``name``, else its robot, or the place whose map is its file.
        """
        values = self.values
        owners = [self.keys.name, values.get("name"), values.get("robot")]
        owners += [values.get("file")] if "name" in values else []
        owner = next((one for one in owners if isinstance(one, str)), None)
        part = values.get("writer") or values.get("sensor") or self.name
        if owner is None:
            return str(part)
        return f"{options.place_name(owner) if is_path(owner) else owner}/{part}"


def read_command(kind: str, table: Located[dict[str, Any]]) -> Located[CommandTable]:
    """The table as a command, checked as that checks its command line.

    ``[[robot]]`` is `zstate publish` with ``model`` for ROBOT. Raises ConfigError with the line and the key.
    """
    name = "publish" if kind == "robot" else kind
    command = network_command if kind == "network" else _command_named(name, table)
    parameters = _by_key(command)
    if kind == "robot":
        parameters["model"] = parameters.pop("robot")
    of_process = () if kind == "network" else ProcessKeys.__struct_fields__
    of_process = tuple(key for key in of_process if key not in parameters)
    keys: dict[str, Any] = {}
    words: dict[str, tuple[str, ...]] = {}
    key_of = {one.name: key for key, one in parameters.items()}
    for key, value in table.section.items():
        parameter = parameters.get(key.replace("-", "_"))
        if key in of_process:
            keys[key] = value
        elif parameter is None:
            raise no_such_key(kind, table, key, (*parameters, *of_process))
        elif parameter.name in words:
            raise table.error(f"is there as {key_of[parameter.name]} already", key)
        else:
            try:
                words[parameter.name] = tuple(_words(parameter, value, table))
            except (InvalidInput, click.BadParameter) as error:
                raise table.error(str(error), key) from None
            key_of[parameter.name] = key
    try:
        # The process runs there: what is no click.Path, such as FILE.py:CLASS, is relative to it as well.
        with chdir(table.file.folder):
            line = list(in_order(command, words))
            values = command.make_context(name, line, auto_envvar_prefix=f"ZSTATE_{name.upper()}").params
    except click.MissingParameter as error:
        key = key_of[error.param.name] if error.param else "argument"
        raise table.error(f"there is no {key}, which `zstate {name}` needs") from None
    except click.UsageError as error:
        parameter = error.param if isinstance(error, click.BadParameter) else None
        raise table.error(error.message, key_of[parameter.name] if parameter else "") from None
    words = {key: one for key, one in words.items() if one}
    process = checked(kind, replace(table, section=keys), ProcessKeys).section
    found = CommandTable(name, command, words, values, process)
    return Located(found, table.file, table.place, table.iteration)


def checked(kind: str, table: Located[dict[str, Any]], section: type[_Section]) -> Located[_Section]:
    """The table as a ``section``. Raises ConfigError with the line and the key."""
    try:
        # Not strict: values from the environment and the command line are text.
        values = msgspec.convert(table.section, section, strict=False)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$")
        unknown = re.search(r"unknown field `(.*)`", text)
        if unknown is None:
            raise table.file.error(f"{table.place}{place.strip('`')}", text) from None
        raise no_such_key(kind, table, unknown[1], section.__struct_fields__) from None
    return Located(values, table.file, table.place, table.iteration)


def no_such_key(kind: str, table: Located[Any], key: str, known: tuple[str, ...]) -> ConfigError:
    """The error of a ``key`` that is none of the ``known`` ones."""
    valid = (*known, *(("when",) if kind in NO_LOOPS else LOOP_KEYS))
    hint = did_you_mean(key, valid) or f"; there are {', '.join(valid)}"
    return table.error(f"there is no such key{hint}", key)


def _command_named(name: str, table: Located[Any]) -> click.Command:
    command = load_command(name) if name in own_commands() else load_other_command(name)
    assert command is not None, f"{name!r} is no command: such tables are refused before"
    if isinstance(command, click.Group):
        text = f"`zstate {name}` is several commands; write [[program]] with run = 'zstate {name} ...'"
        raise table.error(text)
    return command


def _by_key(command: click.Command) -> dict[str, click.Parameter]:
    """The parameters: arguments by their names, options by their long ones with _ for -.

    One that may be repeated has the name of its list as well: wire is also wires.
    """
    found: dict[str, click.Parameter] = {}
    for one in command.params:
        found |= {word[2:].replace("-", "_"): one for word in one.opts if word.startswith("--")}
        if isinstance(one, click.Argument) or one.multiple:
            found[one.name] = one
    return found


def in_order(command: click.Command, words: Words) -> Iterator[str]:
    """The ``words`` of the parameters of ``command``, in their order."""
    arguments = [one for one in command.params if isinstance(one, click.Argument)]
    given = [number for number, one in enumerate(arguments) if one.name in words]
    skipped = [] if not given else [one for one in arguments[: given[-1]] if one.name not in words]
    for one in command.params:
        if one in skipped and isinstance(one.default, str):  # else the next argument would be taken for it
            yield one.default
        else:
            yield from words.get(one.name, ())


def _words(parameter: click.Parameter, value: Any, table: Located[Any]) -> Iterator[str]:
    """``value`` of a key as on a command line. Raises InvalidInput, and BadParameter for no truth value."""
    option = max(parameter.opts, key=len) if isinstance(parameter, click.Option) else ""
    if isinstance(parameter, click.Option) and parameter.is_flag:
        is_set = click.BOOL.convert(value, None, None)
        yield from [option] if is_set else parameter.secondary_opts[:1]
        return
    is_list = parameter.multiple or parameter.nargs == -1
    items: list[Any] = cast("list[Any]", value) if is_list and isinstance(value, list) else [value]
    if is_list and isinstance(value, dict):
        sign = ":=" if ":=" in (parameter.metavar or "") else "="
        items = [f"{key}{sign}{_text(one)}" for key, one in cast("dict[str, Any]", value).items()]
    for item in items:
        parts: list[Any] = cast("list[Any]", item) if isinstance(item, list) else [item]
        count = max(parameter.nargs, 1)
        if len(parts) != count or any(isinstance(part, list | dict) for part in parts):
            raise InvalidInput(f"takes {'one value' if count == 1 else f'{count} values'}, not {item!r}")
        texts = [_resolved(_text(part), parameter, table) for part in parts]
        if not option and texts[0].startswith("-"):
            raise InvalidInput(f"{texts[0]!r} would be an option: it begins with -")
        yield from [option, *texts] if option else texts


def _text(value: Any) -> str:
    """A value as text; in JSON what is no text, as true and 1.5 are."""
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _resolved(text: str, parameter: click.Parameter, table: Located[Any]) -> str:
    """A path relative to the file, and any other text unchanged."""
    path = table.resolve(text)
    is_model = parameter.type is options.MODEL and (is_path(text) or Path(path).is_file())
    return path if is_model or isinstance(parameter.type, click.Path) else text
