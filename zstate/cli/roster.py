"""Roster: which robots are announced, and what to say of one that is not."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING

from zstate.cli.console import fail
from zstate.closing import Closing

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo, Writer
    from zstate.net.session import Session
    from zstate.wire.keys import Stream


def announced_robots(session: Session, robot: str) -> tuple[RobotInfo, ...]:
    """``robot`` as it is announced, or all robots for "*". Fails when there is none."""
    from zstate.net.presence import discover
    from zstate.wire.keys import ANY, check_robot

    if robot != ANY:
        check_robot(robot)
    robots = discover(session)
    wanted = tuple(info for info in robots if robot in (ANY, info.name))
    if not wanted:
        fail(announced_text(robots) if robot == ANY else unknown_robot(robot, robots))
    return wanted


def announced_text(robots: Sequence[RobotInfo]) -> str:
    """Which robots there are, for the end of a message about one that is not."""
    if not robots:
        return "no robot is announced; start one, for instance with `zstate publish panda --source sine`"
    return f"announced: {', '.join(repr(robot.name) for robot in robots)}"


def unknown_robot(robot: str, robots: Sequence[RobotInfo]) -> str:
    """The message for a robot that nobody announces, with near misses and those who are there."""
    near = get_close_matches(robot, [info.name for info in robots], n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"nobody announces the robot {robot!r}{hint} ({announced_text(robots)})"


class Roster(Closing):
    """The robots that are announced now, kept up to date."""

    def __init__(self, session: Session) -> None:
        from zstate.net.presence import watch

        self._writers: set[tuple[str, Stream, Writer]] = set()
        self._watch = watch(session, "*", self._note)

    def close(self) -> None:
        self._watch.close()

    def _note(self, robot: str, stream: Stream, writer: Writer, alive: bool) -> None:
        change = self._writers.add if alive else self._writers.discard
        change((robot, stream, writer))

    def robots(self) -> tuple[RobotInfo, ...]:
        """The robots that somebody writes for, as ``discover`` gives them."""
        from zstate.net.presence import RobotInfo

        writers = sorted(self._writers.copy())
        names = sorted({robot for robot, _, _ in writers})
        return tuple(
            RobotInfo(name, tuple((stream, writer) for robot, stream, writer in writers if robot == name))
            for name in names
        )

    def streams(self, robot: str) -> frozenset[Stream]:
        """What somebody writes for ``robot``."""
        return frozenset(stream for name, stream, _ in self._writers.copy() if name == robot)

    def silence(self, robot: str, stream: Stream, *, ended: bool = False) -> str:
        """Why no sample of ``stream`` comes (any more, if ``ended``), as far as one can tell from here."""
        streams = self.streams(robot)
        if not streams:
            return unknown_robot(robot, self.robots())
        if stream in streams:
            return f"{robot!r} is announced with {stream}, but no {'new ' * ended}sample comes"
        command = "joints" if stream == "joint_states" else "publish"
        return f"nobody writes {stream} of {robot!r}{' any more' * ended}; `zstate {command} {robot}` would"
