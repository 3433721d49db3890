"""Message types of the native wire format (frozen msgspec structs), and their size limits.

A block is the bytes of consecutive little-endian float64: ``to_block`` makes one of an array, ``from_block``
reads it without a copy. The rays of a scan are a block of float32. Fields are encoded by position, so a later
version may append fields, which today's readers skip; any other change needs a new version. The limits bound
the memory that a writer can make a reader use.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from hashlib import blake2b
from itertools import takewhile
from math import inf, isfinite, sqrt
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from zstate.errors import InvalidInput, MessageError, printable
from zstate.message import Count, Message, SessionId, Stamp, StampedMessage
from zstate.plugins import stream_named
from zstate.streams import GRID_CELLS, StreamName
from zstate.transform import COVARIANCE_NUMBERS
from zstate.wire.keys import MAX_FRAME_NAME_LENGTH, full_name

Edges = tuple[tuple[str, str], ...]
Interval = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Digest = Annotated[bytes, Meta(min_length=8, max_length=8)]
Mode = Literal["position", "velocity", "effort"]
Level = Literal["ok", "warn", "error", "stale"]

POSE_BYTES = 7 * 8
_UNIT_TOLERANCE = 1e-3
_UPPER_TRIANGLES = {size: np.triu_indices(size) for size in (3, 6)}
_FLOAT64 = np.dtype("<f8")
_FLOAT32 = np.dtype("<f4")


def to_block(values: ArrayLike) -> bytes:
    """The block of an array of any shape, row by row."""
    return np.asarray(values, dtype=_FLOAT64).tobytes()


def from_block(block: bytes) -> NDArray[np.float64]:
    """The numbers of a block: (n,), read-only, sharing the block's memory."""
    return np.frombuffer(block, dtype=_FLOAT64)


def to_float32_block(values: ArrayLike) -> bytes:
    """``to_block`` in float32."""
    return np.asarray(values, dtype=_FLOAT32).tobytes()


def from_float32_block(block: bytes) -> NDArray[np.float32]:
    """``from_block`` in float32."""
    return np.frombuffer(block, dtype=_FLOAT32)


def poses_from_block(block: bytes) -> NDArray[np.float64]:
    """The poses of a block: (n, 7), x y z [m], qx qy qz qw; read-only, sharing its memory."""
    return np.frombuffer(block, dtype=_FLOAT64).reshape(-1, 7)


def order_digest(order: Sequence[str] | Sequence[tuple[str, str]]) -> bytes:
    """The 8-byte digest of a joint order (names) or edge order ((parent, child) pairs).

    BLAKE2b of the order as a MessagePack array.
    """
    return _order_digest(tuple(order))


@lru_cache(maxsize=256)  # a writer that sends names does so in each sample
def _order_digest(order: tuple[object, ...]) -> bytes:
    return blake2b(msgspec.msgpack.encode(order), digest_size=8).digest()


M = TypeVar("M", bound=Message)
_Stamped = TypeVar("_Stamped", bound=StampedMessage)


def renumbered(message: _Stamped, seq: int, session: int) -> _Stamped:
    """The same message as that of another ``session``, in which it has the number ``seq``."""
    return msgspec.structs.replace(message, seq=seq, session=session)


class Sample(StampedMessage, frozen=True, array_like=True, gc=False):
    """One instant of a robot's state; ``order`` is the digest of the order of the numbers."""

    order: Digest


class JointState(Sample, frozen=True, array_like=True, gc=False):
    """The joint positions of a robot at one instant, with velocities and efforts if known.

    Blocks in the order with the digest ``order``. A writer without a model sends the ``names`` of
    that order, one number for each, and so does a writer of some of the joints: of the
    coordinates, see ``coordinate_names``. Then NaN marks a velocity or effort that is not known.
    """

    positions: bytes
    velocities: bytes | None = None
    efforts: bytes | None = None
    names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if len(self.positions) % 8 or self.velocities is not None or self.efforts is not None:
            _check_numbers(self.positions, self.velocities, self.efforts)
        if self.names is not None:
            _check_named(self.names, self.positions, self.velocities, self.efforts)
            _check_order(self.order, self.names)


class TransformSample(Sample, frozen=True, array_like=True, gc=False):
    """Every moving edge of a robot at one instant.

    ``poses`` is a block of ``parent_from_child``, seven numbers for each edge. The edges are ``edges``, or
    ``RobotDescription.moving_edges`` if None.
    """

    poses: bytes
    edges: Edges | None = None

    def __post_init__(self) -> None:
        _check_poses(self.poses, self.edges)
        if self.edges is not None:
            _check_order(self.order, self.edges)


class WriterTransforms(TransformSample, frozen=True, array_like=True, gc=False):
    """Moving edges of one ``TransformPublisher`` at one instant.

    ``covariances`` is a block of 21 numbers for each edge, NaN if not known: the upper triangle of the pose's
    covariance row by row, in the order x y z [m], rotation about the fixed axes x y z of the parent [rad], as
    in ROS (geometry_msgs/PoseWithCovariance).
    """

    covariances: bytes | None = None

    def __post_init__(self) -> None:
        if self.edges is None:
            raise InvalidInput("the transforms of a writer name their edges")
        _check_poses(self.poses, self.edges)
        _check_order(self.order, self.edges)
        if self.covariances is not None and len(self.covariances) != 3 * len(self.poses):
            raise InvalidInput(
                f"{len(self.poses) // POSE_BYTES} poses take 21 numbers of covariance each; got "
                f"{len(self.covariances)} bytes"
            )


class Odometry(WriterTransforms, frozen=True, array_like=True, gc=False):
    """The pose and the velocity of a base, the child of the one edge: nav_msgs/Odometry.

    ``twist`` is a block of six numbers in the axes of the child: the velocity of its origin relative to the
    parent [m/s], and its angular velocity [rad/s]. ``twist_covariance`` is the upper triangle of their
    covariance, a block of 21 numbers, None if it is not known; ``covariances`` that of the pose.
    """

    twist: bytes = b""
    twist_covariance: bytes | None = None

    def __post_init__(self) -> None:
        if self.edges is None or len(self.edges) != 1:
            raise InvalidInput(f"odometry has one edge, from its frame to the base; got {self.edges}")
        super().__post_init__()
        _finite_numbers("a twist", self.twist, 6)
        _check_covariance("a twist", self.twist_covariance, 6)


def edge_of(odometry: Odometry) -> WriterTransforms:
    """The pose of ``odometry`` alone."""
    head = (odometry.stamp, odometry.seq, odometry.session, odometry.order)
    return WriterTransforms(*head, odometry.poses, odometry.edges, odometry.covariances)


def covariances_of(sample: TransformSample) -> NDArray[np.float64] | None:
    """The covariances of the edges of a sample: (n, 21), read-only, NaN where not known; None if none is."""
    if not isinstance(sample, WriterTransforms) or sample.covariances is None:
        return None
    return from_block(sample.covariances).reshape(-1, COVARIANCE_NUMBERS)


def select_edges(sample: TransformSample, edges: Edges, rows: Sequence[int]) -> TransformSample:
    """The ``rows`` of a sample of ``edges``."""
    chosen = tuple(edges[row] for row in rows)
    head = (sample.stamp, sample.seq, sample.session, order_digest(chosen))
    poses, covariances = poses_from_block(sample.poses), covariances_of(sample)
    if covariances is None:
        return TransformSample(*head, to_block(poses[rows]), chosen)
    return WriterTransforms(*head, to_block(poses[rows]), chosen, to_block(covariances[rows]))


MAX_REASON_LENGTH = 1000
"""The longest reason of a Stop."""
MAX_STATE_TEXT_LENGTH = 2000


class JointCommand(Sample, frozen=True, array_like=True, gc=False):
    """Setpoints for a driver, of the joints ``names``.

    Each joint has one number, in the block of its mode, and NaN in the others: one message commands wheels by
    velocities and an arm by positions at the same tick. A block of a mode that no joint has is None. They are
    valid for ``ttl`` [ns] after they have arrived; 0 stands for the driver's own limit. A driver refuses a
    command without names, unless it is for a ``motion``: the ``seq`` of a JointTrajectory of the same
    session, which stays valid for ``ttl`` by that. ``echo`` is the session of the newest DriverState that
    the commander has, and an instant of that driver's clock at or before the sending [ns]: its ``instant``,
    and the time since it arrived. A driver takes the age of a command from it, else from ``stamp``.
    """

    positions: bytes | None = None
    velocities: bytes | None = None
    efforts: bytes | None = None
    names: tuple[str, ...] | None = None
    ttl: Interval = 0
    motion: Count | None = None
    echo: tuple[SessionId, Interval] | None = None

    def __post_init__(self) -> None:
        blocks = (self.positions, self.velocities, self.efforts)
        _check_numbers(*blocks)
        if self.names is not None:
            _check_named(self.names, *blocks)
            _check_order(self.order, self.names)


MOTION_POINTS = 10_000
"""The most points of a motion."""

PATH_TOLERANCE = 0.2
GOAL_TOLERANCE = 0.05
"""[rad] or [m]"""
GOAL_TIME_S = 1.0


class JointTrajectory(StampedMessage, frozen=True, array_like=True, gc=False):
    """A request for a motion of the joints ``names`` through points, for the queryable of a driver.

    ``times`` [s] is a block of T numbers, from ``start``, a stamp [ns], or from the arrival. ``points`` [rad]
    or [m], ``velocities`` per s, and ``accelerations`` per s^2 are blocks of (T, n), row by row. With
    ``stretch`` the motion is slowed to fit the limits. Joints may be ``path_tolerance`` [rad] or [m] from the
    path, and must be within ``goal_tolerance`` of the last point ``goal_time`` [s] after it. The session and
    ``seq`` identify the motion. ``echo`` is that of a JointCommand: a driver starts no motion a second after
    the sending.
    """

    names: tuple[str, ...]
    times: bytes
    points: bytes
    velocities: bytes | None = None
    accelerations: bytes | None = None
    start: Stamp | None = None
    stretch: bool = False
    path_tolerance: float = PATH_TOLERANCE
    goal_tolerance: float = GOAL_TOLERANCE
    goal_time: float = GOAL_TIME_S
    echo: tuple[SessionId, Interval] | None = None

    def __post_init__(self) -> None:
        _check_numbers(self.times)
        count = len(self.times) // 8
        if not 0 < count <= MOTION_POINTS:
            raise InvalidInput(f"a motion has 1 to {MOTION_POINTS} points, not {count}")
        numbers = count * len(self.names)
        for block in (self.points, self.velocities, self.accelerations):
            if block is not None and len(block) != 8 * numbers:
                raise InvalidInput(
                    f"{count} points of {len(self.names)} joints have {numbers} numbers, not "
                    f"{len(block) / 8:g}"
                )
        if not (self.path_tolerance > 0.0 and self.goal_tolerance > 0.0):  # NaN as well
            tolerances = f"{self.path_tolerance} and {self.goal_tolerance}"
            raise InvalidInput(f"path_tolerance and goal_tolerance are above zero, not {tolerances}")
        if not 0.0 <= self.goal_time < inf:
            raise InvalidInput(f"goal_time is finite and not negative [s], not {self.goal_time}")


def with_echo(request: JointTrajectory, driver: int, instant: int) -> JointTrajectory:
    """``request`` with the echo of the session ``driver`` and an ``instant`` of its clock [ns]."""
    return msgspec.structs.replace(request, echo=(driver, instant))


def without_past(request: JointTrajectory, stamp: int) -> JointTrajectory:
    """``request`` without the first points that are due at ``stamp`` [ns]. Raises InvalidInput if all are."""
    times = from_block(request.times)
    passed_s = 0.0 if request.start is None else (stamp - request.start) * 1e-9
    first = int((times <= passed_s).sum())
    if first == len(times):
        raise InvalidInput(f"the last point was due {passed_s - times[-1]:.6g} s ago")
    blocks = {
        name: block[len(block) // len(times) * first :]
        for name in ("times", "points", "velocities", "accelerations")
        if (block := getattr(request, name)) is not None
    }
    return msgspec.structs.replace(request, **blocks)


class MotionCancel(StampedMessage, frozen=True, array_like=True, gc=False):
    """A request to end the ``motion``: the ``seq`` of a JointTrajectory of the same session."""

    motion: Count


class MotionReply(Message, frozen=True, array_like=True, gc=False):
    """The reply of a driver to a request, which is accepted if there are no ``findings``.

    ``session`` is that of the driver's DriverState. A motion is valid for ``ttl`` [ns], unless it is renewed.
    """

    session: SessionId
    ttl: Interval
    findings: tuple[str, ...] = ()


OutcomeName = Literal["reached", "aborted", "replaced", "cancelled", "stopped"]


class MotionOutcome(Message, frozen=True, array_like=True, gc=False):
    """How the motion with ``seq`` of the commander's ``session`` has ended, and why."""

    session: SessionId
    seq: Count
    name: OutcomeName
    reason: str = ""


class Stop(StampedMessage, frozen=True, array_like=True, gc=False):
    """A stop of a driver, until it is released.

    With ``how`` "hold" the joints stay where they are, with "relax" without torque; drivers obey "relax" on
    the key of its own only, and hold otherwise. ``reason`` is shown to users. A stop never fails because of
    its text: ``stop_text`` makes one that fits of any.
    """

    how: Literal["hold", "relax"]
    reason: str = ""

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "reason", stop_text(self.reason))


def stop_text(text: str) -> str:
    """``text`` as the reason of a Stop: with escapes where it is not UTF-8, and cut where it is too long."""
    text = _encodable(text)
    return text if len(text) <= MAX_REASON_LENGTH else f"{text[: MAX_REASON_LENGTH - 3]}..."


def _encodable(text: str) -> str:
    """``text`` with escapes for the bytes of file names and arguments that are not UTF-8."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


Id = tuple[SessionId, Count]
"""A message by its ``session`` and its ``seq``."""

StopIds = tuple[Id, ...]
"""Stops, each by its ``session`` and its ``seq``."""


class Release(StampedMessage, frozen=True, array_like=True, gc=False):
    """The end of ``stops``, and of no others: a stop that arrives at the same time stays."""

    stops: StopIds


class DriverState(Message, frozen=True, array_like=True, gc=False):
    """The state of the driver of a robot's ``joint_names``. Not a safety-rated channel.

    ``program`` is the host of the driver. ``state`` is "off" before and after the control loop; "ready" if
    it reads and writes nothing; "active" while setpoints are valid; "holding" after their end; "stopped"
    until all ``stops`` are released; "fault" after too many failures in a row. ``reason`` is why.
    ``commander`` is the program of the newest setpoints, whose age since their arrival is ``command_age``
    [ns], None without any; ``ttl`` [ns] is the longest that is granted. ``limited`` are the joints that
    moved slower than commanded at the last tick. ``faults`` counts failed calls of the driver, ``refused``
    commands by reason, the newest described by ``last_refusal``. ``motion`` is under way, by session and
    ``seq`` of its JointTrajectory, and ``progress`` is the part of its duration that has passed, 0 to 1.
    ``outcomes`` are those of the last motions, newest last. ``modes`` are those in which joints may be
    commanded. ``stamp`` [ns] is of the driver's system clock, ``instant`` [ns] of its monotonic clock: only
    for the ``echo`` of commanders. ``received`` is the newest command, by session and ``seq``, also if it was
    refused, and ``transit_excess`` [ns] is how much longer it was under way than the fastest of its session,
    None unless it arrived within the last second.
    """

    stamp: Stamp
    session: SessionId
    program: str
    state: Literal["off", "ready", "active", "holding", "stopped", "fault"]
    reason: str
    joint_names: tuple[str, ...]
    ttl: Interval
    commander: str = ""
    command_age: Interval | None = None
    limited: tuple[str, ...] = ()
    rate_hz: Annotated[float, Meta(ge=0.0, le=1e9)] = 0.0
    ticks: Count = 0
    skipped: Count = 0
    faults: Count = 0
    refused: dict[str, Count] = {}  # noqa: RUF012 - msgspec copies it
    last_refusal: str = ""
    stops: StopIds = ()
    motion: Id | None = None
    progress: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    outcomes: tuple[MotionOutcome, ...] = ()
    modes: tuple[Mode, ...] = ("position",)
    instant: Interval = 0
    received: Id | None = None
    transit_excess: Interval | None = None


def with_short_texts(state: DriverState) -> DriverState:
    """``state`` with at most ``MAX_STATE_TEXT_LENGTH`` characters of each text: readers refuse large ones."""
    texts = {
        name: _encodable(_cut(getattr(state, name)))
        for name in ("program", "reason", "commander", "last_refusal")
    }
    return msgspec.structs.replace(state, **texts)


def _cut(text: str) -> str:
    more = len(text) - MAX_STATE_TEXT_LENGTH
    return text if more <= 0 else f"{text[:MAX_STATE_TEXT_LENGTH]}... and {more} more characters"


def state_text(state: DriverState) -> str:
    """The state of a driver and its commander or reason, in one line."""
    reason = printable(state.reason)
    if state.state == "active":
        return f"active, commanded by {printable(state.commander)}"
    if not reason or reason.startswith(f"{state.state} by "):
        return reason or state.state
    return f"{state.state}: {reason}"


def message_fields(message: Message) -> dict[str, Any]:
    """The fields of a message without blocks by name, as JSON has them."""
    return dict(zip(message.__struct_fields__, msgspec.to_builtins(message), strict=True))


def message_from_fields(kind: type[M], fields: Mapping[str, Any]) -> M:
    """The message with these ``fields``; others are ignored. Raises MessageError ("malformed")."""
    # Fields are appended only: those that a file of an earlier version lacks are the last ones.
    known = takewhile(fields.__contains__, kind.__struct_fields__)
    try:
        return msgspec.convert([fields[name] for name in known], kind)
    except msgspec.ValidationError as error:
        raise MessageError(f"a malformed {kind.__name__}: {error}", reason="malformed") from None


class StaticTransforms(Message, frozen=True, array_like=True, gc=False):
    """All static edges of one writer: row i of ``poses`` is ``parent_from_child`` of ``edges[i]``."""

    session: SessionId
    edges: Edges
    poses: bytes

    def __post_init__(self) -> None:
        _check_poses(self.poses, self.edges)


class RobotDescription(Message, frozen=True, array_like=True, gc=False):
    """The URDF of a robot, and the facts that a reader without a URDF parser needs.

    ``joint_names`` is the order of joint samples, ``moving_edges`` that of transform samples;
    ``clock`` is the domain of all stamps: "system", the name of a simulated clock, or empty if the wire
    format does not carry it.
    """

    session: SessionId
    urdf: str
    digest: str
    joint_names: tuple[str, ...]
    moving_edges: Edges
    clock: str = "system"


SCAN_RAYS = 100_000
"""The most rays of a laser scan."""


class LaserScan(StampedMessage, frozen=True, array_like=True, gc=False):
    """One scan of a planar laser, which measures its rays one after the other.

    Ray i has the angle ``angle_min + i * angle_increment`` [rad], from the x axis of ``frame`` about its z
    axis, and the stamp ``stamp + i * ray_ns``. ``ray_ns`` is zero if it is not known, and so is ``scan_ns``,
    the time between two scans. ``ranges`` [m] is a block of float32. A range outside of ``range_min`` to
    ``range_max`` is no measurement: -inf if too near, inf without an echo, NaN if invalid (REP 117).
    ``intensities`` is None or such a block, in units of the device. ``frame`` is named as in edges.
    """

    frame: str
    angle_min: float
    angle_increment: float
    ray_ns: Interval
    scan_ns: Interval
    range_min: float
    range_max: float
    ranges: bytes
    intensities: bytes | None = None

    def __post_init__(self) -> None:
        _check_frame(self.frame)
        _check_finite("angles", self.angle_min, self.angle_increment)
        if not 0.0 <= self.range_min <= self.range_max or self.range_min == inf:
            limits = f"{self.range_min} and {self.range_max}"
            raise InvalidInput(f"a scan has 0 <= range_min <= range_max, range_min finite, not {limits}")
        count, rest = divmod(len(self.ranges), _FLOAT32.itemsize)
        if rest:
            raise InvalidInput(f"a block of float32 has a multiple of 4 bytes, not {len(self.ranges)}")
        if count > SCAN_RAYS:
            raise InvalidInput(
                f"a scan of {count} rays, where {SCAN_RAYS} are allowed: publish it in several scans"
            )
        if self.intensities is not None and len(self.intensities) != len(self.ranges):
            raise InvalidInput(
                f"{count} ranges take as many intensities; got {len(self.intensities)} bytes, not {4 * count}"
            )
        last_stamp = self.stamp + count * self.ray_ns
        if min(self.ray_ns, self.scan_ns) < 0 or max(last_stamp, self.scan_ns) >= 2**63:
            raise InvalidInput(
                f"{count} rays of {self.ray_ns} ns each, in a scan of {self.scan_ns} ns: times are not "
                "negative, and the stamp of the last ray has 64 bits"
            )


MAX_RATE, MAX_ACCELERATION = 1e3, 1e5
"""[rad/s] and [m/s^2]: more in any axis is no reading of a sensor, but a fault of memory or of units."""

MAX_SPEED, MAX_DISTANCE = 1e4, 1e8
"""[m/s] and [m], likewise: above the speed of satellites, and twice the circumference of the Earth."""


class Imu(StampedMessage, frozen=True, array_like=True, gc=False):
    """One reading of an inertial measurement unit, in the axes of ``frame``, which is named as in edges.

    ``gyro`` [rad/s] and ``accel`` [m/s^2] are blocks of x y z. The accelerometer measures specific force:
    at rest +9.81 along the axis that points up. ``orientation``, None for a device that has none, is a block
    of the quaternion x y z w of ``frame`` in axes that the device defines. Each covariance is a block of six
    numbers, the upper triangle row by row, or None if it is not known; that of the orientation is in rad^2.
    """

    frame: str
    gyro: bytes
    accel: bytes
    orientation: bytes | None = None
    gyro_covariance: bytes | None = None
    accel_covariance: bytes | None = None
    orientation_covariance: bytes | None = None

    def __post_init__(self) -> None:
        _check_frame(self.frame)
        _check_limit("angular velocities", _finite_numbers("angular velocities", self.gyro, 3), MAX_RATE)
        _check_limit("accelerations", _finite_numbers("accelerations", self.accel, 3), MAX_ACCELERATION)
        _check_covariance("angular velocities", self.gyro_covariance, 3)
        _check_covariance("accelerations", self.accel_covariance, 3)
        _check_covariance("an orientation", self.orientation_covariance, 3)
        if self.orientation is not None:
            _check_quaternion(_finite_numbers("an orientation", self.orientation, 4))
        elif self.orientation_covariance is not None:
            raise InvalidInput("the covariance of an orientation needs an orientation")


class Velocity(StampedMessage, frozen=True, array_like=True, gc=False):
    """A measured velocity of ``frame`` relative to the world, in its own axes.

    ``linear`` [m/s], of its origin, and ``angular`` [rad/s] are blocks of x y z; ``angular`` is None if it
    was not measured. ``covariance`` is a block of the upper triangle row by row: 6 numbers of ``linear``, or
    21 of both; None if it is not known. ``frame`` is named as in edges.
    """

    frame: str
    linear: bytes
    angular: bytes | None = None
    covariance: bytes | None = None

    def __post_init__(self) -> None:
        _check_frame(self.frame)
        _check_limit("velocities", _finite_numbers("velocities", self.linear, 3), MAX_SPEED)
        if self.angular is not None:
            _check_limit(
                "angular velocities", _finite_numbers("angular velocities", self.angular, 3), MAX_RATE
            )
        _check_covariance("velocities", self.covariance, 3 if self.angular is None else 6)


class Pose(StampedMessage, frozen=True, array_like=True, gc=False):
    """A measured pose of ``child`` in ``parent``, which are named as in edges; it is no edge of the tree.

    ``child`` is empty for the base of the robot, which ROS does not name. ``pose`` is a block of
    ``parent_from_child``: x y z [m], qx qy qz qw. ``covariance`` is a block of the upper triangle, 21 numbers
    as in WriterTransforms, or None if it is not known.
    """

    parent: str
    child: str
    pose: bytes
    covariance: bytes | None = None

    def __post_init__(self) -> None:
        _check_frame(self.parent)
        if self.child:
            _check_frame(self.child)
        numbers = _finite_numbers("a pose", self.pose, 7)
        _check_limit("positions", numbers[:3], MAX_DISTANCE)
        _check_quaternion(numbers[3:])
        _check_covariance("a pose", self.covariance, 6)


def with_child(pose: Pose, child: str) -> Pose:
    """The same pose of another frame."""
    return msgspec.structs.replace(pose, child=child)


_Measurement = TypeVar("_Measurement", bound="Imu | Velocity | Pose")


def with_full_names(message: _Measurement, robot: str) -> _Measurement:
    """The same message of ``robot`` with the full names of its frames. Raises InvalidInput."""
    if isinstance(message, Pose):
        parent, child = full_name(robot, message.parent), message.child and full_name(robot, message.child)
        return msgspec.structs.replace(message, parent=parent, child=child)
    return msgspec.structs.replace(message, frame=full_name(robot, message.frame))


def covariance_matrix(triangle: bytes) -> NDArray[np.float64]:
    """The matrix with an upper triangle, a block row by row: (3, 3) of 6 numbers, (6, 6) of 21."""
    size = 3 if len(triangle) == 6 * 8 else 6
    matrix, upper = np.empty((size, size)), _UPPER_TRIANGLES[size]
    matrix[upper] = matrix.T[upper] = from_block(triangle)
    return matrix


"""The most cells of an occupancy grid."""


class OccupancyGrid(Message, frozen=True, array_like=True, gc=False):
    """A map of square cells: the probability that a cell is occupied [%], or -1 if not known.

    ``cells`` are int8, row by row: each of the ``height`` rows has ``width`` cells along the grid's x axis,
    and rows follow its y axis. A cell has edges of ``resolution`` [m]. ``origin`` is a block of one pose,
    ``frame_from_grid``, at the corner of the first cell. ``frame`` is named as in edges; ``stamp`` [ns] is
    the time of the map.
    """

    session: SessionId
    stamp: Stamp
    frame: str
    resolution: float
    width: Count
    height: Count
    origin: bytes
    cells: bytes

    def __post_init__(self) -> None:
        _check_frame(self.frame)
        if not 0.0 < self.resolution < inf:
            raise InvalidInput(f"the resolution of a grid is positive and finite [m], not {self.resolution}")
        if len(self.origin) != POSE_BYTES:
            raise InvalidInput(f"the origin is a pose of {POSE_BYTES} bytes, not {len(self.origin)}")
        _check_finite("an origin", *from_block(self.origin).tolist())
        if min(self.width, self.height) < 0 or len(self.cells) != self.width * self.height:
            raise InvalidInput(
                f"a grid of {self.width} x {self.height} needs as many cells, not {len(self.cells)}"
            )
        if len(self.cells) > GRID_CELLS:
            raise InvalidInput(
                f"a grid of {len(self.cells)} cells, where {GRID_CELLS} are allowed (4096 x 4096)"
            )
        values = np.frombuffer(self.cells, dtype=np.int8)
        if values.size and not -1 <= values.min() <= values.max() <= 100:
            raise InvalidInput(
                f"cells are from -1 (not known) to 100 (occupied), not {values.min()} to {values.max()}"
            )


def cells_of(grid: OccupancyGrid) -> NDArray[np.int8]:
    """The cells of ``grid``: (height, width), read-only, sharing its memory; row 0 is at the origin."""
    return np.frombuffer(grid.cells, dtype=np.int8).reshape(grid.height, grid.width)


class ClockMessage(StampedMessage, frozen=True, array_like=True, gc=False):
    """The simulated time, or the reply of one writer's clock."""


class Status(Message, frozen=True, array_like=True, gc=False):
    """The state of a writer.

    ``level`` is "ok"; "warn" if it is late, cannot publish some of its input, or its program gives a warning
    (also in ``values``); "error" if it cannot publish any; "stale" without new input. ``text`` is the reason.
    ``rate_hz`` counts the samples of the last second, ``sent`` all samples, ``late`` the ticks that began
    more than a period after they were due; ``values`` has further facts. ``stamp`` [ns] is of the system
    clock of ``host``, also if samples carry simulated time.
    """

    stamp: Stamp
    session: SessionId
    level: Level
    program: str
    host: str
    pid: Count
    rate_hz: float
    sent: Count
    late: Count
    text: str = ""
    values: dict[str, str] = {}  # noqa: RUF012 - likewise


class HistoryPage(Message, frozen=True, array_like=True, gc=False):
    """Cached samples, oldest first, each as published under ``encoding``.

    ``before`` is the ``seq`` of the first, for the request of the next page; None if no older one is kept.
    """

    encoding: str
    samples: tuple[bytes, ...]
    before: Count | None = None


def _check_numbers(*blocks: bytes | None) -> None:
    for block in blocks:
        if block is not None and len(block) % 8:
            raise InvalidInput(f"a block of float64 has a multiple of 8 bytes, not {len(block)}")


def _check_named(names: Sequence[str], *blocks: bytes | None) -> None:
    for block in blocks:
        if block is not None and len(block) != 8 * len(names):
            raise InvalidInput(f"{len(names)} names need as many numbers, not {len(block) // 8}")


def _check_frame(frame: str) -> None:
    if not 0 < len(frame) <= MAX_FRAME_NAME_LENGTH:
        raise InvalidInput(
            f"the name of a frame has 1 to {MAX_FRAME_NAME_LENGTH} characters, not {len(frame)}; name the "
            "frame of the measurement or of the grid"
        )
    if frame[0] == "/" or frame[-1] == "/" or not frame.isprintable():
        raise InvalidInput(
            f"{frame!r} is no name of a frame: it has a slash at its end, or control characters; write "
            "'frame' or 'robot/frame'"
        )


def _check_finite(what: str, *numbers: float) -> None:
    if not all(map(isfinite, numbers)):
        raise InvalidInput(f"{what} of finite numbers are needed, not {', '.join(map(str, numbers))}")


def _finite_numbers(what: str, block: bytes, count: int) -> tuple[float, ...]:
    """The numbers of ``block``. Raises InvalidInput unless they are ``count`` finite ones."""
    if len(block) != 8 * count:
        raise InvalidInput(f"{what} of {count} numbers take {8 * count} bytes, not {len(block)}")
    numbers = struct.unpack(f"<{count}d", block)
    _check_finite(what, *numbers)
    return numbers


def _check_limit(what: str, numbers: Sequence[float], limit: float) -> None:
    if max(map(abs, numbers)) > limit:
        raise InvalidInput(f"{what} of sensors are at most {limit:g}; got {', '.join(map(str, numbers))}")


def _check_quaternion(quaternion: Sequence[float]) -> None:
    length = sqrt(sum(number * number for number in quaternion))
    if not abs(length - 1.0) <= _UNIT_TOLERANCE:
        raise InvalidInput(f"an orientation is a quaternion of length 1, not {length:.6g}")


def _check_covariance(what: str, triangle: bytes | None, size: int) -> None:
    """Raise InvalidInput unless it is None or the upper triangle of a covariance of ``size`` numbers."""
    if triangle is None:
        return
    numbers = _finite_numbers(f"a covariance of {what}", triangle, size * (size + 1) // 2)
    first, variances = 0, list[float]()
    for row in range(size):
        variances.append(numbers[first])
        first += size - row
    if min(variances) < 0.0:
        raise InvalidInput(f"variances of {what} are not negative; got {variances}")


def _check_poses(block: bytes, edges: Edges | None) -> None:
    count, rest = divmod(len(block), POSE_BYTES)
    if rest:
        raise InvalidInput(f"a block of poses has a multiple of {POSE_BYTES} bytes, not {len(block)}")
    if edges is not None and len(edges) != count:
        raise InvalidInput(f"{len(edges)} edges need as many poses, not {count}")


def _check_order(order: bytes, items: Sequence[str] | Sequence[tuple[str, str]]) -> None:
    if order != order_digest(items):
        raise InvalidInput(f"the digest {order.hex()} is not that of the order sent with it")


ATTACHMENT_BYTES = 1_024
STATIC_EDGES = 10_000

_OVERHEAD = 200
"""The least size of a decoded message without its numbers and names [bytes]."""


def check_size(stream: StreamName, size: int, factor: int = 1) -> None:
    """Raise MessageError for a payload of ``size`` bytes that is too large for ``stream``."""
    limit = stream_named(stream).max_bytes * factor
    if size > limit:
        raise MessageError(f"{size} bytes on {stream}, where {limit} are allowed", reason="too large")


def check_edges(message: Message) -> None:
    """Raise MessageError for more than 10,000 static edges in one message."""
    if isinstance(message, StaticTransforms) and len(message.edges) > STATIC_EDGES:
        text = f"{len(message.edges)} static edges of one writer, where {STATIC_EDGES} are allowed"
        raise MessageError(text, reason="too large")


def message_size(message: Message) -> int:
    """The approximate memory of a decoded sample [bytes]."""
    if isinstance(message, JointState):
        blocks = len(message.positions) + len(message.velocities or b"") + len(message.efforts or b"")
        return _OVERHEAD + blocks + 60 * len(message.names or ())
    if isinstance(message, TransformSample):
        size = _OVERHEAD + len(message.poses) + 200 * len(message.edges or ())
        return size + 3 * len(message.poses) if isinstance(message, WriterTransforms) else size
    return _OVERHEAD
