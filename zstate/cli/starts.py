"""From the file of `zstate up` to the command lines it stands for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zstate.buffer.buffer import TransformBuffer
from zstate.cli.config_file import ConfigFile, NetworkSection, RobotSection, RouterSection
from zstate.cli.options import load_robot
from zstate.errors import ConfigError, InvalidInput, ModelError
from zstate.model.catalog import is_path
from zstate.transform import Transform
from zstate.wire.keys import check_robot, full_name


@dataclass(frozen=True, slots=True)
class Start:
    """One command to start, and what its lines are called."""

    name: str
    arguments: tuple[str, ...]


def planned(config: ConfigFile, file: Path) -> list[Start]:
    """What to start, in this order. Raises ConfigError for what no command would accept."""
    network = _network_arguments(config)
    starts = [] if config.router is None else [Start("router", _router_arguments(config.router))]
    names: list[str] = []
    for place, robot in ((f"robot[{number}]", robot) for number, robot in enumerate(config.robot)):
        model, name = _checked(robot, place, file)
        if name in names:
            raise ConfigError(
                f"{file}: {place}: robot[{names.index(name)}] is called {name!r} already; give it a name",
                path=place,
            )
        names.append(name)
        rate = () if robot.rate is None else ("--rate", repr(robot.rate))
        options = ("--name", name, "--source", robot.source, *rate, *_repeated("--wire", robot.wires))
        starts.append(Start(name, ("publish", model, *options, *network)))
    if config.static:
        options = _static_options(config, names, file)
        starts.append(Start("static", ("static", "--file", str(file), *options, *network)))
    if not starts:
        raise ConfigError(f"{file} starts nothing; it has no [router], [[robot]] or [[static]]")
    return starts


def _checked(robot: RobotSection, place: str, file: Path) -> tuple[str, str]:
    """The model as a child will find it, and the robot's name."""
    # Beside the file, wherever `zstate up` is called.
    model = str(file.parent.resolve() / robot.model) if is_path(robot.model) else robot.model
    try:
        return model, load_robot(model, robot.name)[1]
    except (ModelError, InvalidInput) as error:
        raise ConfigError(f"{file}: {place}: {error}", path=place) from None


def _static_options(config: ConfigFile, names: list[str], file: Path) -> tuple[str, ...]:
    known = ", ".join(map(repr, names)) or "none"
    default = names[0] if len(names) == 1 else None
    check = TransformBuffer()
    for number, static in enumerate(config.static):
        place = f"static[{number}]"
        owner = static.owner or default
        if owner is None:
            raise ConfigError(
                f"{file}: {place}: whose edge is this? Add robot = (in this file: {known})", path=place
            )
        try:
            check.insert_static(_in_full(check_robot(owner), static.transform()))
        except InvalidInput as error:
            raise ConfigError(f"{file}: {place}: {error}", path=place) from None
    return () if default is None else ("--robot", default)


def _in_full(robot: str, edge: Transform) -> Transform:
    return Transform(
        full_name(robot, edge.target), full_name(robot, edge.source), edge.translation, edge.rotation
    )


def _router_arguments(router: RouterSection) -> tuple[str, ...]:
    ros2 = ("--ros2",) if router.ros2 else ()
    return ("router", *ros2, *_repeated("--listen", router.listen), *_repeated("--connect", router.connect))


def _network_arguments(config: ConfigFile) -> tuple[str, ...]:
    network = config.network
    if network is None and config.router is not None:
        network = NetworkSection("client", (_reachable(config.router.listen[0]),))
    if network is None:
        return ()
    endpoints = (*_repeated("--connect", network.connect), *_repeated("--listen", network.listen))
    return ("--mode", network.mode, *endpoints)


def _reachable(endpoint: str) -> str:
    """Where somebody on this host reaches what listens on all addresses."""
    return endpoint.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:")


def _repeated(option: str, values: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(part for value in values for part in (option, value))
