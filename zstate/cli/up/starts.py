"""From the file of `zstate up` to the processes it stands for."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from zstate._util.endpoint import format_host
from zstate._util.suggestions import did_you_mean
from zstate.cli.options import load_robot, parsed_xacro_args
from zstate.cli.up.cell import Cell
from zstate.cli.up.edges import check_edges
from zstate.cli.up.joining import options, router_options, session_options, session_variables
from zstate.cli.up.sections import ProgramSection, Restart, RobotSection, in_a_list
from zstate.cli.up.tables import Placed
from zstate.errors import ConfigError, InvalidInput, ModelError
from zstate.metrics.address import Address
from zstate.model.catalog import is_path
from zstate.wire.keys import check_robot

ROUTER, STATIC = "router", "static"


@dataclass(frozen=True, slots=True)
class Start:
    """One process to start: what its lines are called, and what it runs.

    ``arguments`` are those of zstate, or with ``is_program`` a command of the user's own, which runs in
    ``folder`` with ``environment`` besides. It starts when those it is ``after`` are ready, and is ready
    once it says a line with the text ``ready``; with None at once.
    """

    name: str
    arguments: tuple[str, ...]
    after: tuple[str, ...] = ()
    restart: Restart = "never"
    ready: str | None = ""
    is_program: bool = False
    folder: str | None = None
    environment: Mapping[str, str] = field(default_factory=dict[str, str])


def planned(cell: Cell, file: Path, settings: Mapping[str, str]) -> list[Start]:
    """What to start, in this order. Raises ConfigError for what no command would accept."""
    starts: dict[str, Start] = {}
    places: dict[str, Placed[Any]] = {}
    for start, placed in _all(cell, file, settings):
        if start.name in starts:
            other = places[start.name].place
            raise placed.error(f"{other} is called {start.name!r} already; give one of them another name")
        starts[start.name], places[start.name] = start, placed
    if not starts:
        raise ConfigError(f"{file} starts nothing; it has no [router], [[robot]], [[static]] or [[program]]")
    for start in starts.values():
        _check_order(start, starts, places[start.name])
    return list(starts.values())


def robot_names(cell: Cell) -> tuple[str, ...]:
    """What the robots of the file are called."""
    return tuple(_model_and_name(placed)[1] for placed in cell.robot)


def _all(cell: Cell, file: Path, settings: Mapping[str, str]) -> Iterator[tuple[Start, Placed[Any]]]:
    first: tuple[str, ...] = ()
    if cell.router is not None:
        first, restart = (ROUTER,), cell.router.section.restart
        yield Start(ROUTER, ("router", *router_options(cell.router)), (), restart), cell.router
    for robot in cell.robot:
        yield _robot_start(robot, cell, first), robot
    if cell.static:
        robots = robot_names(cell)
        check_edges(cell, robots)
        sets = options("--set", tuple(f"{key}={value}" for key, value in settings.items()))
        arguments = ("static", "--file", str(file), *sets, *session_options(cell))
        yield Start(STATIC, arguments, first), cell.static[0]
    for program in cell.program:
        yield _program_start(program, cell, first), program


def _robot_start(placed: Placed[RobotSection], cell: Cell, first: tuple[str, ...]) -> Start:
    robot = placed.section
    model, name = _model_and_name(placed)
    rate = () if robot.rate is None else ("--rate", repr(robot.rate))
    clock = () if robot.clock == "system" else ("--clock", robot.clock)
    own = ("--name", name, "--source", _source(placed), *rate, *options("--wire", robot.wires), *clock)
    arguments = (*own, *(("--takeover",) if robot.takeover else ()), *_metrics(placed))
    _check_identity(placed, cell)
    arguments = ("publish", model, *_xacro_words(robot), *arguments, *session_options(cell, robot.identity))
    return Start(name, arguments, (*first, *in_a_list(robot.after)), robot.restart)


def _model_and_name(placed: Placed[RobotSection]) -> tuple[str, str]:
    """The model as a child will find it, and the robot's name."""
    given = placed.section.model
    beside = placed.beside(given)
    model = beside if is_path(given) or Path(beside).is_file() else given
    try:
        default = _default_name(model, placed.section.name, _xacro_words(placed.section))
        return model, check_robot(placed.section.name or default)
    except (ModelError, InvalidInput) as error:
        raise placed.error(str(error)) from None


@lru_cache(maxsize=256)
def _default_name(model: str, name: str | None, xacro_words: tuple[str, ...]) -> str:
    return load_robot(model, name, parsed_xacro_args(xacro_words))[1]


def _xacro_words(robot: RobotSection) -> tuple[str, ...]:
    """Xacro arguments as a command line has them; xacro's truth values are those of Python, in lower case."""
    return tuple(
        f"{name}:={str(value).lower() if isinstance(value, bool) else value}"
        for name, value in robot.xacro_args.items()
    )


def _source(placed: Placed[RobotSection]) -> str:
    source = placed.section.source
    if source in ("joints", "sine"):
        return source
    path = placed.beside(source)
    if not Path(path).exists():
        raise placed.error(f"{source!r} is neither 'joints' nor 'sine' nor a recording that exists", "source")
    return path


def _metrics(placed: Placed[RobotSection]) -> tuple[str, ...]:
    """Each robot of a loop has the next port."""
    if placed.section.metrics is None:
        return ()
    host, port = Address.parse(str(placed.section.metrics))
    return ("--metrics", f"{format_host(host)}:{port + placed.turn if port else 0}")


def _program_start(placed: Placed[ProgramSection], cell: Cell, first: tuple[str, ...]) -> Start:
    program = placed.section
    try:
        command = tuple(shlex.split(program.run) if isinstance(program.run, str) else program.run)
    except ValueError as error:
        advice = "an argument with a quote needs a list: run = ['python', 'driver.py', '...']"
        raise placed.error(f"{program.run!r} is not a command line ({error}); {advice}", "run") from None
    if not command:
        raise placed.error("is empty; write for instance run = 'python driver.py'", "run")
    is_ours = command[0] == "zstate"
    if command[0] in ("python", "python3"):
        command = (sys.executable, *command[1:])
    _check_identity(placed, cell)
    variables = {key: str(value) for key, value in program.environment.items()}
    return Start(
        program.name or _program_name(command),
        command[1:] if is_ours else command,
        (*first, *in_a_list(program.after)),
        program.restart,
        program.ready or "" if is_ours else program.ready,
        is_program=not is_ours,
        folder=str(placed.file.folder.resolve()),
        environment={**session_variables(cell, program.identity), **variables},
    )


def _program_name(command: tuple[str, ...]) -> str:
    """The command of zstate, the script of a Python, else the program."""
    if command[0] == "zstate":
        return next(iter(command[1:]), "zstate")
    return Path(next((word for word in command if word.endswith(".py")), command[0])).stem


def _check_identity(placed: Placed[Any], cell: Cell) -> None:
    network = None if cell.network is None else cell.network.section
    certs = network is not None and network.certs is not None
    named = placed.section.identity or (network and network.identity)
    if certs and not named:
        raise placed.error("the certs of [network] are of no use without identity, here or there")
    if placed.section.identity and not certs:
        raise placed.error("is of no use without certs = in [network]", "identity")


def _check_order(start: Start, starts: Mapping[str, Start], placed: Placed[Any]) -> None:
    """Those it is after exist, and are not after it."""
    behind, new = set[str](), [start.name]
    while new:
        for name in starts[new.pop()].after:
            if name not in starts:
                known = did_you_mean(name, starts) or f"; there are {', '.join(starts)}"
                raise placed.error(f"nothing here is called {name!r}{known}", "after")
            if name == start.name:
                raise placed.error(f"{name!r} would wait for itself", "after")
            if name not in behind:
                behind.add(name)
                new.append(name)
