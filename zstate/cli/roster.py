"""Roster: which robots are announced, and what to say of one that is not."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING

from zstate.cli.console import fail
from zstate.closing import Closing

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session
    from zstate.wire.keys import Stream
    from zstate.wire.writer import Announced


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

    def __init__(self, session: Session, robot: str = "*", wire: str = "native") -> None:
        from zstate.net.presence import watch

        self._announced: set[Announced] = set()
        self._watch = watch(session, robot if wire != "native" else "*", self._note, wire)

    def close(self) -> None:
        self._watch.close()

    def _note(self, announced: Announced, alive: bool) -> None:
        change = self._announced.add if alive else self._announced.discard
        change(announced)

    def robots(self) -> tuple[RobotInfo, ...]:
        """The robots that somebody writes for, as ``discover`` gives them."""
        from zstate.net.presence import by_robot

        return by_robot(self._announced.copy())

    def streams(self, robot: str) -> frozenset[Stream]:
        """What somebody writes for ``robot``."""
        return frozenset(said.stream for said in self._announced.copy() if said.robot == robot)

    def silence(self, robot: str, stream: Stream, *, ended: bool = False) -> str:
        """Why no sample of ``stream`` comes (any more, if ``ended``), as far as one can tell from here."""
        streams = self.streams(robot)
        if not streams:
            return unknown_robot(robot, self.robots())
        if stream in streams:
            return f"{robot!r} is announced with {stream}, but no {'new ' * ended}sample comes"
        command = "joints" if stream == "joint_states" else "publish"
        return f"nobody writes {stream} of {robot!r}{' any more' * ended}; `zstate {command} {robot}` would"
