"""GraphWatch: who writes and reads what, asked for now and then."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from zstate._util.bounded_dict import BoundedDict
from zstate.closing import Closing
from zstate.errors import NetworkError
from zstate.net.presence import RobotInfo, discover, discover_readers
from zstate.net.session import Session
from zstate.net.status import watch_status
from zstate.wire.keys import ANY
from zstate.wire.messages import Status
from zstate.wire.writer import Announced

_EVERY_S = 2.0
_SOON_S = 0.5
_WITHIN_S = 0.3
_ASKED_WITHIN_S = 3.0
_JOIN_WITHIN_S = 1.0


@dataclass(frozen=True, slots=True)
class StreamUse:
    """One stream of ``robot``, with the programs at its ends, each once, sorted."""

    robot: str
    stream: str
    writers: tuple[str, ...]
    readers: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class WriterState:
    """What the publisher of ``robot`` says of itself; ``age_s`` ago."""

    robot: str
    status: Status
    age_s: float


class GraphWatch(Closing):
    """Looks every other second, in a thread of its own, while somebody asks for what it sees."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._uses: tuple[StreamUse, ...] = ()
        self._said: BoundedDict[tuple[str, int], tuple[Status, float]] = BoundedDict()
        self._asked_at = -_ASKED_WITHIN_S
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._status = watch_status(session, ANY, self._hear)
        self._thread = threading.Thread(target=self._run, name="zstate graph", daemon=True)
        self._thread.start()

    def uses(self) -> tuple[StreamUse, ...]:
        """Every stream that is written or read, sorted; as of the last look."""
        self._asked_at = time.monotonic()
        return self._uses

    def states(self) -> tuple[WriterState, ...]:
        """How every publisher does that is announced, by its own word."""
        with self._lock:
            said = list(self._said.items())
        now = time.monotonic()
        states = (WriterState(robot, status, now - at) for (robot, _), (status, at) in said)
        return tuple(sorted(states, key=lambda state: (state.robot, state.status.program)))

    def _hear(self, robot: str, status: Status) -> None:
        with self._lock:
            self._said[robot, status.session] = (status, time.monotonic())

    def _run(self) -> None:
        while not self._stop.wait(_EVERY_S if self._uses else _SOON_S):
            if time.monotonic() - self._asked_at < _ASKED_WITHIN_S:
                try:
                    self._look()
                except NetworkError:
                    return

    def _look(self) -> None:
        robots = discover(self._session, _WITHIN_S)
        self._uses = tuple(_uses(robots, discover_readers(self._session, _WITHIN_S)))
        alive = {(robot.name, writer.session) for robot in robots for _, writer in robot.writers}
        with self._lock:
            for key in self._said.keys() - alive:
                del self._said[key]

    def close(self) -> None:
        """Look no more. A second call does nothing."""
        self._stop.set()
        self._status.close()
        self._thread.join(_JOIN_WITHIN_S)


def _uses(robots: Sequence[RobotInfo], readers: Sequence[Announced]) -> Iterator[StreamUse]:
    ends = [(robot.name, stream, writer) for robot in robots for stream, writer in robot.writers]
    written = {(name, stream) for name, stream, _ in ends}
    # Whoever reads all robots does not miss what one of them lacks.
    read = {(one.robot, one.stream) for one in readers if one.robot != ANY}
    for name, stream in sorted(written | read):
        writing = {str(writer) for of, said, writer in ends if (of, said) == (name, stream)}
        reading = {str(one.writer) for one in readers if one.stream == stream and one.robot in (name, ANY)}
        yield StreamUse(name, stream, tuple(sorted(writing)), tuple(sorted(reading)))
