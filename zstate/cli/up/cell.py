"""The file of `zstate up`: its tables, expanded, and checked when they are constructed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import fmod, radians
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from zstate._util.format import did_you_mean
from zstate.cli.up.template import LOOP_KEYS, LOOPS, Located, expand
from zstate.errors import InvalidInput
from zstate.net.config import endpoint_list
from zstate.rate import check_rate
from zstate.transform import Transform
from zstate.wire.registry import get_wire

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Restart = Literal["never", "on-failure", "always"]
Names = str | tuple[str, ...]


class _Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class _SessionSection(_Section, frozen=True):
    """The keys that a router has like any other process."""

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    certs: str | None = None
    identity: str | None = None
    user: str | None = None
    password_file: str | None = None

    def __post_init__(self) -> None:
        endpoint_list((*self.connect, *self.listen))


class RouterSection(_SessionSection, frozen=True):
    """``[router]``: the options of `zstate router`."""

    ros2: bool = False
    acl: str | None = None
    users: str | None = None
    metrics: str | int | None = None
    restart: Restart = "never"

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_metrics(self.metrics)


class NetworkSection(_SessionSection, frozen=True):
    """``[network]``: the session options of every process."""

    mode: Literal["peer", "loopback", "lan", "client", "router"] | None = None
    config: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mode == "client" and not self.connect and not self.config:
            raise InvalidInput("mode 'client' needs connect, for instance ['tcp/192.168.1.10:7447']")


class RobotSection(_Section, frozen=True):
    """``[[robot]]``: the options of `zstate publish`."""

    model: str
    xacro_args: dict[str, str | bool | int | float] = {}
    name: str | None = None
    source: str = "joints"
    rate: float | None = None
    wires: tuple[str, ...] = ("native",)
    clock: Literal["system", "sim"] = "system"
    takeover: bool = False
    metrics: str | int | None = None
    identity: str | None = None
    after: Names = ()
    restart: Restart = "never"

    def __post_init__(self) -> None:
        if self.rate is not None:
            check_rate(self.rate)
        _check_wires(self.wires)
        _check_metrics(self.metrics)


class ProgramSection(_Section, frozen=True):
    """``[[program]]``: any program, or any other command of zstate.

    It is ready once it prints a line with the text ``ready``. Without that text a program is ready when it
    runs, and a command of zstate with its first line or its end.
    """

    run: Names
    name: str | None = None
    ready: str | None = None
    environment: dict[str, str | int | float] = {}
    identity: str | None = None
    after: Names = ()
    restart: Restart = "never"


class StaticSection(_Section, frozen=True):
    """``[[static]]``: the arguments of `zstate static`: a pose, or the ``file`` of a calibration.

    ``robot`` is the robot of the edge, a pattern such as "arm*", or a list. ``wires`` default to those of
    the command.
    """

    target: str | None = None
    source: str | None = None
    xyz: Vector3 | None = None
    rpy_deg: Vector3 | None = None
    rpy: Vector3 | None = None
    quat_xyzw: Quaternion | None = None
    file: str | None = None
    robot: Names = ()
    wires: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.wires is not None:
            _check_wires(self.wires)
        if self.file is None:
            self.transform()
            return
        parts = ("xyz", "rpy_deg", "rpy", "quat_xyzw")
        if surplus := [name for name in parts if getattr(self, name) is not None]:
            raise InvalidInput(f"the pose is in {self.file!r}; leave out {', '.join(surplus)}")

    def transform(self) -> Transform:
        """The edge of the table. Raises InvalidInput unless it has xyz, one rotation, or both."""
        if self.target is None or self.source is None:
            raise InvalidInput("an edge places source in target; write both, for instance target = 'tool'")
        rotations = 3 - (self.rpy_deg, self.rpy, self.quat_xyzw).count(None)
        if rotations > 1 or (rotations == 0 and self.xyz is None):
            raise InvalidInput(
                f"the pose of {self.source!r} in {self.target!r} has {rotations} rotations"
                f"{'' if rotations else ' and no xyz'}; give xyz, one of rpy_deg, rpy and quat_xyzw, or both"
            )
        xyz = self.xyz or (0.0, 0.0, 0.0)
        if self.quat_xyzw is not None:
            return Transform(self.target, self.source, xyz, self.quat_xyzw)
        # Multiples of 360 degrees are removed: in radians they would be refused.
        rpy = self.rpy or [radians(fmod(angle, 360.0)) for angle in self.rpy_deg or (0.0, 0.0, 0.0)]
        try:
            return Transform.from_rpy(self.target, self.source, xyz, rpy)
        except InvalidInput as error:
            angles = " ".join(f"{angle:g}" for angle in self.rpy or ())
            degrees = f"; to give degrees use --rpy-deg {angles} (in a file: rpy_deg)" if angles else ""
            raise InvalidInput(f"{error}{degrees}") from None


class MapSection(_Section, frozen=True):
    """``[[map]]``: the arguments of `zstate map`.

    The process is called ``NAME/WRITER``, such as "hall/map".
    """

    file: str
    name: str | None = None
    frame: str | None = None
    writer: str | None = None
    wires: tuple[str, ...] = ("native",)
    identity: str | None = None
    after: Names = ()
    restart: Restart = "never"

    def __post_init__(self) -> None:
        _check_wires(self.wires)


class ScanSection(_Section, frozen=True):
    """``[[scan]]``: the arguments of `zstate scan`: ``simulate``, the file of a map, or ``dummy``.

    The process is called ``ROBOT/SENSOR``, such as "r1/scan".
    """

    robot: str
    frame: str
    simulate: str | None = None
    dummy: bool = False
    map_frame: str | None = None
    rate: float | None = None
    sensor: str | None = None
    wires: tuple[str, ...] = ("native",)
    metrics: str | int | None = None
    identity: str | None = None
    after: Names = ()
    restart: Restart = "never"

    def __post_init__(self) -> None:
        if self.dummy is (self.simulate is not None):
            raise InvalidInput("give simulate = 'MAP.yaml' or dummy = true, one of them")
        if self.rate is not None:
            check_rate(self.rate)
        _check_wires(self.wires)
        _check_metrics(self.metrics)


def as_tuple(names: Names) -> tuple[str, ...]:
    """One or several names as a tuple."""
    return (names,) if isinstance(names, str) else names


def _check_wires(wires: tuple[str, ...]) -> None:
    if not wires:
        raise InvalidInput("wires is empty; write for instance ['native', 'ros2']")
    for wire in wires:
        get_wire(wire)


def _check_metrics(metrics: str | int | None) -> None:
    if metrics is not None:
        from zstate.metrics.endpoint import BindAddress  # loads an HTTP server

        BindAddress.parse(str(metrics))


_Table = TypeVar("_Table", bound=_Section)


@dataclass(slots=True)
class Cell:
    """The tables of a file and of those it includes; its own router and network take precedence."""

    robot: list[Located[RobotSection]] = field(default_factory=list["Located[RobotSection]"])
    static: list[Located[StaticSection]] = field(default_factory=list["Located[StaticSection]"])
    map: list[Located[MapSection]] = field(default_factory=list["Located[MapSection]"])
    scan: list[Located[ScanSection]] = field(default_factory=list["Located[ScanSection]"])
    program: list[Located[ProgramSection]] = field(default_factory=list["Located[ProgramSection]"])
    router: Located[RouterSection] | None = None
    network: Located[NetworkSection] | None = None


def read_cell(path: str, settings: Mapping[str, str]) -> Cell:
    """The file at ``path``, with ``settings`` for its parameters.

    Raises ConfigError with the file, the line, the table and the key.
    """
    cell = Cell()
    for kind, table in expand(Path(path), settings):
        match kind:
            case "router":
                cell.router = _checked(kind, table, RouterSection)
            case "network":
                cell.network = _checked(kind, table, NetworkSection)
            case "robot":
                cell.robot.append(_checked(kind, table, RobotSection))
            case "static":
                cell.static.append(_checked(kind, table, StaticSection))
            case "map":
                cell.map.append(_checked(kind, table, MapSection))
            case "scan":
                cell.scan.append(_checked(kind, table, ScanSection))
            case _:
                cell.program.append(_checked(kind, table, ProgramSection))
    return cell


def _checked(kind: str, table: Located[dict[str, Any]], section: type[_Table]) -> Located[_Table]:
    try:
        # Not strict: values from the environment and the command line are text.
        values = msgspec.convert(table.section, section, strict=False)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$")
        unknown = re.search(r"unknown field `(.*)`", text)
        if unknown is None:
            raise table.file.error(f"{table.place}{place.strip('`')}", text) from None
        valid = (*section.__struct_fields__, *(LOOP_KEYS if kind in LOOPS else ("when",)))
        hint = did_you_mean(unknown[1], valid) or f"; there are {', '.join(valid)}"
        raise table.error(f"there is no such key{hint}", unknown[1]) from None
    return Located(values, table.file, table.place, table.iteration)
