"""Directory of announced robots, and messages about robots that are not announced."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from zstate._util.closeable import Closeable
from zstate.cli.output.console import fail
from zstate.cli.output.wire_text import NativeMessages, is_ros, messages_for

if TYPE_CHECKING:
    from zstate.net.discovery import RobotInfo
    from zstate.net.session import Session
    from zstate.streams import StreamName
    from zstate.wire.identity import Announcement


def announced_robots(session: Session, robot: str) -> tuple[RobotInfo, ...]:
    """``robot`` as it is announced, or all robots for "*". Fails if there is none."""
    from zstate.net.discovery import discover
    from zstate.wire.keys import ANY, check_robot

    if robot != ANY:
        check_robot(robot)
    robots = discover(session)
    selected = tuple(info for info in robots if robot in (ANY, info.name))
    if not selected:
        messages = messages_for("native")
        fail(messages.announced(robots) if robot == ANY else messages.unknown(robot, robots))
    return selected


def check_found(robots: Sequence[RobotInfo]) -> None:
    """Fail if there are no ``robots`` and discovery is incomplete: that is no empty fleet."""
    if not robots and (reason := NativeMessages().incomplete_text()):
        fail(f"no robot is found, and discovery is incomplete: {reason}")


def only_robot(session: Session) -> str:
    """The name of the only announced robot. Fails with the candidates if there are several or none."""
    first, *others = announced_robots(session, "*")
    if others:
        fail(f"which robot? {messages_for('native').announced((first, *others))}")
    return first.name


class RobotDirectory(Closeable):
    """The robots that are announced now, kept up to date by liveliness tokens.

    On a ROS wire, which has topics only, it holds the robots that ``robot`` can mean there, by that name.
    ``on_change()`` is called, from one thread, after each writer that joins or leaves.
    """

    def __init__(
        self,
        session: Session,
        robot: str = "*",
        wire: str = "native",
        on_change: Callable[[], object] = lambda: None,
    ) -> None:
        from zstate.net.presence import WriterWatch

        self.messages = messages_for(wire)
        self._session, self._wire = session, wire
        announced: set[Announcement] = set()
        self._announced = announced

        def update(announcement: Announcement, alive: bool) -> None:
            (announced.add if alive else announced.discard)(announcement)
            on_change()

        self._watch = WriterWatch(session, robot if is_ros(wire) else "*", update, wire)

    def close(self) -> None:
        self._watch.close()

    def robots(self) -> tuple[RobotInfo, ...]:
        """Robots with at least one writer, as ``discover`` returns them."""
        from zstate.net.discovery import by_robot

        return by_robot(self._announced.copy())

    def streams(self, robot: str) -> frozenset[StreamName]:
        """The streams of ``robot`` that have a writer."""
        return frozenset(one.stream for one in self._announced.copy() if one.robot == robot)

    def confirmed_streams(self, robot: str) -> frozenset[StreamName]:
        """The same, as the network answers now: the tokens of writers may still be on the way here.

        Takes a fraction of a second. Raises Unreachable.
        """
        from zstate.net.discovery import discover_tokens
        from zstate.wire.registry import get_wire

        wire = get_wire(self._wire)
        tokens = discover_tokens(self._session, wire.writers_expression(robot))
        return frozenset(one.stream for token in tokens for one in wire.parse_token(token, robot))

    def no_sample_text(self, robot: str, stream: StreamName, *, ended: bool = False) -> str:
        """Why no sample of ``stream`` arrives (any more, if ``ended``)."""
        return self.messages.no_sample_text(robot, stream, self.robots(), ended=ended)
