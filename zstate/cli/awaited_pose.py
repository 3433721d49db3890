"""AwaitedPose: waiting for an answer of a buffer, and telling a person what for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

from zstate.cli.console import count_text, fail, note
from zstate.cli.roster import Roster, announced_text, unknown_robot
from zstate.errors import InPast, LookupFailed, NoData, UnknownFrame, WaitTimeout, duration_text

if TYPE_CHECKING:
    from zstate.listener import TransformListener
    from zstate.net.presence import RobotInfo
    from zstate.transform import Transform
    from zstate.wire.keys import Stream

# Whoever has answers usually gives the first one sooner; waiting is mentioned only afterwards.
_GRACE_S = 0.5


class AwaitedPose:
    """Asks ``listener`` for one pose, again and again, and tells a person what it waits for."""

    def __init__(self, listener: TransformListener, roster: Roster, target: str, source: str) -> None:
        self._listener = listener
        self._roster = roster
        self._frames = (target, source)
        self._said: tuple[object, ...] | None = None

    def answer(self, at: int | None = None, *, timeout_s: float | None = None) -> Transform:
        """The pose at ``at``, or the newest, as soon as there is one.

        Raises LookupFailed for what waiting cannot mend, and after ``timeout_s``.
        """
        began = time.monotonic()
        while True:
            left_s = _GRACE_S if timeout_s is None else began + timeout_s - time.monotonic()
            try:
                transform = self._listener.buffer.wait(*self._frames, at, max(0.0, min(left_s, _GRACE_S)))
            except WaitTimeout as reason:
                if timeout_s is not None and left_s <= _GRACE_S:
                    self._give_up(reason, timeout_s)
                self._say_once(reason)
            except InPast as reason:
                self._refuse_past(reason)
            else:
                self._end()
                return transform

    def silence(self) -> str:
        """Why no newer answer comes: the edge whose samples are the oldest."""
        transform = self._listener.buffer.lookup(*self._frames)
        assert transform.stamp is not None
        reason = self._listener.buffer.explain(*self._frames, transform.stamp + 1)
        edge = "" if reason is None or reason.edge is None else f" of {' -> '.join(map(repr, reason.edge))}"
        writer = "" if reason is None or reason.writer is None else f", which {reason.writer} wrote"
        age = duration_text(time.time_ns() - transform.stamp)
        return f"no new sample{edge}{writer}: the newest is {age} old"

    def _say_once(self, reason: LookupFailed) -> None:
        hint = self._hint(reason)
        key = (type(reason), reason.edge, getattr(reason, "name", ""), hint)
        if key != self._said:
            self._said = key
            note(f"waiting: {self._explained(reason, hint)}")

    @staticmethod
    def _refuse_past(reason: InPast) -> NoReturn:
        assert reason.requested is not None
        assert reason.oldest is not None
        assert reason.edge is not None
        fail(
            f"asked {duration_text(reason.oldest - reason.requested)} before the oldest sample heard of "
            f"{' -> '.join(map(repr, reason.edge))}; this command knows only what comes while it runs: "
            "leave --at out, or name an instant to come"
        )

    def _give_up(self, reason: WaitTimeout, timeout_s: float) -> NoReturn:
        fail(f"gave up after {timeout_s:g} s: {self._explained(reason, self._hint(reason))}")

    @staticmethod
    def _explained(reason: LookupFailed, hint: str) -> str:
        if isinstance(reason, UnknownFrame) and not reason.frame_count:
            return hint  # no frame at all is known: that is not about this one
        return f"{reason.explanation()}{f' ({hint})' if hint else ''}"

    def _hint(self, reason: LookupFailed) -> str:
        """What the roster of robots adds to the buffer's reason."""
        robots = self._roster.robots()
        if self._listener.robot != "*":
            robots = tuple(info for info in robots if info.name == self._listener.robot)
        if isinstance(reason, UnknownFrame):
            return "" if reason.near_misses else self._who_lacks("robot_description", robots)
        return self._who_lacks("joint_states", robots) if isinstance(reason, NoData) else ""

    def _who_lacks(self, stream: Stream, robots: Sequence[RobotInfo]) -> str:
        everybody = self._roster.robots()
        if not robots:
            robot = self._listener.robot
            return announced_text(everybody) if robot == "*" else unknown_robot(robot, everybody)
        lacking = [info.name for info in robots if stream not in self._roster.streams(info.name)]
        return "; ".join(self._roster.silence(robot, stream) for robot in lacking) or announced_text(robots)

    def _end(self) -> None:
        """Say that the wait is over, if it was said to have begun."""
        if self._said is None:
            return
        self._said = None
        frames = self._listener.buffer.frames()
        for robot in self._listener.robots():
            own = [frame for frame in frames if frame.name.startswith(f"{robot}/")]
            joints = sum(frame.kind == "joint" for frame in own)
            note(f"heard {robot}: {count_text(len(own), 'frame')}, {count_text(joints, 'joint')}")
