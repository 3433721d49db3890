"""What the odometry of one robot is computed from, and the TOML file that holds it: one setting for all runs.

Its keys are those of OdometrySettings, with the keywords of ImuNoise in ``[imu_noise]``, of DiffDrive,
Ackermann or Mecanum in ``[diff_drive]``, ``[ackermann]`` or ``[mecanum]``, of WheelNoise in their ``noise``,
and of LegSettings in ``[legs]``. models/rover.toml is an example.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar, cast

from zstate._util.format import did_you_mean
from zstate.buffer.buffer import TransformBuffer
from zstate.cli.up.template import TomlFile
from zstate.errors import InvalidInput
from zstate.model.robot import RobotModel
from zstate.odometry import (
    Ackermann,
    BaseEstimator,
    DiffDrive,
    ForceThresholds,
    ImuNoise,
    LegNoise,
    Legs,
    Mecanum,
    SpeedThresholds,
    WheelNoise,
    Wheels,
)
from zstate.wire.keys import check_writer, full_name

MEMS_NOISE = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
"""That of an inexpensive IMU, for robots without another setting."""

DEFAULT_SPEEDS = SpeedThresholds(touchdown=0.1, liftoff=0.2)
"""Those of the feet of walking robots without another setting."""

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class LegSettings:
    """The keywords of Legs. Contacts of ``feet`` are detected by ``force`` or, by default, by ``speed``.

    Speeds need joint states with velocities, forces those with efforts. Raises InvalidInput for both.
    """

    feet: tuple[str, ...]
    noise: LegNoise | None = None
    force: ForceThresholds | None = None
    speed: SpeedThresholds | None = None

    def __post_init__(self) -> None:
        if self.force is not None and self.speed is not None:
            raise InvalidInput("contacts of feet are detected by force or by speed; give one of them")

    def legs(self, model: RobotModel, imu: str) -> Legs:
        """The legs of ``model``, with its IMU on the link ``imu``. Raises InvalidInput as Legs."""
        detection = self.force or self.speed or DEFAULT_SPEEDS
        return Legs(model, self.feet, imu=imu, noise=self.noise, detection=detection)


_PARTS: Mapping[str, type[Any]] = {
    "imu_noise": ImuNoise,
    "diff_drive": DiffDrive,
    "ackermann": Ackermann,
    "mecanum": Mecanum,
    "legs": LegSettings,
}
_WHEELS = ("diff_drive", "ackermann", "mecanum")


@dataclass(frozen=True, kw_only=True)
class OdometrySettings:
    """The sensors, frames and noise of one robot; ``base`` None is the root of its model.

    Raises InvalidInput for names that no sensor can have, and for wheels of several kinds.
    """

    imu: str = "imu"
    velocities: tuple[str, ...] = ()
    poses: tuple[str, ...] = ()
    odom: str = "odom"
    base: str | None = None
    history_s: float = 1.0
    imu_noise: ImuNoise = MEMS_NOISE
    wheels: Wheels | None = None
    legs: LegSettings | None = None

    def __post_init__(self) -> None:
        for sensor in (self.imu, *self.velocities, *self.poses):
            check_writer(sensor)

    @property
    def has_joints(self) -> bool:
        """Whether it needs joint states."""
        return self.wheels is not None or self.legs is not None

    def estimator(
        self, robot: str, base: str, imu_frame: str, buffer: TransformBuffer, model: RobotModel | None
    ) -> BaseEstimator:
        """The estimator of ``robot``; legs need its ``model``.

        Raises InvalidInput, and LookupFailed for unknown mounts.
        """
        legs = None
        if self.legs is not None:
            if model is None:
                raise InvalidInput(f"legs need the model of {robot!r}, and there is none")
            legs = self.legs.legs(model, imu_frame.removeprefix(f"{robot}/"))
        return BaseEstimator(
            odom=full_name(robot, self.odom),
            base=full_name(robot, base),
            imu=full_name(robot, imu_frame),
            buffer=buffer,
            imu_noise=self.imu_noise,
            history_s=self.history_s,
            wheels=self.wheels,
            legs=legs,
        )


def read_settings(path: str) -> OdometrySettings:
    """The settings in a TOML file. Raises ConfigError, with the line, for unknown and unusable keys."""
    file = TomlFile(Path(path))
    values: dict[str, Any] = {}
    for key, value in file.tables.items():
        if key in _PARTS:
            part = _built(_PARTS[key], value, file, key)
            kind = "wheels" if key in _WHEELS else key
            if kind in values:
                raise file.error(key, "a robot has wheels of one kind")
            values[kind] = part
        else:
            values[key] = value
    return _built(OdometrySettings, values, file, "")


def _built(kind: type[T], table: object, file: TomlFile, place: str) -> T:
    """``kind(**table)``, with errors at ``place``."""
    if not isinstance(table, dict):
        raise file.error(place, f"a table of keys and values is needed, not {table!r}")
    lists = cast("dict[str, Any]", table)
    values: dict[str, Any] = {
        key: tuple(cast("list[Any]", value)) if isinstance(value, list) else value
        for key, value in lists.items()
    }
    known = {one.name: one for one in fields(cast("Any", kind))}
    for key in values:
        if key not in known:
            raise file.error(f"{place}.{key}" if place else key, f"unknown key{did_you_mean(key, known)}")
    required = [
        name for name, one in known.items() if one.default is MISSING and one.default_factory is MISSING
    ]
    if missing := [name for name in required if name not in values]:
        raise file.error(place, f"{', '.join(missing)} missing")
    inner: dict[str, type[Any]] = {
        "noise": LegNoise if kind is LegSettings else WheelNoise,
        "force": ForceThresholds,
        "speed": SpeedThresholds,
    }
    for key in inner.keys() & values.keys():
        values[key] = _built(inner[key], values[key], file, f"{place}.{key}")
    try:
        return kind(**values)
    except (InvalidInput, TypeError) as error:
        raise file.error(place, str(error)) from None


def parse_feet(text: str) -> LegSettings:
    """``LINK,LINK...``: feet whose contacts are detected by their speed. Raises InvalidInput."""
    feet = tuple(part.strip() for part in text.split(","))
    if not all(feet):
        raise InvalidInput(f"feet are names of links with commas between them, not {text!r}")
    return LegSettings(feet=feet)


def parse_diff_drive(text: str) -> DiffDrive:
    """``left=JOINT,right=JOINT,radius=M,track=M``, with ``left`` and ``right`` repeated for several wheels.

    Raises InvalidInput.
    """
    joints: dict[str, list[str]] = {"left": [], "right": []}
    lengths: dict[str, float] = {}
    for part in text.split(","):
        key, sign, value = part.strip().partition("=")
        if sign and value and key in joints:
            joints[key].append(value)
        elif sign and key in ("radius", "track") and key not in lengths:
            try:
                lengths[key] = float(value)
            except ValueError:
                raise InvalidInput(f"{key} is a number [m], not {value!r}") from None
        else:
            raise InvalidInput(f"{part!r} is not part of left=JOINT,right=JOINT,radius=M,track=M")
    if missing := [
        key for key in ("left", "right", "radius", "track") if not ({**joints, **lengths}).get(key)
    ]:
        raise InvalidInput(f"{', '.join(missing)} missing; write left=JOINT,right=JOINT,radius=M,track=M")
    return DiffDrive(joints["left"], joints["right"], lengths["radius"], lengths["track"])
