"""Roster: which robots are announced, and what to say of one that is not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from zstate.cli.output.console import fail
from zstate.cli.words import is_ros, words_of
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
        words = words_of("native")
        fail(words.announced(robots) if robot == ANY else words.unknown(robot, robots))
    return wanted


def only_robot(session: Session) -> str:
    """The robot that is announced, if it is the only one. Fails with the candidates for several or none."""
    first, *others = announced_robots(session, "*")
    if others:
        fail(f"which robot? {words_of('native').announced((first, *others))}")
    return first.name


class Roster(Closing):
    """The robots that are announced now, kept up to date.

    On a ROS wire those that ``robot`` can mean there, and by that name: ROS itself has topics only.
    """

    def __init__(self, session: Session, robot: str = "*", wire: str = "native") -> None:
        from zstate.net.presence import watch

        self.words = words_of(wire)
        self._announced: set[Announced] = set()
        self._watch = watch(session, robot if is_ros(wire) else "*", self._note, wire)

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
        return self.words.silence(robot, stream, self.robots(), ended=ended)
