"""Stamps as ROS 2 writes them: ``builtin_interfaces/Time``, whole seconds and the nanoseconds beyond."""

from __future__ import annotations

from struct import Struct

from zstate.errors import InvalidInput, MessageError

STAMP_BYTES = 8

_SECOND = 1_000_000_000
_EARLIEST, _LATEST = -(2**31) * _SECOND, 2**31 * _SECOND - 1
_TIME = Struct("<iI")


def to_time(stamp: int) -> tuple[int, int]:
    """``stamp`` [ns] as (sec, nanosec); nanosec counts forwards, before 1970 too.

    Raises InvalidInput outside the years 1901 to 2038, which are all that ROS 2 has seconds for.
    """
    if not _EARLIEST <= stamp <= _LATEST:
        raise InvalidInput(
            f"ROS 2 cannot say the stamp {stamp}: its seconds are an int32, which ends in 1901 and in 2038; "
            "stamps are nanoseconds since 1970"
        )
    return divmod(stamp, _SECOND)


def from_time(sec: int, nanosec: int) -> int:
    """The stamp [ns] of a time. Raises MessageError when ``nanosec`` is a second or more."""
    if nanosec >= _SECOND:
        raise MessageError(
            f"a time of {sec} s and {nanosec} ns: the nanoseconds are below {_SECOND}", reason="malformed"
        )
    return sec * _SECOND + nanosec


def pack_stamp(stamp: int) -> bytes:
    """The 8 bytes of ``stamp`` in a little-endian message. Raises InvalidInput as ``to_time`` does."""
    return _TIME.pack(*to_time(stamp))


def unpack_stamps(times: bytes) -> tuple[int, ...]:
    """The stamps of little-endian times, one after the other. Raises MessageError as ``from_time`` does."""
    return tuple(from_time(sec, nanosec) for sec, nanosec in _TIME.iter_unpack(times))
