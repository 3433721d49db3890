"""Snapshot files: the state of robots at one instant as TOML or JSON; how it is captured and published."""

from __future__ import annotations

import json
import shlex
import socket
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, cast

import msgspec
import tomli_w

from zstate import __version__
from zstate._util.closeable import Closeable
from zstate.cli.output.console import count_text, fail, print_result, print_status
from zstate.cli.output.wire_text import messages_for
from zstate.cli.processes import BackgroundCall
from zstate.cli.session import SessionOptions
from zstate.cli.up.toml_file import TomlFile
from zstate.cli.waiting import ConditionWaiter
from zstate.clock import SystemClock
from zstate.errors import ConfigError, InvalidInput, MessageError
from zstate.model.robot import POSITION_COUNTS, VELOCITY_COUNTS, JointType, RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import RobotInfo, discover
from zstate.net.session import Session
from zstate.nodes.publisher import STREAMS, StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.rate import Rate
from zstate.sources import JointReading, JointStateListener
from zstate.sources.joint_state_listener import DescriptionSubscriber
from zstate.transform import Transform
from zstate.wire.keys import MODEL_WRITER, check_robot
from zstate.wire.messages import StaticTransforms, poses_from_block
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire

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


def capture(
    session: Session, network: SessionOptions, robots: Sequence[str], wire: str, timeout_s: float
) -> Snapshot:
    """Capture the named robots, or all announced ones, as soon as everything announced has arrived.

    Fails if a robot is not announced; logs what does not arrive within ``timeout_s``.
    """
    messages = messages_for(wire)
    announced = discover(session, wire=wire)
    selected = [info for info in announced if info.name in robots or not robots]
    for name in robots:
        if name not in [info.name for info in selected]:
            fail(messages.unknown(name, announced))
    if not selected:
        fail(messages.announced(announced))
    with ExitStack() as opened:
        waiter = ConditionWaiter()
        captures = [opened.enter_context(_RobotCapture(session, info, wire, waiter)) for info in selected]
        waiter.wait_for(lambda: not any(one.missing() for one in captures), timeout_s)
        for one in captures:
            for text in one.missing():
                print_status(f"{one.info.name}: {text} within {timeout_s:g} s", robot=one.info.name)
        saved = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        config = network.config if isinstance(network.config, str) else None
        endpoints = (network.connect, network.listen, config)
        return Snapshot(
            FORMAT,
            saved,
            Configuration(__version__, socket.gethostname(), network.joins_as, wire, *endpoints),
            tuple(robot for one in captures if (robot := one.robot()) is not None),
            tuple(edge for one in captures for edge in one.static_edges()),
        )


class _RobotCapture(Closeable):
    """Collects the model, the newest joint state and the static edges of one robot."""

    def __init__(self, session: Session, info: RobotInfo, wire: str, waiter: ConditionWaiter) -> None:
        self.info = info
        self._session, self._waiter = session, waiter
        self._wire_name, self._wire = wire, get_wire(wire)
        self._model: RobotModel | None = None
        self._source: JointStateListener | None = None
        self._reading: JointReading | None = None
        self._statics: dict[str, StaticTransforms] = {}
        self._opened = ExitStack()
        self._opened.enter_context(DescriptionSubscriber(session, info.name, self._on_model, wire))
        key = self._wire.expression(info.name, "tf_static")
        self._opened.enter_context(LatchedSubscriber(session, key, self._on_statics))

    def close(self) -> None:
        self._opened.close()
        if self._source is not None:
            self._source.close()

    def _on_model(self, _: str, model: RobotModel) -> None:
        if self._source is not None:
            self._source.close()
        self._model = model
        self._source = JointStateListener(
            self._session,
            self.info.name,
            model,
            wire=self._wire_name,
            on_reading=lambda _: self._waiter.notify(),
        )
        self._waiter.notify()

    def _on_statics(self, arrival: SerializedSample) -> None:
        try:
            writer = self._wire.edge_writer_name(arrival.key) or arrival.key
            if not arrival.payload or writer == MODEL_WRITER:
                self._statics.pop(writer, None)  # the model has the same edges
            else:
                for message in self._wire.decode("tf_static", arrival, self.info.name):
                    if isinstance(message, StaticTransforms):
                        name = f"{writer}.{message.session:08x}" if self._wire.shared else writer
                        self._statics[name] = message
        except (InvalidInput, MessageError) as error:
            print_status(f"{arrival.key}: {error}")
        self._waiter.notify()

    def missing(self) -> list[str]:
        streams = {stream for stream, _ in self.info.writers}
        if self._source is not None:
            self._reading = self._source.read(0) or self._reading
        static_names = {name for name, _ in self.info.static_names} - {MODEL_WRITER}
        conditions = {
            "its model has not arrived": "robot_description" in streams and self._model is None,
            "no joint states have arrived": "joint_states" in streams and self._reading is None,
            "not all of its static edges have arrived": bool(static_names - self._statics.keys()),
        }
        return [text for text, is_missing in conditions.items() if is_missing]

    def robot(self) -> RobotSnapshot | None:
        model, reading = self._model, self._reading
        if model is None:
            return None
        writers = tuple(sorted(f"{stream}: {writer}" for stream, writer in self.info.writers))
        snapshot = RobotSnapshot(name=self.info.name, urdf=model.urdf, writers=writers)
        if reading is None:
            return snapshot
        return msgspec.structs.replace(
            snapshot,
            stamp=reading.stamp,
            positions=_by_joint(model, reading.positions, POSITION_COUNTS),
            velocities=_by_joint(model, reading.velocities, VELOCITY_COUNTS),
            efforts=_by_joint(model, reading.efforts, VELOCITY_COUNTS),
        )

    def static_edges(self) -> list[StaticTransformSnapshot]:
        """The static edges that are not in the model."""
        links = set[str]() if self._model is None else set(self._model.links)
        return [
            StaticTransformSnapshot(
                self.info.name,
                writer,
                target,
                source,
                cast("tuple[float, float, float]", tuple(pose[:3].tolist())),
                cast("tuple[float, float, float, float]", tuple(pose[3:].tolist())),
            )
            for writer, message in sorted(self._statics.items())
            for (target, source), pose in zip(message.edges, poses_from_block(message.poses), strict=True)
            if source not in links
        ]


def _by_joint(model: RobotModel, numbers: Any, counts: Mapping[JointType, int]) -> Numbers:
    named: Numbers = {}
    if numbers is not None:
        rest = [float(number) for number in numbers]
        for joint in model.driven_joints:
            values, rest = rest[: counts[joint.type]], rest[counts[joint.type] :]
            named[joint.name] = values[0] if len(values) == 1 else tuple(values)
    return named


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
