"""The file that `zstate up` starts things from, checked once: what is in it, and where it is wrong."""

from __future__ import annotations

import re
from difflib import get_close_matches
from math import radians
from pathlib import Path
from typing import Literal

import msgspec

from zstate.errors import ConfigError, InvalidInput
from zstate.net.config import ROUTER_ENDPOINT, endpoint_list
from zstate.net.wires import wire_named
from zstate.rate import check_rate
from zstate.transform import Transform

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class _Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class RouterSection(_Section, frozen=True):
    """``[router]``: as the options of `zstate router`."""

    listen: tuple[str, ...] = (ROUTER_ENDPOINT,)
    connect: tuple[str, ...] = ()
    ros2: bool = False

    def __post_init__(self) -> None:
        endpoint_list(self.connect)
        if not endpoint_list(self.listen):
            raise InvalidInput(f"a router listens somewhere, for instance at {ROUTER_ENDPOINT!r}")


class NetworkSection(_Section, frozen=True):
    """``[network]``: the session options of everything that is started."""

    mode: Literal["peer", "client"] = "peer"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        endpoint_list((*self.connect, *self.listen))
        if self.mode == "client" and not self.connect:
            raise InvalidInput("mode 'client' needs connect, for instance ['tcp/192.168.1.10:7447']")


class RobotSection(_Section, frozen=True):
    """``[[robot]]``: as the options of `zstate publish`."""

    model: str
    name: str | None = None
    source: Literal["joints", "sine"] = "joints"
    rate: float | None = None
    wires: tuple[str, ...] = ("native",)

    def __post_init__(self) -> None:
        if self.rate is not None:
            check_rate(self.rate)
        if not self.wires:
            raise InvalidInput("wires is empty; write for instance ['native', 'ros2']")
        for wire in self.wires:
            wire_named(wire)


class StaticSection(_Section, frozen=True):
    """``[[static]]``: as the arguments of `zstate static`; ``xyz``, one of the three rotations, or both."""

    target: str
    source: str
    xyz: Vector3 | None = None
    rpy_deg: Vector3 | None = None
    rpy: Vector3 | None = None
    quat_xyzw: Quaternion | None = None
    robot: str | None = None

    def __post_init__(self) -> None:
        self.transform()

    def transform(self) -> Transform:
        """The edge. Raises InvalidInput for several rotations, for neither one nor xyz, and for no pose."""
        rotations = 3 - (self.rpy_deg, self.rpy, self.quat_xyzw).count(None)
        if rotations > 1 or (rotations == 0 and self.xyz is None):
            raise InvalidInput(
                f"the pose of {self.source!r} in {self.target!r} has {rotations} rotations"
                f"{'' if rotations else ' and no xyz'}; give xyz, one of rpy_deg, rpy and quat_xyzw, or both"
            )
        xyz = self.xyz or (0.0, 0.0, 0.0)
        if self.quat_xyzw is not None:
            return Transform(self.target, self.source, xyz, self.quat_xyzw)
        return Transform.from_rpy(self.target, self.source, xyz, self._angles())

    @property
    def owner(self) -> str | None:
        """Whose edge it is: ``robot``, or the robot of a frame that is named in full; None if unsaid."""
        named = (frame.partition("/")[0] for frame in (self.source, self.target) if "/" in frame)
        return self.robot or next(named, None)

    def _angles(self) -> Vector3:
        if self.rpy is not None:
            return self.rpy
        roll, pitch, yaw = self.rpy_deg or (0.0, 0.0, 0.0)
        return radians(roll), radians(pitch), radians(yaw)


class ConfigFile(_Section, frozen=True):
    """The whole file."""

    network: NetworkSection | None = None
    router: RouterSection | None = None
    robot: tuple[RobotSection, ...] = ()
    static: tuple[StaticSection, ...] = ()


def read_config(path: str) -> ConfigFile:
    """The file at ``path``. Raises ConfigError naming the file and the place in it."""
    try:
        return msgspec.toml.decode(Path(path).read_bytes(), type=ConfigFile)
    except OSError as error:
        raise ConfigError(f"{path!r} cannot be read: {error.strerror}", path=path) from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path!r} is not UTF-8 text: {error.reason}", path=path) from None
    except msgspec.DecodeError as error:
        text, _, place = str(error).partition(" - at `$")
        place = place.strip("`").lstrip(".")
        raise ConfigError(f"{path}: {place}{': ' * bool(place)}{text}{_hint(text)}", path=place) from None


def _hint(text: str) -> str:
    unknown = re.search(r"unknown field `(.*)`", text)
    if unknown is None:
        return ""
    sections = (ConfigFile, NetworkSection, RouterSection, RobotSection, StaticSection)
    known = sorted({field for section in sections for field in section.__struct_fields__})
    near = get_close_matches(unknown[1], known, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
