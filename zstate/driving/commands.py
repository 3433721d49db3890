"""Commands as they arrive at a driver: checks, and the targets of its joints until they expire."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.checks import Floats
from zstate.driving.driver import Mode
from zstate.driving.messages import JointCommand
from zstate.driving.setpoint_limiter import JointRate, Rates
from zstate.driving.transit import CommandAdmission
from zstate.errors import InvalidInput, MessageError, format_duration, printable
from zstate.net.presence import announce
from zstate.net.session import Session
from zstate.net.stream_inbox import StreamInbox
from zstate.wire.keys import shortened, stream_key
from zstate.wire.messages import from_block
from zstate.wire.native import decode
from zstate.wire.protocol import SerializedSample

if TYPE_CHECKING:
    from zstate.driving.ros2 import Ros2Controller


_WAITING = 32
"""Commands that wait for a tick, of which each takes time to check; of more, the oldest are refused."""

_SLACK_BYTES = 1024
"""Above what the numbers and names of the joints take: for what later versions append to a command."""

_OVERTAKEN_NS = 200_000_000
"""A command may arrive so much later than the end of the token of its commander."""

NO_DEADLINE = -1
NO_RATES: Mapping[int, JointRate] = {}
NO_COLUMNS = np.array([], dtype=np.intp)
NO_POSITIONS = np.array([], dtype=np.float64)

_PLURALS: dict[Mode, str] = {"position": "positions", "velocity": "velocities", "effort": "efforts"}


@dataclass(frozen=True, slots=True)
class Command:
    """Positions (k,) [rad] or [m] for the joints at ``columns`` (k,), valid until ``deadline``.

    ``arrived`` and ``deadline`` are on the monotonic clock [ns]; the deadline is counted from the sending,
    see ``zstate.driving.transit``. With a ``motion`` it has no positions: the
    motion of that number stays valid. ``rates`` are the velocities and efforts of other joints.
    """

    session: int
    seq: int
    columns: NDArray[np.intp]
    positions: Floats
    arrived: int
    deadline: int
    motion: int | None = None
    rates: Mapping[int, JointRate] = field(default_factory=lambda: NO_RATES)

    @property
    def joints(self) -> NDArray[np.intp]:
        """The columns of all joints that it commands."""
        return np.append(self.columns, list(self.rates)).astype(np.intp) if self.rates else self.columns


_Decoder: TypeAlias = "Callable[[SerializedSample, int], Command]"


class CommandReceiver(Closeable):
    """Receives the commands of ``robot`` for ``joint_names``; ``drain`` returns those that can be used.

    A command counts from its sending, for its own ttl or for ``ttl_ns``, which is also the longest that is
    granted: the ``admission`` refuses one that arrives later. ``modes`` are those of the driver.
    ROS nodes send commands to the ``controller``, if there is one, in the order of ``joint_names``, all in
    mode ``ros2_mode`` and without a ttl. ``refusals`` counts the commands that cannot be used by reason.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        joint_names: Sequence[str],
        ttl_ns: int,
        refusals: Refusals,
        *,
        admission: CommandAdmission,
        modes: Collection[Mode] = ("position",),
        controller: Ros2Controller | None = None,
        ros2_mode: Mode = "position",
    ) -> None:
        self._modes = frozenset(modes)
        self._ros2_mode: Mode = ros2_mode
        self._columns = {name: column for column, name in enumerate(joint_names)}
        self._names_text = ", ".join(joint_names)
        self._most_bytes = _SLACK_BYTES + 100 * len(joint_names) + 2 * len(self._names_text.encode())
        self._ttl_ns = ttl_ns
        self._refusals = refusals
        self._admission = admission
        self._inboxes: list[tuple[StreamInbox, _Decoder]] = []
        with ExitStack() as opening:
            self._subscribe(session, stream_key(robot, "joint_commands"), self._read, opening)
            if controller is not None:
                read = partial(self._read_from_ros, controller)
                self._subscribe(session, controller.commands, read, opening)
                for token in controller.reader_tokens(session.zid, session.next_number):
                    opening.enter_context(announce(session, token))
            self._opened = opening.pop_all()

    def drain(self) -> list[Command]:
        """The newest commands since the last call, oldest first."""
        return [
            command
            for inbox, decode_sample in self._inboxes
            for arrived, sample in inbox.drain()
            if (command := self._decoded(decode_sample, sample, arrived)) is not None
        ]

    def close(self) -> None:
        self._opened.close()

    def _subscribe(self, session: Session, key: str, decode_sample: _Decoder, opening: ExitStack) -> None:
        inbox = StreamInbox(session, key, _WAITING, self._on_overrun)
        self._inboxes.append((opening.enter_context(inbox), decode_sample))

    def _on_overrun(self) -> None:
        text = f"more than {_WAITING} commands arrived within one tick; the newest are used"
        self._refusals.count("overrun", text)

    def _decoded(self, decode_sample: _Decoder, sample: SerializedSample, arrived: int) -> Command | None:
        """The command in ``sample``; None if it is refused, which is counted."""
        try:
            self._check_size(sample.size or len(sample.payload))
            return decode_sample(sample, arrived)
        except MessageError as error:
            self._refusals.count(error.reason, error)
        except Exception as error:  # nothing that is received ends the control loop
            self._refusals.count("malformed", repr(error))
        return None

    def _check_size(self, size: int) -> None:
        if size > self._most_bytes:
            text = f"{size} bytes, where a command for these joints takes {self._most_bytes} at most"
            raise MessageError(text, reason="too large")

    def _read(self, sample: SerializedSample, now: int) -> Command:
        """The command in ``sample``. Raises MessageError with the reason why it is refused."""
        message = decode(sample.payload, sample.encoding, JointCommand)
        if message.ttl > self._ttl_ns:
            text = f"a ttl of {format_duration(message.ttl)} is longer than {format_duration(self._ttl_ns)}"
            raise MessageError(f"{text}, which this driver grants at most", reason="ttl")
        sent = (message.stamp, message.seq, message.session)
        deadline = self._admission.deadline(sent, message.ttl or self._ttl_ns, now, message.echo)
        if message.motion is not None:
            head = (message.session, message.seq, NO_COLUMNS, NO_POSITIONS)
            return Command(*head, now, deadline, message.motion)
        if not message.names:
            raise MessageError("a command has the names of its joints; this one has none", reason="no names")
        columns = self._columns_of(message.names)
        if message.positions is None or message.velocities is not None or message.efforts is not None:
            commanded = _rates_of(message, message.names)
            is_moved = np.array([rate.mode == "position" for rate in commanded])
            positions = np.array([rate.value for rate in commanded])[is_moved]
            pairs = zip(columns.tolist(), commanded, strict=True)
            rates = {column: rate for column, rate in pairs if rate.mode != "position"}
            columns = columns[is_moved]
        else:
            positions, rates = from_block(message.positions), {}
            _check_finite(message.names, positions)
        self._check_modes(columns, rates)
        return Command(message.session, message.seq, columns, positions, now, deadline, rates=rates)

    def _read_from_ros(self, controller: Ros2Controller, sample: SerializedSample, now: int) -> Command:
        """The command of a ROS node in ``sample``. Raises MessageError with the reason why it is refused."""
        session, seq, stamp, numbers = controller.decode_command(sample)
        deadline = self._admission.deadline((stamp, seq, session), self._ttl_ns, now)
        names, mode = tuple(self._columns), self._ros2_mode
        if len(numbers) != len(names):
            raise MessageError(
                f"a command of {len(numbers)} numbers; this driver takes {len(names)}, the {_PLURALS[mode]} "
                f"of {', '.join(names)} in this order",
                reason="joint count",
            )
        _check_finite(names, numbers, mode)
        if mode == "position":
            return Command(session, seq, np.arange(len(names)), numbers, now, deadline)
        rates = {column: JointRate(mode, value) for column, value in enumerate(numbers.tolist())}
        return Command(session, seq, NO_COLUMNS, NO_POSITIONS, now, deadline, rates=rates)

    def _check_modes(self, columns: NDArray[np.intp], rates: Mapping[int, JointRate]) -> None:
        """Raise MessageError for a mode that the driver does not take."""
        used: set[Mode] = {rate.mode for rate in rates.values()}
        if columns.size:
            used.add("position")
        if other := used - self._modes:
            asked, taken = (
                " and ".join(_PLURALS[mode] for mode in sorted(some)) for some in (other, self._modes)
            )
            raise MessageError(f"this driver takes {taken}, not {asked}", reason="mode")

    def _columns_of(self, names: Sequence[str]) -> NDArray[np.intp]:
        for name in names:
            if name not in self._columns:
                # No suggestion: to search for one takes longer than a tick.
                text = f"this driver has no joint {printable(shortened(name))!r}; it has {self._names_text}"
                raise MessageError(text, reason="unknown joint")
        if len(set(names)) < len(names):
            raise MessageError("a joint is named twice in one command", reason="repeated joint")
        return np.array([self._columns[name] for name in names], dtype=np.intp)


def _rates_of(message: JointCommand, names: Sequence[str]) -> list[JointRate]:
    """Mode and number of each joint. Raises MessageError unless each has one, which is finite."""
    commanded: list[JointRate | None] = [None] * len(names)
    blocks: tuple[tuple[Mode, bytes | None], ...] = (
        ("position", message.positions),
        ("velocity", message.velocities),
        ("effort", message.efforts),
    )
    for mode, block in blocks:
        for row, value in enumerate([] if block is None else from_block(block).tolist()):
            if math.isnan(value):
                continue
            if not math.isfinite(value):
                raise MessageError(f"the {mode} of {names[row]!r} is {value}", reason="not finite")
            if (first := commanded[row]) is not None:
                text = f"{names[row]!r} has a {first.mode} and a {mode}; a joint is commanded by one of them"
                raise MessageError(text, reason="mode")
            commanded[row] = JointRate(mode, value)
    found = [rate for rate in commanded if rate is not None]
    if len(found) < len(names):
        bad = next(name for name, rate in zip(names, commanded, strict=True) if rate is None)
        raise MessageError(f"the command of {bad!r} is not a number", reason="not finite")
    return found


def _check_finite(names: Sequence[str], numbers: Floats, mode: Mode = "position") -> None:
    for name, value in zip(names, numbers.tolist(), strict=True):
        if not math.isfinite(value):
            raise MessageError(f"the {mode} of {name!r} is {value}", reason="not finite")


class Targets:
    """The positions to which the joints move, each until its command expires. For one thread.

    Joints without a command stay where they were at ``start``, or came to rest after their last one, also
    after a change of the session. While commands of one session are valid, those of others are refused,
    unless it is gone, and so is an older one of that session. ``rates`` are the velocities and efforts of the
    joints that are not commanded by positions, None for those whose command has expired.
    """

    def __init__(self, count: int) -> None:
        self._positions = np.zeros(count)
        self._deadlines = np.full(count, NO_DEADLINE, dtype=np.int64)
        self._first_deadline = self._last_deadline = NO_DEADLINE
        self._last_seqs: BoundedDict[int, int] = BoundedDict()
        self._rates: dict[int, JointRate | None] = {}
        self._gone: BoundedDict[int, int] = BoundedDict()
        """When the tokens of commanders have gone [ns, monotonic]."""
        self.session = 0
        """The session of the newest command; 0 before the first."""
        self.arrived = 0
        """When the newest command arrived [ns, monotonic]."""

    @property
    def rates(self) -> Rates:
        return self._rates

    def start(self, now: int, positions: Floats) -> None:
        """Joints without a command that is valid at ``now`` stay at ``positions``."""
        resting = self._deadlines <= now
        self._positions[resting] = positions[resting]
        self._rest(resting)

    def check_order(self, command: Command) -> None:
        """Raise MessageError for a command that is older than the newest one of its session."""
        if command.seq <= self._last_seqs.get(command.session, -1):
            raise MessageError(f"the command {command.seq} comes after a newer one", reason="old")

    def check_session(self, session: int, now: int, name_of: Callable[[int], str]) -> None:
        """Raise MessageError for another session than the active one, unless that is gone."""
        if session != self.session and not self.is_gone(self.session, now) and self.is_live(now):
            left = format_duration(self._last_deadline - now)
            text = f"it came from {name_of(session)}, while commands of {name_of(self.session)} are valid"
            raise MessageError(f"{text} for {left} more", reason="second commander")

    def set_announced(self, session: int, alive: bool, now: int) -> None:
        """The commander of ``session`` is announced, or has closed: others need not wait; for any thread."""
        if alive:
            self._gone.pop(session, None)
        else:
            self._gone[session] = now

    def is_gone(self, session: int, now: int) -> bool:
        """Whether the active commander, of ``session``, has closed: it sends nothing since its token went.

        A token may vanish for a moment, as with a router, while its commander goes on. Its end may also
        overtake the last commands: those of the next 0.2 s are the last ones if 0.2 s pass without another.
        """
        gone = self._gone.get(session)
        if gone is None:
            return False
        was_overtaken = self.arrived - gone <= _OVERTAKEN_NS < now - self.arrived
        return self.arrived <= gone or was_overtaken

    def merged(self, command: Command, present: Floats) -> Floats:
        """The positions of ``command``; ``present`` ones for all other joints."""
        positions = present.copy()
        positions[command.columns] = command.positions
        return positions

    def accept(self, command: Command) -> None:
        """Move the joints of ``command`` as it commands until its deadline."""
        self.place(command.columns, command.positions)
        self._rates.update(command.rates)
        self.renew(command, command.joints)

    def renew(self, command: Command, columns: NDArray[np.intp]) -> None:
        """Keep the targets of the joints at ``columns`` until the deadline of ``command``."""
        last = self._last_seqs.get(command.session, -1)
        self._last_seqs[command.session] = max(last, command.seq)
        self.session, self.arrived = command.session, command.arrived
        self._set_deadlines(columns, command.deadline)

    def place(self, columns: NDArray[np.intp], positions: Floats) -> None:
        """Move the joints at ``columns`` to ``positions`` as long as their command is valid."""
        self._positions[columns] = positions
        if self._rates:
            for column in columns.tolist():
                self._rates.pop(column, None)

    def is_live(self, now: int) -> bool:
        """Whether any joint has a command that is valid at ``now``."""
        return self._last_deadline > now

    def current(self, now: int, resting: Callable[[], Floats]) -> Floats:
        """The target of each joint at ``now``: (n,); one whose command expires now stays at ``resting()``."""
        if NO_DEADLINE < self._first_deadline <= now:
            expired = (self._deadlines <= now) & (self._deadlines != NO_DEADLINE)
            self._positions[expired] = resting()[expired]
            self._rest(expired)
        return self._positions

    def clear(self) -> None:
        """Forget all commands."""
        self._rates.clear()
        self._set_deadlines(np.ones(len(self._deadlines), dtype=np.bool_), NO_DEADLINE)

    def _rest(self, columns: NDArray[np.bool_]) -> None:
        """The commands of the joints at ``columns`` have expired."""
        for column in self._rates:
            if columns[column]:
                self._rates[column] = None
        self._set_deadlines(columns, NO_DEADLINE)

    def _set_deadlines(self, columns: NDArray[np.intp] | NDArray[np.bool_], deadline: int) -> None:
        self._deadlines[columns] = deadline
        valid = self._deadlines[self._deadlines != NO_DEADLINE].tolist()
        self._first_deadline = min(valid, default=NO_DEADLINE)
        self._last_deadline = max(valid, default=NO_DEADLINE)


def check_named(numbers: Mapping[Mode, Mapping[str, float]]) -> None:
    """Raise InvalidInput unless ``numbers`` of at least one joint are finite, and each has one mode."""
    count = Counter(name for values in numbers.values() for name in values)
    if not count:
        raise InvalidInput("a command has the position of at least one joint: {'elbow': 0.4}")
    repeated = [name for name, times in count.items() if times > 1]
    if repeated:
        raise InvalidInput(
            f"a joint is commanded by a position, a velocity or an effort; several are given for "
            f"{', '.join(map(repr, repeated))}"
        )
    for mode, values in numbers.items():
        bad = [f"{name!r} ({value})" for name, value in values.items() if not math.isfinite(value)]
        if bad:
            raise InvalidInput(f"commanded {_PLURALS[mode]} must be finite; not so: {', '.join(bad)}")
