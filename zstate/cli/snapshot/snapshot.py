"""Snapshot: robots as they were at one time, in a form that TOML and JSON can hold."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import msgspec

from zstate.cli.network import Network
from zstate.cli.up.toml_file import TomlFile
from zstate.errors import ConfigError, InvalidInput
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.transform import Transform
from zstate.wire.keys import check_robot

FORMAT = 1

Numbers = dict[str, float | tuple[float, ...]]


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Configuration(_Part, frozen=True):
    """How the command that took it was on the network, and by which version."""

    zstate: str
    host: str
    mode: str
    wire: str = "native"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: str | None = None

    @property
    def is_plain(self) -> bool:
        """Whether a command without any option would be on the network just so."""
        return not self._names_places and self.mode == "peer" and self.wire == "native"

    @property
    def _names_places(self) -> bool:
        return bool(self.connect or self.listen or self.config)

    def options(self) -> str:
        """What to say to a command for the same."""
        said = [
            *(("--mode", self.mode) if self.mode != "peer" or self._names_places else ()),
            *(word for endpoint in self.connect for word in ("--connect", endpoint)),
            *(word for endpoint in self.listen for word in ("--listen", endpoint)),
            *(("--config", self.config) if self.config else ()),
            *(("--wire", self.wire) if self.wire != "native" else ()),
        ]
        return shlex.join(said)

    def network(self, said: Network) -> Network:
        """The same way to join the network; what is ``said`` now comes first."""
        # Whoever named no place at all was wherever commands of that wire are by themselves.
        mode = self.mode if self.mode != "peer" or self._names_places else None
        return Network(
            said.mode or mode,
            said.connect or self.connect,
            said.listen or self.listen,
            said.config or self.config,
            said.credentials,
        )


class RobotShot(_Part, frozen=True, kw_only=True):
    """One robot: its model, and where its joints were at ``stamp`` [ns], by their names.

    Positions [rad] or [m], velocities per second and efforts [Nm] or [N]; a joint with several numbers has
    their list. Without joint states there is no stamp. ``writers`` are who wrote for it, in words.
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
        """Raises ModelError."""
        return parse_urdf(self.urdf, f"the URDF of {self.name!r}")


class StaticShot(_Part, frozen=True):
    """One static edge that ``writer`` placed in ``robot``."""

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
        """The edge."""
        return Transform(self.target, self.source, self.xyz, self.quat_xyzw)


class Snapshot(_Part, frozen=True):
    """All of it; ``saved`` is when, as RFC 3339 has it."""

    format: int
    saved: str
    configuration: Configuration
    robot: tuple[RobotShot, ...] = ()
    static: tuple[StaticShot, ...] = ()

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise InvalidInput(
                f"its format is {self.format}, and this zstate reads {FORMAT}; update one of them"
            )


def read_snapshot(path: Path) -> Snapshot:
    """The snapshot in a TOML or JSON file. Raises ConfigError naming the file and the place in it."""
    file = None if path.suffix == ".json" else TomlFile(path)
    document = _json_document(path) if file is None else file.tables
    try:
        return msgspec.convert(document, Snapshot)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$")
        place = place.strip("`.")
        if file is not None:
            raise file.error(place, text) from None
        raise ConfigError(f"{path}: {place}{': ' * bool(place)}{text}", path=place) from None


def _json_document(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"{str(path)!r} cannot be read: {error.strerror}", path=str(path)) from None
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON: {error}", path=str(path)) from None
