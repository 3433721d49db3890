"""Which robots are announced, and what to say of one that is not."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager
from difflib import get_close_matches
from types import TracebackType
from typing import TYPE_CHECKING

from zstate.errors import NetworkError

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo, Writer
    from zstate.net.session import Session
    from zstate.wire.keys import Stream

NOBODY = "no robot is announced on this network; start one: `zstate demo`, or `zstate publish ROBOT`"


def absence(robot: str, names: Iterable[str]) -> str:
    """Why there is nothing of ``robot``, when these are announced."""
    announced = sorted(names)
    if not announced:
        return NOBODY
    near = get_close_matches(robot, announced, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    listed = ", ".join(map(repr, announced))
    return f"the robot {robot!r} is not announced; announced {_is_or_are(announced)} {listed}{hint}"


def _is_or_are(names: list[str]) -> str:
    return "is" if len(names) == 1 else "are"


def announced_robots(session: Session, robot: str) -> tuple[RobotInfo, ...]:
    """``robot`` as it is announced, or all robots for "*". Raises NetworkError when there is none."""
    from zstate.net.presence import discover
    from zstate.wire.keys import ANY, check_robot

    if robot != ANY:
        check_robot(robot)
    robots = discover(session)
    wanted = tuple(info for info in robots if robot in (ANY, info.name))
    if not wanted:
        raise NetworkError(absence(robot, (info.name for info in robots)))
    return wanted


class Roster(AbstractContextManager["Roster"]):
    """The robots that are announced now, kept up to date."""

    def __init__(self, session: Session) -> None:
        from zstate.net.presence import watch

        self._writers: set[tuple[str, Stream, Writer]] = set()
        self._watch = watch(session, "*", self._note)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._watch.close()

    def _note(self, robot: str, stream: Stream, writer: Writer, alive: bool) -> None:
        change = self._writers.add if alive else self._writers.discard
        change((robot, stream, writer))

    def names(self) -> tuple[str, ...]:
        """The robots that somebody writes for, sorted."""
        return tuple(sorted({robot for robot, _, _ in self._writers.copy()}))

    def streams(self, robot: str) -> frozenset[Stream]:
        """What somebody writes for ``robot``."""
        return frozenset(stream for name, stream, _ in self._writers.copy() if name == robot)

    def silence(self, robot: str, stream: Stream) -> str:
        """Why no sample of ``stream`` comes, as far as one can tell from here."""
        if robot not in self.names():
            return absence(robot, self.names())
        if stream in self.streams(robot):
            return f"the writer of {stream} of {robot!r} has sent nothing yet"
        start = f"zstate joints {robot}" if stream == "joint_states" else f"zstate publish {robot}"
        return f"{robot!r} is announced, but nobody writes its {stream}; for instance `{start}` does"
