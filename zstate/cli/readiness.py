"""Readiness: what a robot still lacks before its poses can be looked up."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING

from zstate.cli.console import note
from zstate.cli.roster import Roster
from zstate.cli.words import is_ros
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.net.latched import LatchedSubscriber
from zstate.net.wires import wire_named
from zstate.wire.messages import RobotDescription
from zstate.wire.wire import Arrival

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.listener import Follow, TransformListener
    from zstate.net.session import Session
    from zstate.wire.keys import Stream

# Who is ready is usually found so sooner; waiting is mentioned only afterwards.
_GRACE_S = 0.5
_LOOK_EVERY_S = 0.02


class Readiness(Closing):
    """Follows ``robots`` until each is ready: every edge that moves has a sample."""

    def __init__(self, session: Session, robots: Sequence[str], wire: str) -> None:
        self._session, self._wire = session, wire
        self._robots = tuple(dict.fromkeys(robots))
        self._spoken = wire_named(wire)
        self._still: set[str] = set()
        self._listeners: dict[str, list[TransformListener]] = {}
        with ExitStack() as opening:
            robot = self._robots[0] if len(self._robots) == 1 else "*"
            self._roster = opening.enter_context(Roster(session, robot, wire))
            if not is_ros(wire):
                key = self._spoken.expression(robot, "robot_description")
                opening.enter_context(LatchedSubscriber(session, key, self._note_still))
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def frames(self, robot: str) -> tuple[FrameInfo, ...]:
        """What is known of ``robot``."""
        return max((one.buffer.frames() for one in self._listeners.get(robot, ())), key=len, default=())

    def wait(self, timeout_s: float) -> str:
        """What is lacking after ``timeout_s``; empty as soon as nothing is. Says what it waits for."""
        began, said = time.monotonic(), ""
        while reason := self._lack():
            lasting_s = time.monotonic() - began
            if lasting_s >= timeout_s:
                return reason
            if lasting_s > _GRACE_S and reason != said:
                said = reason
                note(f"waiting: {reason}", event="waiting")
            time.sleep(_LOOK_EVERY_S)
        return ""

    def _lack(self) -> str:
        return next((lack for robot in self._robots if (lack := self._lack_of(robot))), "")

    def _lack_of(self, robot: str) -> str:
        streams, words = self._roster.streams(robot), self._roster.words
        if not streams:
            return words.unknown(robot, self._roster.robots())
        if robot not in self._listeners:
            self._listeners[robot] = [self._listen(robot, follow) for follow in self._followed(streams)]
        if self._is_ready(robot):
            return ""
        refused = "; ".join(text for one in self._listeners[robot] for text in one.refusals.values())
        stream = self._lacking(streams)
        return refused or words.silence(robot, stream, self._roster.robots(), ended=False)

    def _is_ready(self, robot: str) -> bool:
        for listener in self._listeners[robot]:
            moving = [frame for frame in listener.buffer.frames() if frame.kind in ("joint", "pose")]
            if (moving or robot in self._still) and all(frame.count for frame in moving):
                return True
        return False

    def _note_still(self, arrival: Arrival) -> None:
        """Of a robot without moving joints no sample need come."""
        with suppress(MessageError, InvalidInput):  # withdrawn; or broken, which the listener says
            robot = self._spoken.robot_of(arrival.key)
            for said in self._spoken.decode("robot_description", arrival, robot):
                if isinstance(said, RobotDescription) and not said.moving_edges:
                    self._still.add(robot)

    def _lacking(self, streams: Collection[Stream]) -> Stream:
        """What does not come, and everything else follows from."""
        if is_ros(self._wire):
            return "tf"
        return "joint_states" if "robot_description" in streams else "robot_description"

    def _followed(self, streams: Collection[Stream]) -> list[Follow]:
        if is_ros(self._wire):
            return ["tf"]
        # Where nobody writes joint states, transforms may come ready made.
        return ["joint_states"] if "joint_states" in streams else ["joint_states", "tf"]

    def _listen(self, robot: str, follow: Follow) -> TransformListener:
        from zstate.listener import TransformListener

        listener = TransformListener(
            self._session, robot, wire=self._wire, follow=follow, history_on_join=False
        )
        return self._opened.enter_context(listener)
