"""The processes of a file of `zstate up`: their command lines, their order, and how they join the network."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from zstate._util.endpoint import format_host
from zstate._util.format import did_you_mean
from zstate.cli.options import load_robot, parse_xacro_args
from zstate.cli.up.cell import Cell, ProgramSection, as_tuple
from zstate.cli.up.command_table import CommandTable, ProcessKeys, Restart, Words, in_order, network_command
from zstate.cli.up.static_edges import check_edges
from zstate.cli.up.template import Located
from zstate.errors import ConfigError, InvalidInput, ModelError
from zstate.net.config import ROUTER_ENDPOINT
from zstate.wire.keys import check_robot

_PLACE = {"mode", "connect", "listen", "config"}


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One process to start.

    ``arguments`` are those of zstate, or with ``is_program`` the command line of another program, which runs
    in ``folder`` with the variables of ``environment``. The process starts once those in ``after`` are ready,
    and is ready once it prints a line with the text ``ready``, or at once if that is None.
    """

    name: str
    arguments: tuple[str, ...]
    after: tuple[str, ...] = ()
    restart: Restart = "never"
    ready: str | None = ""
    is_program: bool = False
    folder: str | None = None
    environment: Mapping[str, str] = field(default_factory=dict[str, str])


def plan_processes(cell: Cell, file: Path, settings: Mapping[str, str]) -> list[ProcessSpec]:
    """The processes in order of the file. Raises ConfigError for values that no command would accept."""
    specs: dict[str, ProcessSpec] = {}
    tables: dict[str, Located[Any]] = {}
    for spec, table in _specs(cell, file, settings):
        if spec.name in specs:
            other = tables[spec.name].place
            raise table.error(f"{other} is called {spec.name!r} already; give one of them another `name`")
        specs[spec.name], tables[spec.name] = spec, table
    if not specs:
        raise ConfigError(f"{file} starts nothing; [[robot]], [[program]] and each [[COMMAND]] of zstate do")
    for name in specs:
        _check_order(name, specs, tables[name])
    return list(specs.values())


def robot_names(cell: Cell) -> tuple[str, ...]:
    """The names of the robots of the file."""
    return tuple(map(_robot_name, cell.robot))


def _specs(cell: Cell, file: Path, settings: Mapping[str, str]) -> Iterator[tuple[ProcessSpec, Located[Any]]]:
    if cell.router is not None:
        router = cell.router.section
        words = {**router.words, "listen": _router_endpoints(router)}
        if "site" in words and not words.keys() & {"robot", "robot_file"}:
            words["robot"] = tuple(word for name in robot_names(cell) for word in ("--robot", name))
        yield _command_spec("router", cell.router, words, ()), cell.router
    first = () if cell.router is None else ("router",)
    for robot in cell.robot:
        yield (
            _command_spec(_robot_name(robot), robot, _joined(robot, robot.section.words, cell), first),
            robot,
        )
    if cell.static:
        check_edges(cell, robot_names(cell))
        sets = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        arguments = ("static", "--file", str(file), *sets, *in_order(network_command, _session_words(cell)))
        yield ProcessSpec("static", arguments, first), cell.static[0]
    for table in cell.command:
        command = table.section
        words = _joined(table, command.words, cell)
        yield _command_spec(command.process_name(), table, words, first), table
    for program in cell.program:
        yield _program_spec(program, cell, first), program


def _command_spec(
    name: str, table: Located[CommandTable], words: Words, first: tuple[str, ...]
) -> ProcessSpec:
    section = table.section
    match section.values.get("metrics"):
        case (str(host), int(port)) if port and table.iteration:  # each process of a loop has the next port
            words = {**words, "metrics": ("--metrics", f"{format_host(host)}:{port + table.iteration}")}
        case _:
            pass
    return ProcessSpec(
        name,
        section.arguments(words),
        (*first, *as_tuple(section.keys.after)),
        section.keys.restart,
        section.keys.ready or "",
        folder=str(table.file.folder.resolve()),
        # What the command has no options for, zstate.connect() finds there.
        environment=_environment(
            {key: one for key, one in words.items() if key not in section.values}, section.keys
        ),
    )


def _robot_name(table: Located[CommandTable]) -> str:
    """The name of the robot: a model that cannot be used is refused here."""
    words, values = table.section.words, table.section.values
    try:
        (model,) = words["robot"]
        return check_robot(_name_of(model, values["name"], words.get("xacro_args", ())))
    except (ModelError, InvalidInput) as error:
        raise table.error(str(error)) from None


@lru_cache(maxsize=256)
def _name_of(model: str, name: str | None, xacro_texts: tuple[str, ...]) -> str:
    return load_robot(model, name, parse_xacro_args(xacro_texts))[1]


def _program_spec(table: Located[ProgramSection], cell: Cell, first: tuple[str, ...]) -> ProcessSpec:
    program = table.section
    try:
        command = tuple(shlex.split(program.run) if isinstance(program.run, str) else program.run)
    except ValueError as error:
        advice = "an argument with a quote needs a list: run = ['python', 'driver.py', '...']"
        raise table.error(f"{program.run!r} is not a command line ({error}); {advice}", "run") from None
    if not command:
        raise table.error("is empty; write for instance run = 'python driver.py'", "run")
    is_zstate = command[0] == "zstate"
    if command[0] in ("python", "python3"):
        command = (sys.executable, *command[1:])
    script = next((word for word in command if word.endswith(".py")), command[0])
    default = next(iter(command[1:]), "zstate") if is_zstate else Path(script).stem
    own = {"identity": ("--identity", program.identity)} if program.identity else {}
    return ProcessSpec(
        program.name or default,
        command[1:] if is_zstate else command,
        (*first, *as_tuple(program.after)),
        program.restart,
        program.ready or "" if is_zstate else program.ready,
        is_program=not is_zstate,
        folder=str(table.file.folder.resolve()),
        environment=_environment(_joined(table, own, cell), program),
    )


def _check_order(name: str, specs: Mapping[str, ProcessSpec], table: Located[Any]) -> None:
    """Raise ConfigError if ``after`` names an unknown process, or leads back to this one."""
    seen, new = set[str](), [name]
    while new:
        for other in specs[new.pop()].after:
            if other not in specs:
                known = did_you_mean(other, specs) or f"; there are {', '.join(specs)}"
                raise table.error(f"no process is called {other!r}{known}", "after")
            if other == name:
                raise table.error(f"{other!r} waits for itself", "after")
            if other not in seen:
                seen.add(other)
                new.append(other)


def _joined(table: Located[Any], own: Words, cell: Cell) -> dict[str, tuple[str, ...]]:
    """``own`` words of a table and the session options, those of the table before those of [network]."""
    words = {**_session_words(cell), **own}
    if "certs" in words and "identity" not in words:
        raise table.error("the certs of [network] need an identity, here or there")
    if "identity" in own and "certs" not in words:
        raise table.error("needs certs = in [network]", "identity")
    return words


def _session_words(cell: Cell) -> dict[str, tuple[str, ...]]:
    """The session options of [network]; without a mode and an endpoint, those of a client of the router."""
    words = {} if cell.network is None else dict(cell.network.section.words)
    if "certs" not in words:
        words.pop("identity", None)
    if cell.router is not None and not words.keys() & _PLACE:
        endpoint = _router_endpoints(cell.router.section)[1]
        # A client on this host cannot connect to a wildcard address.
        endpoint = endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
        words |= {"mode": ("--mode", "client"), "connect": ("--connect", endpoint)}
    return words


def _environment(session: Words, keys: ProcessKeys) -> dict[str, str]:
    """The session options as variables, and those of a table, which take precedence."""
    variables = {f"ZSTATE_{key.upper()}": " ".join(words[1::2]) for key, words in session.items()}
    return variables | {key: str(value) for key, value in keys.environment.items()}


def _router_endpoints(router: CommandTable) -> tuple[str, ...]:
    # The certificates of a site are those of its uplink.
    is_encrypted = "certs" in router.words and "site" not in router.words
    default = ROUTER_ENDPOINT.replace("tcp/", "tls/", 1) if is_encrypted else ROUTER_ENDPOINT
    return router.words.get("listen", ("--listen", default))
