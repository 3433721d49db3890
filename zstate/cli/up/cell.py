"""The file of `zstate up`: its tables, expanded, and checked when they are constructed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import fmod, radians
from pathlib import Path

import msgspec

from zstate.cli.up.command_table import CommandTable, Names, ProcessKeys, checked, read_command
from zstate.cli.up.template import Located, expand
from zstate.errors import InvalidInput
from zstate.net.config import endpoint_list
from zstate.transform import Transform
from zstate.wire.registry import get_wire

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class ProgramSection(ProcessKeys, frozen=True):
    """``[[program]]``: any program, or any command line of zstate.

    Without the text ``ready`` a program is ready when it runs, and a command of zstate with its first line or
    its end.
    """

    run: Names = ()
    identity: str | None = None


class StaticSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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


def as_tuple(names: Names) -> tuple[str, ...]:
    """One or several names as a tuple."""
    return (names,) if isinstance(names, str) else names


def _check_wires(wires: tuple[str, ...]) -> None:
    if not wires:
        raise InvalidInput("wires is empty; write for instance ['native', 'ros2']")
    for wire in wires:
        get_wire(wire)


@dataclass(slots=True)
class Cell:
    """The tables of a file and of those it includes; its own router and network take precedence."""

    robot: list[Located[CommandTable]] = field(default_factory=list["Located[CommandTable]"])
    static: list[Located[StaticSection]] = field(default_factory=list["Located[StaticSection]"])
    command: list[Located[CommandTable]] = field(default_factory=list["Located[CommandTable]"])
    program: list[Located[ProgramSection]] = field(default_factory=list["Located[ProgramSection]"])
    router: Located[CommandTable] | None = None
    network: Located[CommandTable] | None = None


def read_cell(path: str, settings: Mapping[str, str]) -> Cell:
    """The file at ``path``, with ``settings`` for its parameters.

    Raises ConfigError with the file, the line, the table and the key.
    """
    cell = Cell()
    for kind, table in expand(Path(path), settings):
        match kind:
            case "router":
                cell.router = _with_endpoints(read_command(kind, table))
            case "network":
                cell.network = _with_endpoints(read_command(kind, table))
            case "robot" | "publish":
                cell.robot.append(read_command(kind, table))
            case "static":
                cell.static.append(checked(kind, table, StaticSection))
            case "program":
                cell.program.append(checked(kind, table, ProgramSection))
            case _:
                cell.command.append(read_command(kind, table))
    return cell


def _with_endpoints(table: Located[CommandTable]) -> Located[CommandTable]:
    words = table.section.words
    try:
        endpoint_list((*words.get("connect", ())[1::2], *words.get("listen", ())[1::2]))
    except InvalidInput as error:
        raise table.error(str(error)) from None
    if "client" in words.get("mode", ()) and not words.keys() & {"connect", "config"}:
        raise table.error("mode 'client' needs connect, for instance ['tcp/192.168.1.10:7447']")
    return table
