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
from zstate.cli.options import load_robot, parse_xacro_args, place_name
from zstate.cli.up.cell import (
    Cell,
    MapSection,
    NetworkSection,
    ProgramSection,
    Restart,
    RobotSection,
    RouterSection,
    ScanSection,
    as_tuple,
)
from zstate.cli.up.static_edges import check_edges
from zstate.cli.up.template import Located
from zstate.errors import ConfigError, InvalidInput, ModelError
from zstate.model.load import is_path
from zstate.net.config import ROUTER_ENDPOINT
from zstate.wire.keys import check_robot

_Values = dict[str, tuple[str, ...]]
"""Values by key. Options and environment variables are named after the keys of [network] and [router]."""

_STARTED = "[router], [[robot]], [[static]], [[map]], [[scan]] or [[program]]"
_NETWORK_PATHS = ("config", "certs", "password_file")
_ROUTER_PATHS = ("acl", "certs", "password_file", "users")


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
        raise ConfigError(f"{file} starts nothing; it has no {_STARTED}")
    for name in specs:
        _check_order(name, specs, tables[name])
    return list(specs.values())


def robot_names(cell: Cell) -> tuple[str, ...]:
    """The names of the robots of the file."""
    return tuple(_model_and_name(table)[1] for table in cell.robot)


def _specs(cell: Cell, file: Path, settings: Mapping[str, str]) -> Iterator[tuple[ProcessSpec, Located[Any]]]:
    router = cell.router
    first = () if router is None else ("router",)
    if router is not None:
        yield _router_spec(router), router
    for robot in cell.robot:
        yield _robot_spec(robot, cell, first), robot
    if cell.static:
        check_edges(cell, robot_names(cell))
        sets = {"set": tuple(f"{key}={value}" for key, value in settings.items())}
        arguments = ("static", "--file", str(file), *_options(sets | _session_values(cell)))
        yield ProcessSpec("static", arguments, first), cell.static[0]
    for place in cell.map:
        yield _map_spec(place, cell, first), place
    for scan in cell.scan:
        yield _scan_spec(scan, cell, first), scan
    for program in cell.program:
        yield _program_spec(program, cell, first), program


def _router_spec(table: Located[RouterSection]) -> ProcessSpec:
    router = table.section
    values: _Values = {"listen": _router_endpoints(router), "connect": router.connect}
    for key in _ROUTER_PATHS:
        values[key] = (table.resolve(path),) if (path := getattr(router, key)) else ()
    for key in ("identity", "user", "metrics"):
        values[key] = () if (value := getattr(router, key)) is None else (str(value),)
    ros2 = ("--ros2",) if router.ros2 else ()
    return ProcessSpec("router", ("router", *ros2, *_options(values)), restart=router.restart)


def _robot_spec(table: Located[RobotSection], cell: Cell, first: tuple[str, ...]) -> ProcessSpec:
    robot = table.section
    model, name = _model_and_name(table)
    source = robot.source
    if source not in ("joints", "sine"):
        source = table.resolve(source)
        if not Path(source).exists():
            text = f"{robot.source!r} is neither 'joints' nor 'sine' nor a recording that exists"
            raise table.error(text, "source")
    metrics: tuple[str, ...] = ()
    if robot.metrics is not None:
        from zstate.metrics.endpoint import BindAddress  # loads an HTTP server

        host, port = BindAddress.parse(str(robot.metrics))
        # Each robot of a loop has the next port.
        metrics = (f"{format_host(host)}:{port + table.iteration if port else 0}",)
    _check_identity(table, cell)
    values: _Values = {
        "name": (name,),
        "source": (source,),
        "rate": () if robot.rate is None else (repr(robot.rate),),
        "wire": robot.wires,
        "clock": () if robot.clock == "system" else (robot.clock,),
    }
    arguments = (
        *("publish", model, *_xacro_texts(robot), *_options(values)),
        *(("--takeover",) if robot.takeover else ()),
        *_options({"metrics": metrics, **_session_values(cell, robot.identity)}),
    )
    return ProcessSpec(name, arguments, (*first, *as_tuple(robot.after)), robot.restart)


def _model_and_name(table: Located[RobotSection]) -> tuple[str, str]:
    """The model as the child process finds it, and the name of the robot."""
    model, path = table.section.model, table.resolve(table.section.model)
    if is_path(model) or Path(path).is_file():
        model = path
    try:
        default = _default_name(model, table.section.name, _xacro_texts(table.section))
        return model, check_robot(table.section.name or default)
    except (ModelError, InvalidInput) as error:
        raise table.error(str(error)) from None


@lru_cache(maxsize=256)
def _default_name(model: str, name: str | None, xacro_texts: tuple[str, ...]) -> str:
    return load_robot(model, name, parse_xacro_args(xacro_texts))[1]


def _xacro_texts(robot: RobotSection) -> tuple[str, ...]:
    """Xacro arguments as on a command line; truth values of xacro are those of Python in lower case."""
    return tuple(
        f"{name}:={str(value).lower() if isinstance(value, bool) else value}"
        for name, value in robot.xacro_args.items()
    )


def _map_spec(table: Located[MapSection], cell: Cell, first: tuple[str, ...]) -> ProcessSpec:
    place, file = table.section, _map_file(table, "file", table.section.file)
    _check_identity(table, cell)
    name = place.name or place_name(file)
    values: _Values = {
        "name": (name,),
        "frame": _optional(place.frame),
        "writer": _optional(place.writer),
        "wire": place.wires,
    }
    arguments = ("map", file, *_options(values | _session_values(cell, place.identity)))
    return ProcessSpec(
        f"{name}/{place.writer or 'map'}", arguments, (*first, *as_tuple(place.after)), place.restart
    )


def _scan_spec(table: Located[ScanSection], cell: Cell, first: tuple[str, ...]) -> ProcessSpec:
    scan = table.section
    simulate = () if scan.simulate is None else (_map_file(table, "simulate", scan.simulate),)
    _check_identity(table, cell)
    values: _Values = {
        "frame": (scan.frame,),
        "simulate": simulate,
        "map_frame": _optional(scan.map_frame),
        "rate": () if scan.rate is None else (repr(scan.rate),),
        "sensor": _optional(scan.sensor),
        "wire": scan.wires,
        "metrics": () if scan.metrics is None else (str(scan.metrics),),
    }
    arguments = (
        *("scan", scan.robot, *(("--dummy",) if scan.dummy else ())),
        *_options(values | _session_values(cell, scan.identity)),
    )
    name = f"{scan.robot}/{scan.sensor or 'scan'}"
    return ProcessSpec(name, arguments, (*first, *as_tuple(scan.after)), scan.restart)


def _map_file(table: Located[Any], key: str, path: str) -> str:
    file = table.resolve(path)
    if not Path(file).is_file():
        raise table.error(f"there is no file {file!r}", key)
    return file


def _optional(value: str | None) -> tuple[str, ...]:
    return () if value is None else (value,)


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
    _check_identity(table, cell)
    script = next((word for word in command if word.endswith(".py")), command[0])
    default = next(iter(command[1:]), "zstate") if is_zstate else Path(script).stem
    session = _session_values(cell, program.identity).items()
    environment = {f"ZSTATE_{key.upper()}": " ".join(values) for key, values in session if values}
    environment |= {key: str(value) for key, value in program.environment.items()}
    return ProcessSpec(
        program.name or default,
        command[1:] if is_zstate else command,
        (*first, *as_tuple(program.after)),
        program.restart,
        program.ready or "" if is_zstate else program.ready,
        is_program=not is_zstate,
        folder=str(table.file.folder.resolve()),
        environment=environment,
    )


def _check_identity(table: Located[Any], cell: Cell) -> None:
    network = NetworkSection() if cell.network is None else cell.network.section
    identity = table.section.identity
    if network.certs is not None and not (identity or network.identity):
        raise table.error("the certs of [network] need an identity, here or there")
    if identity and network.certs is None:
        raise table.error("needs certs = in [network]", "identity")


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


def _session_values(cell: Cell, identity: str | None = None) -> _Values:
    """The values of [network], with ``identity`` if it is set.

    Without an endpoint or a mode, the processes connect to the router of the file.
    """
    network = NetworkSection() if cell.network is None else cell.network.section
    values: _Values = {}
    for key in ("mode", "config", "certs", "identity", "user", "password_file"):
        if (value := getattr(network, key)) is not None:
            values[key] = (value,)
    if cell.network is not None:
        values |= {key: (cell.network.resolve(values[key][0]),) for key in _NETWORK_PATHS if key in values}
    if identity is not None:
        values["identity"] = (identity,)
    if "certs" not in values:
        values.pop("identity", None)
    values |= {"connect": network.connect, "listen": network.listen}
    has_place = network.mode or network.connect or network.listen or network.config
    if cell.router is not None and not has_place:
        endpoint = _router_endpoints(cell.router.section)[0]
        # A client on this host cannot connect to a wildcard address.
        endpoint = endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")
        values |= {"mode": ("client",), "connect": (endpoint,)}
    return values


def _router_endpoints(router: RouterSection) -> tuple[str, ...]:
    default = ROUTER_ENDPOINT if router.certs is None else ROUTER_ENDPOINT.replace("tcp/", "tls/", 1)
    return router.listen or (default,)


def _options(values: _Values) -> tuple[str, ...]:
    """The values as options of a command."""
    pairs = [(f"--{key.replace('_', '-')}", value) for key in values for value in values[key]]
    return tuple(word for pair in pairs for word in pair)
