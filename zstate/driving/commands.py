"""Commands as they arrive at a driver: checks, and the targets of its joints until they expire."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.format import suggestion_text
from zstate._util.refusals import Refusals
from zstate.errors import InvalidInput, MessageError, format_duration, printable
from zstate.model.robot import near_joint
from zstate.net.presence import announce
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.wire.keys import shortened, stream_key
from zstate.wire.messages import JointCommand, check_size, from_block
from zstate.wire.native import decode
from zstate.wire.protocol import SerializedSample

if TYPE_CHECKING:
    from zstate.wire.ros2.wire import Ros2Controller

Floats = NDArray[np.float64]

_WAITING = 32
"""Commands that wait for a tick, of which each takes time to check; of more, the oldest are refused."""

NO_DEADLINE = -1
NO_COLUMNS = np.array([], dtype=np.intp)
NO_POSITIONS = np.array([], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Command:
    """Positions (k,) [rad] or [m] for the joints at ``columns`` (k,), valid until ``deadline``.

    ``arrived`` and ``deadline`` are on the monotonic clock [ns]. With a ``motion`` it has no positions: the
    motion of that number stays valid.
    """

    session: int
    seq: int
    columns: NDArray[np.intp]
    positions: Floats
    arrived: int
    deadline: int
    motion: int | None = None


_Reader: TypeAlias = "Callable[[SerializedSample, int], Command]"


class CommandReceiver(Closeable):
    """Receives the commands of ``robot`` for ``joint_names``; ``drain`` returns those that can be used.

    A command counts from its arrival, for its own ttl or for ``ttl_ns``, which is also the longest that is
    granted. ROS nodes send them to the ``controller``, if there is one, in the order of ``joint_names`` and
    without a ttl. ``refusals`` counts the others by reason.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        joint_names: Sequence[str],
        ttl_ns: int,
        refusals: Refusals,
        *,
        controller: Ros2Controller | None = None,
    ) -> None:
        self._columns = {name: column for column, name in enumerate(joint_names)}
        self._ttl_ns = ttl_ns
        self._refusals = refusals
        self._arrived: deque[Command] = deque(maxlen=_WAITING)
        with ExitStack() as opening:
            key = stream_key(robot, "joint_commands")
            on_samples = partial(self._on_samples, self._read)
            opening.enter_context(StreamSubscriber(session, key, on_samples))
            if controller is not None:
                on_samples = partial(self._on_samples, partial(self._read_from_ros, controller))
                opening.enter_context(StreamSubscriber(session, controller.commands, on_samples))
                for token in controller.reader_tokens(session.zid, session.next_number):
                    opening.enter_context(announce(session, token))
            self._opened = opening.pop_all()

    def drain(self) -> list[Command]:
        """The newest commands since the last call, oldest first."""
        return [self._arrived.popleft() for _ in range(len(self._arrived))]

    def close(self) -> None:
        self._opened.close()

    def _on_samples(self, read: _Reader, samples: list[SerializedSample]) -> None:
        now = time.monotonic_ns()
        for sample in samples:
            self._on_sample(read, sample, now)

    def _on_sample(self, read: _Reader, sample: SerializedSample, now: int) -> None:
        try:
            command = read(sample, now)
        except MessageError as error:
            self._refusals.count(error.reason, error)
            return
        if len(self._arrived) == _WAITING:
            text = f"more than {_WAITING} commands arrived within one tick; the newest are used"
            self._refusals.count("overrun", text)
        self._arrived.append(command)

    def _read(self, sample: SerializedSample, now: int) -> Command:
        """The command in ``sample``. Raises MessageError with the reason why it is refused."""
        check_size("joint_commands", sample.size or len(sample.payload))
        message = decode(sample.payload, sample.encoding, JointCommand)
        if message.ttl > self._ttl_ns:
            text = f"a ttl of {format_duration(message.ttl)} is longer than {format_duration(self._ttl_ns)}"
            raise MessageError(f"{text}, which this driver grants at most", reason="ttl")
        deadline = now + (message.ttl or self._ttl_ns)
        if message.motion is not None:
            head = (message.session, message.seq, NO_COLUMNS, NO_POSITIONS)
            return Command(*head, now, deadline, message.motion)
        if not message.names:
            raise MessageError("a command has the names of its joints; this one has none", reason="no names")
        if message.positions is None or message.velocities is not None or message.efforts is not None:
            text = "a command has positions and nothing else; velocities and efforts are not supported"
            raise MessageError(text, reason="mode")
        positions = from_block(message.positions)
        columns = self._columns_of(message.names)
        _check_finite(message.names, positions)
        return Command(message.session, message.seq, columns, positions, now, deadline)

    def _read_from_ros(self, controller: Ros2Controller, sample: SerializedSample, now: int) -> Command:
        """The command of a ROS node in ``sample``. Raises MessageError with the reason why it is refused."""
        session, seq, positions = controller.decode_command(sample)
        names = tuple(self._columns)
        if len(positions) != len(names):
            raise MessageError(
                f"a command of {len(positions)} numbers; this driver takes {len(names)}, the positions of "
                f"{', '.join(names)} in this order",
                reason="joint count",
            )
        _check_finite(names, positions)
        return Command(session, seq, np.arange(len(names)), positions, now, now + self._ttl_ns)

    def _columns_of(self, names: Sequence[str]) -> NDArray[np.intp]:
        for name in names:
            if name not in self._columns:
                near = near_joint(name, list(self._columns))
                text = f"this driver has no joint {printable(shortened(name))!r}{suggestion_text(near)}"
                raise MessageError(text, reason="unknown joint")
        if len(set(names)) < len(names):
            raise MessageError("a joint is named twice in one command", reason="repeated joint")
        return np.array([self._columns[name] for name in names], dtype=np.intp)


def _check_finite(names: Sequence[str], positions: Floats) -> None:
    for name, value in zip(names, positions.tolist(), strict=True):
        if not math.isfinite(value):
            raise MessageError(f"the position of {name!r} is {value}", reason="not finite")


class Targets:
    """The positions to which the joints move, each until its command expires. For one thread.

    Joints without a command stay where they were at ``start``, or came to rest after their last one, also
    after a change of the session. While commands of one session are valid, those of others are refused, and
    so is an older one of that session.
    """

    def __init__(self, count: int) -> None:
        self._positions = np.zeros(count)
        self._deadlines = np.full(count, NO_DEADLINE, dtype=np.int64)
        self._first_deadline = self._last_deadline = NO_DEADLINE
        self._last_seqs: BoundedDict[int, int] = BoundedDict()
        self.session = 0
        """The session of the newest command; 0 before the first."""
        self.arrived = 0
        """When the newest command arrived [ns, monotonic]."""
        self.ttl_ns = 0
        """For how long the newest command is valid."""

    def start(self, now: int, positions: Floats) -> None:
        """Joints without a command that is valid at ``now`` stay at ``positions``."""
        resting = self._deadlines <= now
        self._positions[resting] = positions[resting]
        self._set_deadlines(resting, NO_DEADLINE)

    def check_order(self, command: Command) -> None:
        """Raise MessageError for a command that is older than the newest one of its session."""
        if command.seq <= self._last_seqs.get(command.session, -1):
            raise MessageError(f"the command {command.seq} comes after a newer one", reason="old")

    def check_session(self, session: int, now: int) -> None:
        """Raise MessageError for another session than the active one."""
        if session != self.session and self.is_live(now):
            text = f"a command of session {session:016x} while that of another session is valid"
            raise MessageError(text, reason="second commander")

    def merged(self, command: Command, present: Floats) -> Floats:
        """The positions of ``command``; ``present`` ones for all other joints."""
        positions = present.copy()
        positions[command.columns] = command.positions
        return positions

    def accept(self, command: Command) -> None:
        """Move the joints of ``command`` to its positions until its deadline."""
        self.place(command.columns, command.positions)
        self.renew(command, command.columns)

    def renew(self, command: Command, columns: NDArray[np.intp]) -> None:
        """Keep the targets of the joints at ``columns`` until the deadline of ``command``."""
        last = self._last_seqs.get(command.session, -1)
        self._last_seqs[command.session] = max(last, command.seq)
        self.session, self.arrived = command.session, command.arrived
        self.ttl_ns = command.deadline - command.arrived
        self._set_deadlines(columns, command.deadline)

    def place(self, columns: NDArray[np.intp], positions: Floats) -> None:
        """Move the joints at ``columns`` to ``positions`` as long as their command is valid."""
        self._positions[columns] = positions

    def is_live(self, now: int) -> bool:
        """Whether any joint has a command that is valid at ``now``."""
        return self._last_deadline > now

    def current(self, now: int, resting: Callable[[], Floats]) -> Floats:
        """The target of each joint at ``now``: (n,); one whose command expires now stays at ``resting()``."""
        if NO_DEADLINE < self._first_deadline <= now:
            expired = (self._deadlines <= now) & (self._deadlines != NO_DEADLINE)
            self._positions[expired] = resting()[expired]
            self._set_deadlines(expired, NO_DEADLINE)
        return self._positions

    def clear(self) -> None:
        """Forget all commands."""
        self._set_deadlines(np.ones(len(self._deadlines), dtype=np.bool_), NO_DEADLINE)

    def _set_deadlines(self, columns: NDArray[np.intp] | NDArray[np.bool_], deadline: int) -> None:
        self._deadlines[columns] = deadline
        valid = self._deadlines[self._deadlines != NO_DEADLINE].tolist()
        self._first_deadline = min(valid, default=NO_DEADLINE)
        self._last_deadline = max(valid, default=NO_DEADLINE)


def check_named_positions(positions: dict[str, float]) -> None:
    """Raise InvalidInput unless ``positions`` are finite numbers of at least one joint."""
    if not positions:
        raise InvalidInput("a command has the position of at least one joint: {'elbow': 0.4}")
    bad = [f"{name!r} ({value})" for name, value in positions.items() if not math.isfinite(value)]
    if bad:
        raise InvalidInput(f"commanded positions must be finite; not so: {', '.join(bad)}")
