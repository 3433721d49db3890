"""Messages between commanders and drivers, on the native wire."""

from __future__ import annotations

from math import inf
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from zstate.errors import InvalidInput, printable
from zstate.message import Count, Message, SessionId, Stamp, StampedMessage
from zstate.streams import KILOBYTE, MEGABYTE, SAMPLE_BYTES
from zstate.wire.messages import Interval, Sample, check_named, check_numbers, check_order, from_block

Mode = Literal["position", "velocity", "effort"]
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
        check_numbers(*blocks)
        if self.names is not None:
            check_named(self.names, *blocks)
            check_order(self.order, self.names)


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

    max_bytes = 4 * MEGABYTE

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
        check_numbers(self.times)
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

    max_bytes = KILOBYTE

    motion: Count


class MotionReply(Message, frozen=True, array_like=True, gc=False):
    """The reply of a driver to a request, which is accepted if there are no ``findings``.

    ``session`` is that of the driver's DriverState. A motion is valid for ``ttl`` [ns], unless it is renewed.
    """

    max_bytes = 256 * KILOBYTE

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

    max_bytes = SAMPLE_BYTES

    how: Literal["hold", "relax"]
    reason: str = ""

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "reason", stop_text(self.reason))

    @staticmethod
    def unpack(payload: bytes) -> bytes:
        head = _STOP_DECODER.decode(payload)
        encoded = bytes(head.reason)
        try:
            _TEXT_DECODER.decode(encoded)
        except msgspec.ValidationError:  # it is no text
            raise
        except (UnicodeDecodeError, msgspec.DecodeError):  # the latter since msgspec 0.23
            reason = encoded[_TEXT_HEADERS.get(encoded[0], 1) :].decode("utf-8", "replace")
            return msgspec.msgpack.encode((head.stamp, head.seq, head.session, head.how, reason))
        return payload


class _StopHead(msgspec.Struct, array_like=True, gc=False):
    """The fields of a Stop, its reason as it is encoded."""

    stamp: Stamp
    seq: Count
    session: SessionId
    how: Literal["hold", "relax"]
    reason: msgspec.Raw = msgspec.Raw(b"\xa0")


_STOP_DECODER = msgspec.msgpack.Decoder(_StopHead)
_TEXT_DECODER = msgspec.msgpack.Decoder(str)
_TEXT_HEADERS = {0xD9: 2, 0xDA: 3, 0xDB: 5}
"""The size of the header of a str by its first byte; one byte for all others [MessagePack]."""


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

    max_bytes = 64 * KILOBYTE

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

    max_bytes = 256 * KILOBYTE

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


def with_encodable_fields(state: DriverState) -> DriverState:
    """``state`` with empty values in place of those that cannot be encoded."""
    empty = DriverState(0, 0, "", state.state, "", (), 0)
    fields = {name: getattr(state, name) for name in state.__struct_fields__}
    for name, value in fields.items():
        try:
            msgspec.msgpack.encode(value)
        except Exception:  # it has several, one for each type
            fields[name] = getattr(empty, name)
    return DriverState(**fields)


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
