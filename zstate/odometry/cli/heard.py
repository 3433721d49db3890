"""What a robot publishes that an odometry could use, heard for some seconds or read from a recording.

A robot that stands for these seconds shows the noise of its IMU. Its density is that of differences of
neighbours, of means over 1, 4 and 16 samples, whichever is largest: a filter in the IMU makes neighbours
alike, so that the first alone is too small (Allan variance at these times; IEEE Std 952).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from zstate.buffer.buffer import RECORDING_HISTORY_S, TransformBuffer
from zstate.checks import Floats
from zstate.model.joint_history import JointHistory
from zstate.model.robot import RobotModel, coordinate_names
from zstate.model.urdf import parse_urdf
from zstate.odometry.fusion import MOST_BIAS, is_still
from zstate.odometry.invariant_filter import GRAVITY
from zstate.odometry.messages import Imu
from zstate.odometry.sensors import SENSOR_STREAMS
from zstate.streams import StreamName
from zstate.wire.messages import RobotDescription, from_block

if TYPE_CHECKING:
    from zstate.net.session import Session
    from zstate.sources import JointReading

_LEAST_SAMPLES, _LEAST_S = 64, 2.0
"""The least samples of the IMU, and their duration, to measure its noise."""
_BLOCK_S = 0.5
_MOST_RATE_CHANGE, _MOST_FORCE_CHANGE, _MOST_FORCE_OFF = 0.02, 0.3, 0.5
"""[rad/s], [m/s^2]: means over half a second of an IMU at rest are as near each other, and to gravity."""
_MOST_TURNED = 1e-3
"""[rad] Joints at rest turn by less."""


@dataclass
class Heard:
    """What ``robot`` published in ``seconds``, from ``place``: the network, or the file of a recording.

    ``messages`` are those of sensors, by stream and name, in the order of arrival; one that is announced and
    silent has none. ``mounts`` has their frames, with full names.
    """

    robot: str
    place: str
    seconds: float
    mounts: TransformBuffer
    model: RobotModel | None = None
    messages: dict[StreamName, dict[str, list[Any]]] = field(
        default_factory=lambda: {stream: {} for stream in SENSOR_STREAMS}
    )
    joints: JointHistory | None = None


class DensityOfImu(NamedTuple):
    """White noise: [rad/s/sqrt(Hz)] and [m/s^2/sqrt(Hz)]."""

    gyro: float
    accel: float


def heard_live(session: Session, robot: str, seconds: float) -> Heard:
    """What ``robot`` publishes now. Ends the command if no robot of that name is announced."""
    import threading

    from zstate.cli.robot_directory import announced_robots
    from zstate.clock import wait_interruptible
    from zstate.nodes.listener import TransformListener
    from zstate.odometry import SensorListener
    from zstate.sources import JointStateListener
    from zstate.sources.joint_state_listener import DescriptionSubscriber

    (announced,) = announced_robots(session, robot)
    readings: list[JointReading] = []
    models: dict[str, RobotModel] = {}
    with TransformListener(session, robot) as listener:
        heard = Heard(robot, "the network", seconds, listener.buffer)
        for stream in SENSOR_STREAMS:
            heard.messages[stream] = {name: [] for name, _ in announced.named(stream)}

        def on_message(stream: StreamName, name: str, message: Any) -> None:
            heard.messages[stream].setdefault(name, []).append(message)

        callbacks = {stream: partial(on_message, stream) for stream in SENSOR_STREAMS}
        with (
            DescriptionSubscriber(session, robot, models.__setitem__),
            JointStateListener(session, robot, on_reading=readings.append),
            SensorListener(session, robot, callbacks),
        ):
            wait_interruptible(threading.Event(), seconds)
        heard.model = models.get(robot)
    if heard.model is not None and readings:
        heard.joints = JointHistory(
            heard.model.joint_names,
            coordinate_names(heard.model),
            (),
            np.array([one.stamp for one in readings], dtype=np.int64),
            np.array([one.positions for one in readings]),
        )
    return heard


def heard_in(path: str, robot: str, seconds: float) -> Heard:
    """What ``robot`` published in a recording, of whose first ``seconds`` the noise is measured.

    Raises RecordingError.
    """
    from zstate.recording.recording import Recording

    heard = Heard(robot, path, seconds, TransformBuffer(RECORDING_HISTORY_S))
    with Recording(path, robot) as recording:
        for _, message, _ in recording.fill(heard.mounts):
            if isinstance(message, RobotDescription) and heard.model is None:
                heard.model = parse_urdf(message.urdf, f"the URDF of {robot!r}")
        for stream in SENSOR_STREAMS:
            for name in recorded_names(recording.info, robot, stream):
                heard.messages[stream][name] = list(recording.sensor_messages(stream, robot, name))
        if recorded_names(recording.info, robot, "joint_states"):
            heard.joints = recording.joint_states(robot)
    return heard


def recorded_names(info: Any, robot: str, stream: StreamName) -> list[str]:
    """The writers of a stream in a recording, sorted."""
    from zstate.recording.info import recorded_robots

    return sorted(
        {
            one.writer
            for recorded in recorded_robots(info)
            if recorded.name == robot
            for one in recorded.streams
            if one.stream == stream and one.count
        }
    )


def motion_text(heard: Heard, imu: Sequence[Imu]) -> str:
    """Why the noise of this IMU cannot be measured, as what moves; empty if the robot stands."""
    if not imu:
        return "it sends nothing"
    first = imu[0].stamp
    last = first + round(heard.seconds * 1e9)
    return next(_motions(heard, _within(imu, first, last), first, last), "")


def _motions(heard: Heard, imu: Sequence[Imu], first: int, last: int) -> Iterator[str]:
    seconds = (imu[-1].stamp - imu[0].stamp) * 1e-9
    if len(imu) < _LEAST_SAMPLES or seconds < _LEAST_S:
        yield f"{len(imu)} readings in {seconds:.1f} s are too few"
    for name, messages in heard.messages["velocity"].items():
        for one in _within(messages, first, last):
            angular = None if one.angular is None else from_block(one.angular)
            if not is_still(from_block(one.linear), angular):
                yield f"its velocity {name!r} is not zero"
    joints = heard.joints
    if joints is not None:
        rows = joints.positions[(joints.stamps >= first) & (joints.stamps <= last)]
        for name, column in zip(joints.coordinates, rows.T, strict=True):
            if len(column) and np.ptp(column) > _MOST_TURNED:
                yield f"its joint {name!r} moves"
    gyro, accel = _numbers(imu)
    size = max(1, round(_BLOCK_S * len(imu) / max(seconds, _BLOCK_S)))
    gyro_means, accel_means = _means(gyro, size), _means(accel, size)
    rate = float(np.linalg.norm(gyro.mean(axis=0)))
    if rate > MOST_BIAS or np.ptp(gyro_means, axis=0).max() > _MOST_RATE_CHANGE:
        yield f"its gyro reads {rate:.2g} rad/s, or changes"
    off = abs(float(np.linalg.norm(accel.mean(axis=0))) + float(GRAVITY[2]))
    if off > _MOST_FORCE_OFF or np.ptp(accel_means, axis=0).max() > _MOST_FORCE_CHANGE:
        yield f"its accelerometer is {off:.2g} m/s^2 off gravity, or changes"


def density_at_rest(heard: Heard, imu: Sequence[Imu]) -> DensityOfImu | None:
    """The noise of an IMU at rest; None if it repeats its numbers, as without noise."""
    first = imu[0].stamp
    readings = _within(imu, first, first + round(heard.seconds * 1e9))
    period_s = (readings[-1].stamp - first) * 1e-9 / (len(readings) - 1)
    gyro, accel = (white_density(numbers, period_s) for numbers in _numbers(readings))
    return DensityOfImu(gyro, accel) if gyro > 0.0 and accel > 0.0 else None


def white_density(numbers: Floats, period_s: float) -> float:
    """The density of white noise of ``numbers`` (n, k), ``period_s`` apart, in the noisiest column.

    ``tau`` times the Allan variance at ``tau``, the mean square of differences of neighbours by two, is
    constant for white noise, and is its squared density. All means of a size are used, also those that
    overlap: a few seconds hold few others (NIST SP 1065, 5.2.4).
    """
    sums = np.cumsum(numbers - numbers[0], axis=0)
    sums = np.vstack([np.zeros_like(sums[:1]), sums])

    def density_squared(size: int) -> float:
        means = (sums[size:] - sums[:-size]) / size
        return float((size * period_s * 0.5 * np.mean((means[size:] - means[:-size]) ** 2, axis=0)).max())

    return math.sqrt(max(density_squared(size) for size in (1, 4, 16) if 2 * size <= len(numbers)))


def _means(numbers: Floats, size: int) -> Floats:
    """Means of ``size`` rows in a row."""
    count = len(numbers) // size
    return numbers[: count * size].reshape(count, size, -1).mean(axis=1)


def _numbers(imu: Sequence[Imu]) -> tuple[Floats, Floats]:
    return np.array([from_block(one.gyro) for one in imu]), np.array([from_block(one.accel) for one in imu])


def _within(messages: Sequence[Any], first: int, last: int) -> list[Any]:
    return [one for one in messages if first <= one.stamp <= last]
