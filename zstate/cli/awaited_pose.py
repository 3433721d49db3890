"""AwaitedPose: waiting for an answer of a buffer, and telling a person what for."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NoReturn

from zstate.cli.output.console import fail, print_status
from zstate.cli.roster import Roster
from zstate.errors import InFuture, InPast, LookupFailed, NoData, UnknownFrame, WaitTimeout, duration_text

if TYPE_CHECKING:
    from zstate.listener import TransformListener
    from zstate.transform import Transform

# Whoever has answers usually gives the first one sooner; waiting is mentioned only afterwards.
_GRACE_S = 0.5

_LEAVE_OUT = "leave --at out for the newest pose"
_NOT_RECEIVED = (
    "this command knows what it receives while it runs, and what publishers still have of the last seconds: "
    f"{_LEAVE_OUT}, or name an instant to come"
)


class AwaitedPose:
    """Asks ``listener`` for one pose, again and again, and tells a person what it waits for."""

    def __init__(self, listener: TransformListener, roster: Roster, target: str, source: str) -> None:
        self._listener = listener
        self._roster = roster
        self._words = roster.words
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
        edge = writer = ""
        if isinstance(reason, LookupFailed):
            edge = "" if reason.edge is None else f" of {' -> '.join(map(repr, reason.edge))}"
            writer = "" if reason.writer is None else f", which {reason.writer} wrote"
        age_s = self.age_s(transform)
        old = "" if age_s is None else f": the newest is {duration_text(round(age_s * 1e9))} old"
        return self._words.explained(f"no new sample{edge}{writer}{old}")

    def age_s(self, transform: Transform) -> float | None:
        """How old an answer is [s]; None for a static one, and by a clock that does not tell its time."""
        buffer = self._listener.buffer
        if transform.stamp is None:
            return None
        if (buffer.domain_between(*self._frames) or buffer.clock.domain) != buffer.clock.domain:
            return None
        return transform.age(buffer.clock)

    def explained(self, text: str) -> str:
        """What the library says of the frames, with the names that serve here."""
        return self._words.explained(text)

    def _say_once(self, reason: LookupFailed) -> None:
        hint = self._hint(reason)
        key = (type(reason), reason.edge, getattr(reason, "name", ""), hint)
        if key != self._said:
            self._said = key
            print_status(f"waiting: {self._explained(reason, hint)}")

    def _refuse_past(self, reason: InPast) -> NoReturn:
        if reason.is_of_another_time:
            fail(f"{self._words.explained(reason.happening)}; {_LEAVE_OUT}")
        fail(f"{self._words.explained(reason.happening)}; {_NOT_RECEIVED}")

    def _give_up(self, reason: WaitTimeout, timeout_s: float) -> NoReturn:
        advice = ""
        if isinstance(reason, InFuture):
            advice = (
                f"; {_LEAVE_OUT}"
                if reason.is_of_another_time
                else f"; wait longer (--timeout), or {_LEAVE_OUT}"
            )
        if isinstance(reason, InPast):
            advice = f"; {_LEAVE_OUT if reason.is_of_another_time else _NOT_RECEIVED}"
        fail(f"gave up after {timeout_s:g} s: {self._explained(reason, self._hint(reason))}{advice}")

    def _explained(self, reason: LookupFailed, hint: str) -> str:
        if isinstance(reason, UnknownFrame) and not reason.frame_count:
            return hint  # no frame at all is known: that is not about this one
        if isinstance(reason, InFuture | InPast):
            return self._words.explained(reason.happening)  # what a program would do is of no use here
        return f"{self._words.explained(reason.explanation())}{f' ({hint})' if hint else ''}"

    def _hint(self, reason: LookupFailed) -> str:
        """What the roster of robots adds to the buffer's reason."""
        robot, robots = self._listener.robot, self._roster.robots()
        if isinstance(reason, UnknownFrame):
            heard = bool(reason.frame_count)
            if reason.near_misses:
                return ""
            return self._words.lacking(robot, "robot_description", robots, heard=heard)
        if isinstance(reason, NoData):
            return self._words.lacking(robot, "joint_states", robots, heard=True)
        return ""

    def _end(self) -> None:
        """Say that the wait is over, if it was said to have begun."""
        if self._said is None:
            return
        self._said = None
        frames = self._listener.buffer.frames()
        for robot in self._listener.robots():
            print_status(self._words.heard(robot, frames))
