"""Snapshot files: the state of robots at one instant as TOML or JSON; how it is captured and published."""

from __future__ import annotations

import json
import shlex
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import msgspec
import tomli_w

from zstate.cli.output.console import count_text, fail, print_result, print_status
from zstate.cli.processes import BackgroundCall
from zstate.cli.session import SessionOptions
from zstate.cli.up.template import TomlFile
from zstate.clock import SystemClock
from zstate.errors import ConfigError, InvalidInput
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.nodes.publisher import STREAMS, StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.rate import Rate
from zstate.transform import Transform
from zstate.wire.keys import check_robot

FORMAT = 1
_HEADING = "# Robots, by `zstate snapshot save`; `zstate snapshot load FILE` publishes them again.\n"

Numbers = dict[str, float | tuple[float, ...]]


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Configuration(_Table, frozen=True):
    """The session options and the version of the command that saved the snapshot."""

    zstate: str
    host: str
    mode: str
    wire: str = "native"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: str | None = None

    @property
    def is_default(self) -> bool:
        """Whether a command without options would join the network in the same way."""
        return not self.options()

    def options(self) -> str:
        """The same configuration as options of a command."""
        has_endpoints = bool(self.connect or self.listen or self.config)
        parts = [
            *(("--mode", self.mode) if self.mode != "peer" or has_endpoints else ()),
            *(part for endpoint in self.connect for part in ("--connect", endpoint)),
            *(part for endpoint in self.listen for part in ("--listen", endpoint)),
            *(("--config", self.config) if self.config else ()),
            *(("--wire", self.wire) if self.wire != "native" else ()),
        ]
        return shlex.join(parts)

    def network(self, options: SessionOptions) -> SessionOptions:
        """The saved session options; those in ``options`` take precedence."""
        # Without endpoints, "peer" is the default of native commands, but not of those on a ROS wire.
        mode = self.mode if self.mode != "peer" or self.connect or self.listen or self.config else None
        return SessionOptions(
            options.mode or mode,
            options.connect or self.connect,
            options.listen or self.listen,
            options.config or self.config,
            options.credentials,
        )


class RobotSnapshot(_Table, frozen=True, kw_only=True):
    """One robot: its model, and its joints by name at ``stamp`` [ns].

    Positions [rad] or [m], velocities per second and efforts [Nm] or [N]; a joint with several numbers has a
    list. Without joint states there is no stamp. ``writers`` are its publishers, as text.
    """

    name: str
    writers: tuple[str, ...] = ()
    stamp: int | None = None
    urdf: str
    positions: Numbers = {}
    velocities: Numbers = {}
    efforts: Numbers = {}

    def __post_init__(self) -> None:
        check_robot(self.name)

    def model(self) -> RobotModel:
        """Parse the URDF. Raises ModelError."""
        return parse_urdf(self.urdf, f"the URDF of {self.name!r}")


class StaticTransformSnapshot(_Table, frozen=True):
    """One static edge that ``writer`` published for ``robot``."""

    robot: str
    writer: str
    target: str
    source: str
    xyz: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]

    def __post_init__(self) -> None:
        check_robot(self.robot)
        self.transform()

    def transform(self) -> Transform:
        return Transform(self.target, self.source, self.xyz, self.quat_xyzw)


class Snapshot(_Table, frozen=True):
    """A whole snapshot; ``saved`` is its time (RFC 3339)."""

    format: int
    saved: str
    configuration: Configuration
    robot: tuple[RobotSnapshot, ...] = ()
    static: tuple[StaticTransformSnapshot, ...] = ()

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise InvalidInput(
                f"its format is {self.format}, and this zstate reads {FORMAT}; update one of them"
            )

    def select(self, robots: Sequence[str]) -> tuple[list[RobotSnapshot], list[StaticTransformSnapshot]]:
        """The content of the named robots, or of all. Fails if one is not in the snapshot."""
        known = {robot.name for robot in self.robot} | {edge.robot for edge in self.static}
        for name in robots:
            if name not in known:
                fail(f"the snapshot has no robot {name!r}; it has {', '.join(sorted(known)) or 'none'}")
        selected = set(robots) or known
        return (
            [robot for robot in self.robot if robot.name in selected],
            [edge for edge in self.static if edge.robot in selected],
        )

    def as_json(self) -> str:
        return json.dumps(_without_empty(msgspec.to_builtins(self)), indent=2) + "\n"

    def as_toml(self) -> str:
        """The text of a TOML file, the URDF in its own lines."""
        # In a multi-line string a carriage return would become a line feed.
        multiline = not any("\r" in robot.urdf for robot in self.robot)
        tables = _without_empty(msgspec.to_builtins(self))
        return f"{_HEADING}{tomli_w.dumps(tables, multiline_strings=multiline)}"


def _without_empty(value: Any) -> Any:
    """``value`` without None, which TOML lacks, and without empty lists and tables."""
    if isinstance(value, dict):
        table = {key: _without_empty(inner) for key, inner in cast("dict[str, Any]", value).items()}
        return {key: inner for key, inner in table.items() if inner not in (None, [], {})}
    if isinstance(value, list | tuple):
        return [_without_empty(inner) for inner in cast("list[Any]", value)]
    return value


def read_snapshot(path: Path) -> Snapshot:
    """The snapshot in a TOML or JSON file. Raises ConfigError with the file and the position in it."""
    file = None if path.suffix == ".json" else TomlFile(path)
    try:
        document = json.loads(path.read_bytes()) if file is None else file.tables
        return msgspec.convert(document, Snapshot)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$")
        place = place.strip("`.")
        if file is not None:
            raise file.error(place, text) from None
        raise ConfigError(f"{path}: {place}{': ' * bool(place)}{text}", path=place) from None
    except OSError as error:
        raise ConfigError(f"{str(path)!r} cannot be read: {error.strerror}", path=str(path)) from None
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON: {error}", path=str(path)) from None
    except RecursionError:
        text = f"{path} cannot be read: its brackets are nested too deeply"
        raise ConfigError(text, path=str(path)) from None


def publish_snapshot(
    session: Session,
    robots: Sequence[RobotSnapshot],
    edges: Sequence[StaticTransformSnapshot],
    wires: Sequence[str],
    *,
    takeover: bool,
    rate_hz: float,
    seconds: float | None,
) -> None:
    """Publish ``robots`` and ``edges`` for ``seconds``, or until a signal; joint states at ``rate_hz``."""
    stop = threading.Event()
    publishers: list[tuple[StatePublisher, RobotSnapshot]] = []

    def publish() -> None:
        for now in Rate(rate_hz, SystemClock(), stop, seconds):
            for publisher, robot in publishers:
                publisher.publish(robot.positions, stamp=now)

    with ExitStack() as opened:
        for robot in robots:
            # A robot saved without joint states is only described.
            streams = STREAMS if robot.positions else ("robot_description", "tf_static")
            publisher = opened.enter_context(
                StatePublisher(session, robot.model(), robot.name, wires, streams=streams, takeover=takeover)
            )
            joints = count_text(len(robot.positions), "joint")
            state = f"{joints} standing still" if robot.positions else "no joint states"
            print_result(f"{robot.name}: its model, {state}; until Ctrl-C")
            if robot.positions:
                publishers.append((publisher, robot))
            else:
                print_status(f"{robot.name}: the snapshot has no joint states for it", robot=robot.name)
        for name, writer in dict.fromkeys((edge.robot, edge.writer) for edge in edges):
            written = [edge for edge in edges if (edge.robot, edge.writer) == (name, writer)]
            static = opened.enter_context(StaticPublisher(session, name, writer, wires, takeover=takeover))
            for edge in written:
                static.set(edge.transform())
            print_result(f"{name}: {count_text(len(written), 'static edge')} of {writer}")
        # A signal interrupts only this thread, which waits, so that the loop ends in order.
        call = BackgroundCall("zstate snapshot", publish)
        try:
            call.result()
        except SystemExit:
            stop.set()
            call.result(1.0)
            raise
