"""What the odometry of one robot is computed from, and the TOML file that holds it: one setting for all runs.

Its keys are the fields of OdometrySettings and, in tables, of the classes of their values. models/rover.toml
is an example.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec

from zstate._util.format import did_you_mean
from zstate.buffer.buffer import TransformBuffer
from zstate.cli.up.template import TomlFile
from zstate.errors import InvalidInput
from zstate.model.robot import RobotModel
from zstate.odometry import (
    Ackermann,
    BarometerNoise,
    BaseEstimator,
    Datum,
    DiffDrive,
    FixNoise,
    ForceThresholds,
    HeadingNoise,
    ImuNoise,
    LegNoise,
    Legs,
    MagnetometerNoise,
    MapEstimator,
    Mecanum,
    PoseNoise,
    RelativeNoise,
    SpeedThresholds,
    VelocityNoise,
    Wheels,
)
from zstate.odometry.sensors import KINDS, Sensor, SensorKind
from zstate.odometry.source_noise import SensorNoise, SourceNoise
from zstate.transform import Transform
from zstate.wire.keys import check_writer, full_name

MEMS_NOISE = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
"""That of an inexpensive IMU, for robots without another setting."""

WHEEL_KINDS = ("diff_drive", "ackermann", "mecanum")
"""The tables of wheels, of which a robot has one."""

DEFAULT_SPEEDS = SpeedThresholds(touchdown=0.1, liftoff=0.2)
"""Those of the feet of walking robots without another setting."""

_AXES = "axes"
"""The one key of a sensor that is a list."""
_WRITTEN = {_AXES: "x+y", "covariance": "dependent"}
"""Values of keys that are no numbers, on the command line."""

T = TypeVar("T")
PlanarPose = tuple[float, float, float]
"""x, y [m] and yaw [degrees] in the frame of the odometry."""


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
        return Legs(model, self.feet, imu=imu, noise=self.noise, detection=self.detection)

    @property
    def detection(self) -> ForceThresholds | SpeedThresholds:
        """The thresholds of contacts: those of the speed, by default, where none are stated."""
        return self.force or self.speed or DEFAULT_SPEEDS


@dataclass(frozen=True, kw_only=True)
class OdometrySettings:
    """The sensors, frames and noise of one robot.

    ``velocity``, ``pose``, ``relative``, ``heading``, ``magnetometer``, ``fix`` and ``barometer`` are further
    sensors by name, with what is stated of their noise; those of ``relative`` are other odometries by stream
    and name, as "pose/camera", those of ``heading`` IMUs whose orientation shows the yaw. Fixes place the
    odometry in the frame ``map``, whose origin ``datum`` has a latitude and longitude [degrees] and an
    altitude [m]; by default it is the first fix. ``base`` None is the root of the model. Without an
    ``initial_pose`` the base starts at the origin, once it is aligned at rest. ``planar``: its z, roll and
    pitch are published as zero. Raises InvalidInput for names that no sensor can have, for wheels of several
    kinds, and for a datum that is no place on the Earth.
    """

    imu: str = "imu"
    velocity: dict[str, VelocityNoise] = field(default_factory=dict[str, VelocityNoise])
    pose: dict[str, PoseNoise] = field(default_factory=dict[str, PoseNoise])
    relative: dict[str, RelativeNoise] = field(default_factory=dict[str, RelativeNoise])
    heading: dict[str, HeadingNoise] = field(default_factory=dict[str, HeadingNoise])
    magnetometer: dict[str, MagnetometerNoise] = field(default_factory=dict[str, MagnetometerNoise])
    fix: dict[str, FixNoise] = field(default_factory=dict[str, FixNoise])
    barometer: dict[str, BarometerNoise] = field(default_factory=dict[str, BarometerNoise])
    map: str = "map"
    datum: tuple[float, float, float] | None = None
    odom: str = "odom"
    base: str | None = None
    initial_pose: PlanarPose | None = None
    planar: bool = False
    history_s: float = 1.0
    imu_noise: ImuNoise = MEMS_NOISE
    diff_drive: DiffDrive | None = None
    ackermann: Ackermann | None = None
    mecanum: Mecanum | None = None
    legs: LegSettings | None = None

    def __post_init__(self) -> None:
        check_writer(self.imu)
        for one in self.sensors:
            one.check()
        kinds = [kind for kind in WHEEL_KINDS if getattr(self, kind) is not None]
        if len(kinds) > 1:
            raise InvalidInput(f"a robot has wheels of one kind, not of {' and '.join(kinds)}")
        if self.datum is not None:
            Datum(*self.datum)  # raises here

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All but the IMU and the joints."""
        return tuple(
            Sensor(kind, name, noise)
            for kind in KINDS
            for name, noise in cast("dict[str, SensorNoise]", getattr(self, kind.name)).items()
        )

    @property
    def wheels(self) -> Wheels | None:
        """Those of the robot, of whichever kind."""
        return self.diff_drive or self.ackermann or self.mecanum

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
        odom, base = full_name(robot, self.odom), full_name(robot, base)
        start = None if self.initial_pose is None else planar_transform(odom, base, self.initial_pose)
        return BaseEstimator(
            odom=odom,
            base=base,
            imu=full_name(robot, imu_frame),
            buffer=buffer,
            imu_noise=self.imu_noise,
            history_s=self.history_s,
            wheels=self.wheels,
            legs=legs,
            initial_pose=start,
        )

    def map_estimator(
        self, robot: str, odometry: BaseEstimator, buffer: TransformBuffer
    ) -> MapEstimator | None:
        """What places ``odometry`` in the map by fixes; None without receivers."""
        if not self.fix:
            return None
        datum = None if self.datum is None else Datum(*self.datum)
        return MapEstimator(odometry, map=full_name(robot, self.map), buffer=buffer, datum=datum)


def planar_transform(odom: str, base: str, pose: PlanarPose) -> Transform:
    """The pose of ``base`` in ``odom``, on the floor and upright."""
    x, y, yaw_deg = pose
    return Transform.from_rpy(odom, base, (x, y, 0.0), (0.0, 0.0, math.radians(yaw_deg)))


def read_settings(path: str) -> OdometrySettings:
    """The settings in a TOML file. Raises ConfigError, with the line, for unknown and unusable keys."""
    file = TomlFile(Path(path))
    for kind in KINDS:
        for name, table in _table(file.tables.get(kind.name)).items():
            _converted(
                table, kind.noise, file, f"{kind.name}.{name}"
            )  # msgspec does not name keys of mappings
    return _converted(file.tables, OdometrySettings, file, "")


def _converted(values: object, kind: type[T], file: TomlFile, place: str) -> T:
    """``kind(**values)``, with errors at ``place`` or below it."""
    _check_keys(values, msgspec.inspect.type_info(kind), file, place)
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        text, _, below = str(error).partition(" - at `$")
        raise file.error((place + below.strip("`")).removeprefix("."), text) from None


def _check_keys(values: object, kind: msgspec.inspect.Type, file: TomlFile, place: str) -> None:
    """Raise ConfigError for the first unknown key, which msgspec ignores in what becomes a dataclass.

    Also for a word that is none of those there are, which msgspec does not list.
    """
    if isinstance(kind, msgspec.inspect.LiteralType):
        words = list(map(str, kind.values))
        if isinstance(values, str) and values not in words:
            raise file.error(
                place, f"it is one of {', '.join(words)}, not {values!r}{did_you_mean(values, words)}"
            )
    elif isinstance(kind, msgspec.inspect.UnionType):
        for one in kind.types:
            _check_keys(values, one, file, place)
    elif isinstance(kind, msgspec.inspect.DataclassType):
        known = {one.name: one.type for one in kind.fields}
        for key, value in _table(values).items():
            at = f"{place}.{key}" if place else key
            if key not in known:
                raise file.error(at, f"unknown key{did_you_mean(key, known)}")
            _check_keys(value, known[key], file, at)


def _table(values: object) -> Mapping[str, Any]:
    return cast("Mapping[str, Any]", values) if isinstance(values, dict) else {}


def table_name(kind: SensorKind, sensor: str) -> str:
    """That of the table of a sensor, as TOML writes it: a name with a stream, as "pose/camera", is quoted."""
    is_bare = re.fullmatch(r"[A-Za-z0-9_-]+", sensor)
    return f"{kind.name}.{sensor if is_bare else json.dumps(sensor, ensure_ascii=False)}"


def others_text(sensor: str, known: Collection[str]) -> str:
    """The sensors that there are in place of ``sensor``, near misses first; empty if there are none."""
    return f"; there is {', '.join(map(repr, sorted(known)))}{did_you_mean(sensor, known)}" if known else ""


def parse_feet(text: str) -> LegSettings:
    """``LINK,LINK...``: feet whose contacts are detected by their speed. Raises InvalidInput."""
    feet = tuple(part.strip() for part in text.split(","))
    if not all(feet):
        raise InvalidInput(f"feet are names of links with commas between them, not {text!r}")
    return LegSettings(feet=feet)


def parse_sensor(kind_name: str, text: str) -> tuple[str, SensorNoise]:
    """``SENSOR[:sigma=NUMBER,axes=x+y,...]``: a sensor of this kind, and what is stated of its noise.

    Raises InvalidInput.
    """
    kind = next(kind for kind in KINDS if kind.name == kind_name)
    name, colon, stated = text.partition(":")
    known = msgspec.inspect.type_info(kind.noise)
    assert isinstance(known, msgspec.inspect.DataclassType)
    common = {one.name for one in fields(SourceNoise)}
    names = [one.name for one in known.fields if one.name == _AXES or _is_one_value(one.type)]
    names.sort(key=common.__contains__)
    texts = {one.name for one in known.fields if isinstance(one.type, msgspec.inspect.LiteralType)}
    values: dict[str, Any] = {}
    for part in stated.split(",") if colon else ():
        key, _, value = part.strip().partition("=")
        if key not in names or key in values:
            written = ",".join(f"{one}={_WRITTEN.get(one, 'NUMBER')}" for one in names)
            raise InvalidInput(f"{part!r} is not part of SENSOR:{written}{did_you_mean(key, names)}")
        if key == _AXES:
            values[key] = tuple(value.split("+"))
        else:
            values[key] = value if key in texts else _number(key, value)
    sensor = Sensor(kind, name, kind.noise(**values))
    sensor.check()
    return sensor.name, sensor.noise


def _is_one_value(kind: msgspec.inspect.Type) -> bool:
    """Whether a number or a word can be written for it on a command line."""
    kinds = kind.types if isinstance(kind, msgspec.inspect.UnionType) else (kind,)
    return any(isinstance(one, msgspec.inspect.FloatType | msgspec.inspect.LiteralType) for one in kinds)


def _number(key: str, value: str, unit: str = "") -> float:
    try:
        return float(value)
    except ValueError:
        raise InvalidInput(f"{key} is a number{unit}, not {value!r}") from None


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
            lengths[key] = _number(key, value, " [m]")
        else:
            raise InvalidInput(f"{part!r} is not part of left=JOINT,right=JOINT,radius=M,track=M")
    if missing := [
        key for key in ("left", "right", "radius", "track") if not ({**joints, **lengths}).get(key)
    ]:
        raise InvalidInput(f"{', '.join(missing)} missing; write left=JOINT,right=JOINT,radius=M,track=M")
    return DiffDrive(joints["left"], joints["right"], lengths["radius"], lengths["track"])
