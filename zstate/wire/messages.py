"""What is said: the messages of the native wire, as frozen values.

Numbers stand in blocks: little-endian float64, one after the other, as bytes. ``to_block`` makes
one of an array, ``from_block`` reads it without a copy. Fields travel by position, so a later
version may append some and today's readers pass over them; anything else needs a new version.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from hashlib import blake2b
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import ArrayLike, NDArray

from zstate.errors import InvalidInput

Edges = tuple[tuple[str, str], ...]
Stamp = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Count = Annotated[int, Meta(ge=0)]
Digest = Annotated[bytes, Meta(min_length=8, max_length=8)]
Level = Literal["ok", "warn", "error", "stale"]

POSE_BYTES = 7 * 8
_FLOAT64 = np.dtype("<f8")


def to_block(values: ArrayLike) -> bytes:
    """Numbers of any shape as a block, row by row."""
    return np.asarray(values, dtype=_FLOAT64).tobytes()


def from_block(block: bytes) -> NDArray[np.float64]:
    """The numbers of a block: (n,), read-only, sharing the block's memory."""
    return np.frombuffer(block, dtype=_FLOAT64)


def poses_from_block(block: bytes) -> NDArray[np.float64]:
    """The poses of a block: (n, 7), x y z [m], qx qy qz qw; read-only, sharing its memory."""
    return np.frombuffer(block, dtype=_FLOAT64).reshape(-1, 7)


def order_digest(order: Sequence[str] | Sequence[tuple[str, str]]) -> bytes:
    """8 bytes that tell one joint order (names) or edge order ((parent, child) pairs) from another.

    BLAKE2b of the order as a MessagePack array.
    """
    return _order_digest(tuple(order))


# A writer that names its numbers in full does so in each sample.
@lru_cache(maxsize=256)
def _order_digest(order: tuple[object, ...]) -> bytes:
    return blake2b(msgspec.msgpack.encode(order), digest_size=8).digest()


class Message(Struct, frozen=True, array_like=True, gc=False):
    """What every message of the native wire is."""


class Sample(Message, frozen=True, array_like=True, gc=False):
    """One instant of a robot.

    ``stamp`` [ns] says when; ``seq`` grows by one with each sample of a ``session``, which is drawn
    at random when a writer starts; ``order`` is the digest of the order of the numbers.
    """

    stamp: Stamp
    seq: Count
    session: Count
    order: Digest


class JointState(Sample, frozen=True, array_like=True, gc=False):
    """The joint positions of a whole robot at one instant, with velocities and efforts if known.

    Blocks in the order whose digest is ``order``. A writer that has no model tells the ``names`` of
    that order in full, one number for each.
    """

    positions: bytes
    velocities: bytes | None = None
    efforts: bytes | None = None
    names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if len(self.positions) % 8 or self.velocities is not None or self.efforts is not None:
            _check_numbers(self.positions, self.velocities, self.efforts)
        if self.names is not None:
            _check_names(self)


class TransformSample(Sample, frozen=True, array_like=True, gc=False):
    """Every moving edge of a robot at one instant.

    ``poses`` is a block of ``parent_from_child``, seven numbers for each edge. The edges stand in
    ``RobotDescription.moving_edges``, or here when there is no description.
    """

    poses: bytes
    edges: Edges | None = None

    def __post_init__(self) -> None:
        _check_poses(self.poses, self.edges)
        if self.edges is not None:
            _check_order(self.order, self.edges)


class JointCommand(Sample, frozen=True, array_like=True, gc=False):
    """What a driver is asked to do; blocks that are not commanded are None."""

    positions: bytes | None = None
    velocities: bytes | None = None
    efforts: bytes | None = None

    def __post_init__(self) -> None:
        _check_numbers(self.positions, self.velocities, self.efforts)


class StaticTransforms(Message, frozen=True, array_like=True, gc=False):
    """All static edges of one writer: row i of ``poses`` is ``parent_from_child`` of ``edges[i]``."""

    session: Count
    edges: Edges
    poses: bytes

    def __post_init__(self) -> None:
        _check_poses(self.poses, self.edges)


class RobotDescription(Message, frozen=True, array_like=True, gc=False):
    """What the robot is: its URDF, and what a reader without a URDF parser needs of it.

    ``joint_names`` is the order of joint samples, ``moving_edges`` that of transform samples;
    ``clock`` is the domain of all stamps: "system", the name of a simulated one, or empty where the wire
    does not tell.
    """

    session: Count
    urdf: str
    digest: str
    joint_names: tuple[str, ...]
    moving_edges: Edges
    clock: str = "system"


class ClockMessage(Message, frozen=True, array_like=True, gc=False):
    """What time it is: simulated, or by the clock of a writer that was asked."""

    stamp: Stamp
    seq: Count
    session: Count


class Status(Message, frozen=True, array_like=True, gc=False):
    """How a writer does.

    ``level`` is "ok"; "warn" when it is late or some of what it was given cannot be said; "error" when
    none of it can; "stale" when it was given nothing new. ``text`` says why. ``rate_hz`` counts the
    samples of the last second, ``sent`` all of them, ``late`` the ticks that began more than a period
    after they were due; ``values`` is what else there is to know. ``stamp`` [ns] is by the system's
    clock of ``host``, also where samples carry simulated time.
    """

    stamp: Stamp
    session: Count
    level: Level
    program: str
    host: str
    pid: Count
    rate_hz: float
    sent: Count
    late: Count
    text: str = ""
    values: dict[str, str] = {}


class HistoryPage(Message, frozen=True, array_like=True, gc=False):
    """Samples that were sent before, oldest first, each as it was sent under ``encoding``.

    ``before`` is the ``seq`` of the first of them: what to ask for next; None when nothing older is kept.
    """

    encoding: str
    samples: tuple[bytes, ...]
    before: Count | None = None


def _check_numbers(*blocks: bytes | None) -> None:
    for block in blocks:
        if block is not None and len(block) % 8:
            raise InvalidInput(f"a block of float64 has a multiple of 8 bytes, not {len(block)}")


def _check_poses(block: bytes, edges: Edges | None) -> None:
    count, rest = divmod(len(block), POSE_BYTES)
    if rest:
        raise InvalidInput(f"a block of poses has a multiple of {POSE_BYTES} bytes, not {len(block)}")
    if edges is not None and len(edges) != count:
        raise InvalidInput(f"{len(edges)} edges need as many poses, not {count}")


def _check_names(state: JointState) -> None:
    names = state.names or ()
    for block in (state.positions, state.velocities, state.efforts):
        if block is not None and len(block) != 8 * len(names):
            raise InvalidInput(f"{len(names)} names need as many numbers, not {len(block) // 8}")
    _check_order(state.order, names)


def _check_order(order: bytes, items: Sequence[str] | Sequence[tuple[str, str]]) -> None:
    if order != order_digest(items):
        raise InvalidInput(f"the digest {order.hex()} is not that of the order sent with it")
