"""What the messages of measurements share: checks of their fields, blocks of float32, and fields by name."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from itertools import takewhile
from math import isfinite, sqrt
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.checks import QUATERNION_TOLERANCE
from zstate.errors import InvalidInput, MessageError
from zstate.message import Message, StampedMessage
from zstate.streams import Stream
from zstate.wire.keys import MAX_FRAME_NAME_LENGTH
from zstate.wire.messages import from_block

M = TypeVar("M", bound=Message)
S = TypeVar("S", bound=StampedMessage)

FLOAT32_BYTES = 4
_ENCODER = msgspec.msgpack.Encoder()
_FLOAT32 = np.dtype("<f4")
_UPPER_TRIANGLES = {size: np.triu_indices(size) for size in (3, 6)}


def to_float32_block(values: ArrayLike) -> bytes:
    """``to_block`` in float32."""
    return np.asarray(values, dtype=_FLOAT32).tobytes()


def from_float32_block(block: bytes) -> NDArray[np.float32]:
    """``from_block`` in float32."""
    return np.frombuffer(block, dtype=_FLOAT32)


def with_field(message: M, name: str, value: object) -> M:
    """The same message with another value of the field ``name``."""
    return msgspec.structs.replace(message, **{name: value})


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


def covariance_matrix(triangle: bytes) -> NDArray[np.float64]:
    """The matrix with an upper triangle, a block row by row: (3, 3) of 6 numbers, (6, 6) of 21."""
    size = 3 if len(triangle) == 6 * 8 else 6
    matrix, upper = np.empty((size, size)), _UPPER_TRIANGLES[size]
    matrix[upper] = matrix.T[upper] = from_block(triangle)
    return matrix


def check_frame(frame: str) -> None:
    """Raise InvalidInput unless ``frame`` is the name of a frame, bare or with that of its robot."""
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


def check_finite(what: str, *numbers: float) -> None:
    """Raise InvalidInput unless ``numbers``, of ``what``, are finite."""
    if not all(map(isfinite, numbers)):
        raise InvalidInput(f"{what} of finite numbers are needed, not {', '.join(map(str, numbers))}")


def finite_numbers(what: str, block: bytes, count: int) -> tuple[float, ...]:
    """The numbers of ``block``. Raises InvalidInput unless they are ``count`` finite ones."""
    if len(block) != 8 * count:
        raise InvalidInput(f"{what} of {count} numbers take {8 * count} bytes, not {len(block)}")
    numbers = struct.unpack(f"<{count}d", block)
    check_finite(what, *numbers)
    return numbers


def check_limit(what: str, numbers: Sequence[float], limit: float) -> None:
    """Raise InvalidInput if one of ``numbers``, of ``what``, is beyond ``limit`` in either direction."""
    if max(map(abs, numbers)) > limit:
        raise InvalidInput(f"{what} of sensors are at most {limit:g}; got {', '.join(map(str, numbers))}")


def check_quaternion(quaternion: Sequence[float]) -> None:
    """Raise InvalidInput unless ``quaternion`` has the length 1."""
    length = sqrt(sum(number * number for number in quaternion))
    if not abs(length - 1.0) <= QUATERNION_TOLERANCE:
        raise InvalidInput(f"an orientation is a quaternion of length 1, not {length:.6g}")


def check_covariance(what: str, triangle: bytes | None, size: int) -> None:
    """Raise InvalidInput unless it is None or the upper triangle of a covariance of ``size`` numbers."""
    if triangle is None:
        return
    numbers = finite_numbers(f"a covariance of {what}", triangle, size * (size + 1) // 2)
    first, variances = 0, list[float]()
    for row in range(size):
        variances.append(numbers[first])
        first += size - row
    if min(variances) < 0.0:
        raise InvalidInput(f"variances of {what} are not negative; got {variances}")


def new_message(row: Stream, stamp: int, fields: Mapping[str, Any]) -> StampedMessage:
    """The message of ``row`` with ``fields``, not numbered yet.

    Raises InvalidInput for fields that it does not have, that are missing, or of other types.
    """
    kind = row.type
    assert issubclass(kind, StampedMessage)  # of measurements
    try:
        # Types are checked as a reader does it: a constructor checks none.
        return msgspec.msgpack.decode(_ENCODER.encode(kind(stamp, 0, 0, **fields)), type=kind)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        own = ", ".join(kind.__struct_fields__[len(StampedMessage.__struct_fields__) :])
        raise InvalidInput(f"no message of {row.name}, whose fields are {own}: {error}") from None


def renumbered(message: S, seq: int, session: int) -> S:
    """The same message as that of another ``session``, in which it has the number ``seq``."""
    return msgspec.structs.replace(message, seq=seq, session=session)
