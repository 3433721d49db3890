"""Message types of the core on the native wire (frozen msgspec structs).

A block is the bytes of consecutive little-endian float64: ``to_block`` makes one of an array, ``from_block``
reads it without a copy. Fields are encoded by position, so a later
version may append fields, which today's readers skip; any other change needs a new version. The limits bound
the memory that a writer can make a reader use.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from hashlib import blake2b
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from zstate.errors import InvalidInput, MessageError
from zstate.message import Count, Message, SessionId, Stamp, StampedMessage
from zstate.stream_registry import stream_named
from zstate.streams import KILOBYTE, SAMPLE_BYTES, StreamName
from zstate.transform import COVARIANCE_NUMBERS

Edges = tuple[tuple[str, str], ...]
Interval = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Digest = Annotated[bytes, Meta(min_length=8, max_length=8)]
Level = Literal["ok", "warn", "error", "stale"]

POSE_BYTES = 7 * 8
_FLOAT64 = np.dtype("<f8")


def to_block(values: ArrayLike) -> bytes:
    """The block of an array of any shape, row by row."""
    return np.asarray(values, dtype=_FLOAT64).tobytes()


def from_block(block: bytes) -> NDArray[np.float64]:
    """The numbers of a block: (n,), read-only, sharing the block's memory."""
    return np.frombuffer(block, dtype=_FLOAT64)


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


def session_of(message: Message) -> int:
    """The session of the writer of ``message``, which all messages of streams have."""
    session: int = getattr(message, "session")  # noqa: B009 - their classes have no other base in common
    return session


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
            check_numbers(self.positions, self.velocities, self.efforts)
        if self.names is not None:
            check_named(self.names, self.positions, self.velocities, self.efforts)
            check_order(self.order, self.names)


class TransformSample(Sample, frozen=True, array_like=True, gc=False):
    """Every moving edge of a robot at one instant.

    ``poses`` is a block of ``parent_from_child``, seven numbers for each edge. The edges are ``edges``, or
    ``RobotDescription.moving_edges`` if None.
    """

    poses: bytes
    edges: Edges | None = None

    def __post_init__(self) -> None:
        check_poses(self.poses, self.edges)
        if self.edges is not None:
            check_order(self.order, self.edges)


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
        check_poses(self.poses, self.edges)
        check_order(self.order, self.edges)
        if self.covariances is not None and len(self.covariances) != 3 * len(self.poses):
            raise InvalidInput(
                f"{len(self.poses) // POSE_BYTES} poses take 21 numbers of covariance each; got "
                f"{len(self.covariances)} bytes"
            )


def edge_of(sample: WriterTransforms) -> WriterTransforms:
    """The edges of ``sample`` and their poses, without further fields that the message of a plugin has."""
    head = (sample.stamp, sample.seq, sample.session, sample.order)
    return WriterTransforms(*head, sample.poses, sample.edges, sample.covariances)


def covariances_of(sample: TransformSample) -> NDArray[np.float64] | None:
    """The covariances of the edges of a sample: (n, 21), read-only, NaN where not known; None if none is."""
    if not isinstance(sample, WriterTransforms) or sample.covariances is None:
        return None
    return from_block(sample.covariances).reshape(-1, COVARIANCE_NUMBERS)


class StaticTransforms(Message, frozen=True, array_like=True, gc=False):
    """All static edges of one writer: row i of ``poses`` is ``parent_from_child`` of ``edges[i]``."""

    session: SessionId
    edges: Edges
    poses: bytes

    def __post_init__(self) -> None:
        check_poses(self.poses, self.edges)


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


class ClockMessage(StampedMessage, frozen=True, array_like=True, gc=False):
    """The simulated time, or the reply of one writer's clock."""

    type_name = "Clock"
    max_bytes = KILOBYTE


class Status(Message, frozen=True, array_like=True, gc=False):
    """The state of a writer.

    ``level`` is "ok"; "warn" if it is late, cannot publish some of its input, or its program gives a warning
    (also in ``values``); "error" if it cannot publish any; "stale" without new input. ``text`` is the reason.
    ``rate_hz`` counts the samples of the last second, ``sent`` all samples, ``late`` the ticks that began
    more than a period after they were due; ``values`` has further facts. ``stamp`` [ns] is of the system
    clock of ``host``, also if samples carry simulated time.
    """

    max_bytes = 64 * KILOBYTE

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

    type_name = "Past"
    max_bytes = 4 * SAMPLE_BYTES

    encoding: str
    samples: tuple[bytes, ...]
    before: Count | None = None


def check_numbers(*blocks: bytes | None) -> None:
    """Raise InvalidInput unless each of ``blocks`` is one of float64, or None."""
    for block in blocks:
        if block is not None and len(block) % 8:
            raise InvalidInput(f"a block of float64 has a multiple of 8 bytes, not {len(block)}")


def check_named(names: Sequence[str], *blocks: bytes | None) -> None:
    """Raise InvalidInput unless each of ``blocks`` has one number for each of ``names``, or is None."""
    for block in blocks:
        if block is not None and len(block) != 8 * len(names):
            raise InvalidInput(f"{len(names)} names need as many numbers, not {len(block) // 8}")


def check_poses(block: bytes, edges: Edges | None) -> None:
    """Raise InvalidInput unless ``block`` is one of poses, of as many as ``edges`` if these are given."""
    count, rest = divmod(len(block), POSE_BYTES)
    if rest:
        raise InvalidInput(f"a block of poses has a multiple of {POSE_BYTES} bytes, not {len(block)}")
    if edges is not None and len(edges) != count:
        raise InvalidInput(f"{len(edges)} edges need as many poses, not {count}")


def check_order(order: bytes, items: Sequence[str] | Sequence[tuple[str, str]]) -> None:
    """Raise InvalidInput unless ``order`` is the digest of ``items``."""
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
