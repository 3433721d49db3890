"""Readiness: what a robot still lacks before its poses can be looked up."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

from zstate.cli.console import note
from zstate.cli.roster import Roster
from zstate.cli.words import is_ros
from zstate.closing import Closing

if TYPE_CHECKING:
    from zstate.buffer.frames import FrameInfo
    from zstate.listener import Follow, TransformListener
    from zstate.net.session import Session
    from zstate.wire.keys import Stream

# Who is ready is usually found so sooner; waiting is mentioned only afterwards.
_GRACE_S = 0.5
_LOOK_EVERY_S = 0.02


class Readiness(Closing):
    """Follows ``robots`` until each is ready: it has a model, or frames, and every moving edge a sample."""

    def __init__(self, session: Session, robots: Sequence[str], wire: str) -> None:
        self._session, self._wire = session, wire
        self._robots = tuple(dict.fromkeys(robots))
        self._listeners: dict[str, TransformListener] = {}
        with ExitStack() as opening:
            robot = self._robots[0] if len(self._robots) == 1 else "*"
            self._roster = opening.enter_context(Roster(session, robot, wire))
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def frames(self, robot: str) -> tuple[FrameInfo, ...]:
        """What is known of ``robot``."""
        listener = self._listeners.get(robot)
        return () if listener is None else listener.buffer.frames()

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
            self._listen(robot)
        frames = self.frames(robot)
        moving = [frame for frame in frames if frame.kind in ("joint", "pose")]
        if frames and all(frame.count for frame in moving):
            return ""
        if not frames and self._listeners[robot].refusals:
            return "; ".join(self._listeners[robot].refusals.values())
        return words.silence(robot, self._lacking(robot, frames), self._roster.robots(), ended=False)

    def _lacking(self, robot: str, frames: Sequence[FrameInfo]) -> Stream:
        """Of which stream nothing comes."""
        if is_ros(self._wire):
            return "tf"
        # Transforms are made of joint states, where somebody is to write those.
        is_described = frames or "robot_description" in self._roster.streams(robot)
        return "joint_states" if is_described else "robot_description"

    def _listen(self, robot: str) -> None:
        from zstate.listener import TransformListener

        listener = TransformListener(
            self._session, robot, wire=self._wire, follow=self._follow(robot), history_on_join=False
        )
        self._listeners[robot] = self._opened.enter_context(listener)

    def _follow(self, robot: str) -> Follow:
        streams = self._roster.streams(robot)
        by_joints = "joint_states" in streams or "tf" not in streams
        return "joint_states" if by_joints and not is_ros(self._wire) else "tf"
