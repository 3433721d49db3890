"""The first settings file of a robot, by what it publishes: every key, what it means and where it is from."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any

import numpy as np

from zstate._util.format import format_duration
from zstate.odometry import ImuNoise, WheelNoise
from zstate.odometry.cli.heard import Heard, density_at_rest, motion_text
from zstate.odometry.cli.settings_file import MEMS_NOISE, OdometrySettings, table_name
from zstate.odometry.cli.wheel_geometry import ProposedWheels, proposed_wheels
from zstate.odometry.messages import Imu, frame_of
from zstate.odometry.sensors import KINDS, SensorKind
from zstate.odometry.source_noise import SourceNoise
from zstate.streams import StreamName
from zstate.wire.keys import full_name

_COLUMN = 30
"""The width of keys before their comments [letters]."""

_PLACE = (48.1, 11.6)
"""An example: Munich."""

_RADIUS_M = 0.1
"""Where the model has none."""

MEANINGS = {
    "sigma": "standard deviation [m], or three for x, y and z",
    "velocity.sigma": "standard deviation [m/s], or three for x, y and z",
    "fix.sigma": "standard deviation [m], or two: horizontal and vertical",
    "relative.sigma": "standard deviation [m] of a metre of its way; it grows with the root of the way",
    "barometer.sigma": "standard deviation of a height [m]",
    "sigma_deg": "standard deviation [degrees]",
    "relative.sigma_deg": "standard deviation [degrees] of a metre of its way, likewise",
    "scale": "standard deviation of a constant relative error, such as of a radius",
    "relative.scale": "standard deviation of a constant factor: 0.05 of stereo cameras, 0.5 if unknown",
    "covariance": "what covariances of its poses are: stated (of no use), dependent or independent",
    "bias": "[T] of the sensor, subtracted (hard iron)",
    "soft_iron": "a matrix that the field is multiplied by then",
    "place": "latitude and longitude [degrees]: fields are compared with that of the Earth",
    "axes": "the numbers that are used",
    "floor": "the least sigma that is believed [m]: horizontal, vertical",
    "relative.floor": "standard deviation of a pose, also at rest [m]",
    "floor_deg": "standard deviation of a pose, also at rest [degrees]",
    "correlated_s": "for so long the errors of fixes wander [s]",
    "barometer.correlated_s": "for so long its error wanders [s]",
    "wander": "standard deviation of an error that wanders, as with the weather [m]",
    "temperature_c": "of the air [degrees Celsius]",
    "delay_s": "its stamps are so late against those of the IMU [s]",
    "gate": "the part of right readings that pass",
    "gyro": "white noise [rad/s/sqrt(Hz)]",
    "accel": "white noise [m/s^2/sqrt(Hz)]",
    "gyro_bias": "random walk of its bias [rad/s/sqrt(s)]",
    "accel_bias": "random walk of its bias [m/s^2/sqrt(s)]",
    "gyro_scale": "a constant relative error of the gyro",
    "gyro_bias_shift": "its bias in motion against that at rest [rad/s]",
    "slip": "a part of the speed",
    "speed": "at rest, such as the resolution of encoders [m/s]",
    "lateral": "the velocity across the wheels is zero up to this [m/s]",
    "vertical": "the velocity off the floor is zero up to this [m/s]",
    "wheels.scale": "a constant relative error of the radius",
}
"""What a key means, by itself or with its table."""


@dataclass(frozen=True)
class InitialFile:
    """The text of a settings file, and sentences on what it has not."""

    text: str
    notes: tuple[str, ...]


def initial_file(heard: Heard, path: str, settings: OdometrySettings) -> InitialFile:
    """The settings of a robot by what was heard; ``settings`` has the names that the user gave."""
    notes: list[str] = []
    base, wheels = settings.base, None
    if heard.model is not None:
        base = base or heard.model.root
        if base in heard.model.links:
            wheels = proposed_wheels(heard.model, base)
    settings = replace(settings, base=base)
    if base is None:
        notes.append(f"{heard.robot!r} publishes no model: give `base`, a frame of tf_static")
    sensors = [
        _Sensor(kind, stream, name, heard, settings)
        for kind in KINDS
        for stream in kind.streams
        for name in sorted(heard.messages[stream])
    ]
    sensors = [one for one in sensors if one.is_possible]
    are_wheels_used = wheels is not None and not any(
        one.is_used and one.kind.name == "velocity" for one in sensors
    )
    if wheels is not None and (wheels.radius is None or heard.joints is None):
        are_wheels_used = False
    imus = heard.messages["imu"]
    if not imus:
        notes.append(f"{heard.robot!r} has no IMU: publish one, and name it by `imu`")
    if not are_wheels_used and not any(one.is_used and one.kind.is_enough for one in sensors):
        notes.append(
            "nothing measures its motion but the IMU, which drifts by metres in seconds: give [diff_drive], "
            "[legs], [velocity.NAME] or [pose.NAME]"
        )
    lines = [
        *_head_lines(heard, path),
        *_frame_lines(heard, settings),
        *_noise_lines(heard, settings.imu),
        *_wheel_lines(heard, base, wheels, is_used=are_wheels_used),
    ]
    for one in sensors:
        lines += one.lines()
    return InitialFile("\n".join(lines) + "\n", tuple(notes))


def _head_lines(heard: Heard, path: str) -> Iterator[str]:
    robot, file = shlex.quote(heard.robot), shlex.quote(path)
    heard_text = format_duration(round(heard.seconds * 1e9))
    yield f"# The odometry of {heard.robot}, by what {heard.place} had of it in {heard_text}."
    yield "#"
    yield f"#   zstate odometry {robot} --file {file}"
    yield f"#   zstate odometry {robot} --file {file} --replay run.mcap   # check it on a recording"
    yield "#"
    yield "# A key behind a # has its default, and a table behind # is not used."
    yield ""


def _frame_lines(heard: Heard, settings: OdometrySettings) -> Iterator[str]:
    base = settings.base
    others = [name for name in sorted(heard.messages["imu"]) if name != settings.imu]
    readings = heard.messages["imu"].get(settings.imu, [])
    also = f"; there is also {', '.join(others)}" if others else ""
    yield _key("imu", settings.imu, _stream_text("imu", settings.imu, readings, heard, base) + also)
    yield _key("odom", settings.odom, "the frame of the odometry, in which the base starts")
    meaning = "the frame that is placed in it"
    if base is None:
        yield _key("base", "base_link", meaning, is_used=False)
    else:
        root = "" if heard.model is None or base != heard.model.root else ": the root of the model"
        yield _key("base", base, meaning + root)
    yield _key("history_s", settings.history_s, "data that is later than this is refused [s]", is_used=False)
    yield _key(
        "initial_pose",
        [0.0, 0.0, 0.0],
        "x, y [m] and yaw [degrees]; by default at the origin, after a rest",
        is_used=False,
    )
    if heard.messages["fix"]:
        yield _key("map", settings.map, "the frame in which fixes place the robot", is_used=False)
        yield _key(
            "datum",
            list(settings.datum or (0.0, 0.0, 0.0)),
            "its origin: latitude, longitude [degrees], altitude [m]; by default the first fix",
            is_used=settings.datum is not None,
        )


def _noise_lines(heard: Heard, imu: str) -> Iterator[str]:
    """The table of the IMU's noise: measured at rest, else the default."""
    readings: Sequence[Imu] = heard.messages["imu"].get(imu, [])
    moves = motion_text(heard, readings)
    density = None if moves else density_at_rest(heard, readings)
    if density is not None:
        where = f"measured in {format_duration(round(heard.seconds * 1e9))} at rest"
        known = {"gyro": density.gyro, "accel": density.accel}
    else:
        where = f"a default, as {moves or 'its readings repeat'}"
        known: dict[str, float] = {}
    yield ""
    yield _table("imu_noise", f"gyro and accel: {where}")
    for one in fields(ImuNoise):
        value = float(f"{known.get(one.name, getattr(MEMS_NOISE, one.name)):.2g}")
        yield _key(one.name, value, MEANINGS[one.name], is_used=one.default is MISSING)


def _wheel_lines(
    heard: Heard, base: str | None, wheels: ProposedWheels | None, *, is_used: bool
) -> Iterator[str]:
    """The table of the wheels, as the model has them, or an example."""
    yield ""
    if wheels is None:
        yield "# Wheels or legs: [diff_drive], [ackermann], [mecanum] or [legs]; the model shows no wheels."
        found = ProposedWheels(("LEFT_JOINT",), ("RIGHT_JOINT",), None, "", 0.4, 0.0, None, ())
    else:
        found = wheels
        yield "# By the model, to be checked: a robot may also have [ackermann], [mecanum] or [legs]."
        for remark in found.remarks:
            yield f"# Attention: {remark}."
        if heard.joints is None:
            yield "# It publishes no joint states, which wheels need."
        elif not is_used and found.radius is not None:
            yield "# Off, as a velocity is a source: most are of the same wheels."
    track, track_from = found.track, "between the wheels [m]"
    if found.length > 0.0:
        track = found.turning_track
        track_from = f"of skid steering [m]: {found.track:.3g} between the wheels; calibrate it by a turn"
    radius, radius_from = found.radius, f"[m], {found.radius_from}"
    if radius is None:
        radius, radius_from = _RADIUS_M, "[m]: measure it, the model does not have it"
    yield _table("diff_drive", "", is_used=is_used)
    for side, names in (("left", found.left), ("right", found.right)):
        yield _key(side, names[0] if len(names) == 1 else names, f"joints on the {side}", is_used=is_used)
    yield _key("radius", float(f"{radius:.4g}"), radius_from, is_used=is_used)
    yield _key("track", float(f"{track:.4g}"), track_from, is_used=is_used)
    yield _key(
        "frame",
        found.frame or base or "base_link",
        "the link in their middle; by default the base",
        is_used=is_used and found.frame is not None,
    )
    yield _table("diff_drive.noise", "standard deviations", is_used=is_used)
    for name, default in _defaults(WheelNoise):
        yield _key(name, default, _meaning("wheels", name), is_used=False)


class _Sensor:
    """One sensor of one kind, with its messages."""

    def __init__(
        self, kind: SensorKind, stream: StreamName, name: str, heard: Heard, settings: OdometrySettings
    ) -> None:
        self.kind = kind
        self._stream, self._name, self._heard, self._base = stream, name, heard, settings.base
        self._messages = heard.messages[stream][name]
        self._left_out = kind.left_out(self._messages, full_name(heard.robot, settings.odom))
        if self._left_out is not None and not self._messages:
            self._left_out = "it is announced, and silent"

    @property
    def is_possible(self) -> bool:
        """Whether it is such a sensor at all: not every IMU has an orientation."""
        return self._left_out is not None

    @property
    def is_used(self) -> bool:
        """Whether it is a source by default."""
        return self._left_out == ""

    def lines(self) -> Iterator[str]:
        """Its table."""
        yield ""
        if self._left_out:
            yield f"# Off: {self._left_out}."
        about = _stream_text(self._stream, self._name, self._messages, self._heard, self._base)
        name = self._name if len(self.kind.streams) == 1 else f"{self._stream}/{self._name}"
        yield _table(table_name(self.kind, name), about, is_used=self.is_used)
        seen = self._sigmas()
        for name, default in _defaults(self.kind.noise):
            meaning = _meaning(self.kind.name, name)
            if name in seen:
                yield _key(name, seen[name], f"{meaning}; messages state this", is_used=False)
            elif name == "place":
                yield _key(name, _PLACE, meaning, is_used=False)
            elif default is None:
                yield _key(
                    name,
                    self.kind.usual[name],
                    f"{meaning}; messages have none: state it",
                    is_used=self.is_used,
                )
            else:
                yield _key(name, default, meaning, is_used=False)

    def _sigmas(self) -> dict[str, Any]:
        """The medians of the standard deviations that its messages state, as values of keys."""
        found = [known for one in self._messages if (known := self.kind.variances(one)) is not None]
        if not found:
            return {}
        sigmas = self.kind.sigmas(np.sqrt(np.median(found, axis=0)))
        return {key: _rounded(values) for key, values in sigmas.items()}


def _stream_text(stream: str, name: str, messages: Sequence[Any], heard: Heard, base: str | None) -> str:
    """Stream, rate and frame of a sensor."""
    if not messages:
        return f"{stream}/{name}: no message"
    span_s = (messages[-1].stamp - messages[0].stamp) * 1e-9
    rate = f", {(len(messages) - 1) / span_s:.3g} Hz" if span_s > 0.0 else ""
    frame = frame_of(messages[0])
    if not frame:
        return f"{stream}/{name}{rate}, of the base"
    text = f"{stream}/{name}{rate}, in {frame.removeprefix(f'{heard.robot}/')}"
    if base is not None and not heard.mounts.can_lookup(full_name(heard.robot, base), frame):
        text += ", which is not on the robot: publish its mount"
    return text


def _defaults(noise: type[Any]) -> Iterator[tuple[str, Any]]:
    """The keys of such a table with their defaults, those of any source last."""
    common = {one.name for one in fields(SourceNoise)}
    for one in sorted(fields(noise), key=lambda one: one.name in common):
        yield one.name, one.default


def _meaning(table: str, key: str) -> str:
    return MEANINGS.get(f"{table}.{key}") or MEANINGS[key]


def _rounded(values: Any) -> float | list[float]:
    """One number if all are the same."""
    found = [float(f"{value:.2g}") for value in values]
    return found[0] if len(set(found)) == 1 else found


def _table(name: str, about: str, *, is_used: bool = True) -> str:
    return _aligned(f"{'' if is_used else '# '}[{name}]", about)


def _key(name: str, value: Any, about: str, *, is_used: bool = True) -> str:
    return _aligned(f"{'' if is_used else '# '}{name} = {_toml(value)}", about)


def _toml(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}" if "e" in f"{value:g}" or "." in f"{value:g}" else f"{value:.1f}"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return f"[{', '.join(map(_toml, value))}]"


def _aligned(text: str, about: str) -> str:
    return f"{text:<{_COLUMN}} # {about}" if about else text
