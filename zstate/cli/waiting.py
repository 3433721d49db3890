"""Waiting for robots, poses and other conditions; prints what is missing.

Callbacks of subscriptions wake the waiting main thread; no state is polled. Ctrl-C ends every wait at once.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, NoReturn

from zstate._util.closeable import Closeable
from zstate.cli.output.console import GRACE_S, fail, print_status
from zstate.cli.output.wire_text import is_ros
from zstate.cli.robot_directory import RobotDirectory
from zstate.clock import wait_interruptible
from zstate.errors import (
    InFuture,
    InPast,
    LookupFailed,
    NoData,
    UnknownFrame,
    WaitTimeout,
    format_duration,
)

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.net.session import Session
    from zstate.net.subscription import Received
    from zstate.nodes.listener import Follow, TransformListener
    from zstate.streams import StreamName
    from zstate.transform import Transform

# A burst of notifications costs one check: conditions on a large fleet take milliseconds.
_CHECK_INTERVAL_S = 0.02

_LEAVE_OUT = "leave --at out for the newest pose"
_NOT_RECEIVED = (
    "this command has only the samples received while it runs, and the last seconds that publishers keep: "
    f"{_LEAVE_OUT}, or give a later instant"
)


class ConditionWaiter:
    """Wakes the waiting main thread when a condition may have become true.

    ``notify`` is a callback for subscriptions: any thread, any arguments. ``last_reason`` is the one that
    the latest ``wait_for`` printed, empty if it printed none.
    """

    def __init__(self) -> None:
        self.last_reason = ""
        self._changed = threading.Event()

    def notify(self, *_: object) -> None:
        """Have waiting conditions checked again."""
        self._changed.set()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for a notification since the last call, at least 20 ms; False after ``timeout_s``."""
        began = time.monotonic()
        if not wait_interruptible(self._changed, timeout_s):
            return False
        time.sleep(max(0.0, began + _CHECK_INTERVAL_S - time.monotonic()))
        self._changed.clear()
        return True

    def wait_for(
        self,
        condition: Callable[[], object],
        timeout_s: float | None = None,
        reason: Callable[[], str] | None = None,
    ) -> bool:
        """Wait until ``condition()`` is true; False after ``timeout_s``.

        A wait of more than 0.5 s prints ``reason()``, again whenever it changes.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        report_at: float | None = None
        self.last_reason = ""
        while not condition():
            now = time.monotonic()
            if deadline is not None and now >= deadline:
                return False
            if reason is not None and report_at is None:
                report_at = now + GRACE_S  # from the first check on, which may have loaded modules
            elif reason is not None and report_at is not None and now >= report_at:
                # Not every change of a reason notifies, so it is evaluated twice a second as well.
                report_at = now + GRACE_S
                if (text := reason()) != self.last_reason:
                    self.last_reason = text
                    print_status(f"waiting: {text}", event="waiting")
            wake_at = min((one for one in (deadline, report_at) if one is not None), default=None)
            self.wait(None if wake_at is None else wake_at - now)
        return True

    def wait_until_stable(
        self,
        state: Callable[[], object],
        is_complete: Callable[[bool], bool],
        *,
        quiet_s: float,
        timeout_s: float,
    ) -> None:
        """Wait until ``is_complete(stable)``, for at most ``timeout_s``.

        ``stable`` is True if ``state()`` has had the same value for ``quiet_s``.
        """
        began = changed = time.monotonic()
        value = state()
        while (now := time.monotonic()) < began + timeout_s:
            if (current := state()) != value:
                value, changed = current, now
            is_stable = now >= changed + quiet_s
            if is_complete(is_stable):
                return
            self.wait((began + timeout_s if is_stable else min(began + timeout_s, changed + quiet_s)) - now)


class RobotReadiness(Closeable):
    """Readiness of ``robots``: a robot is ready when every moving edge has a sample."""

    def __init__(self, session: Session, robots: Sequence[str], wire: str) -> None:
        from zstate.net.subscription import subscribe
        from zstate.wire.registry import get_wire

        self._session, self._wire = session, wire
        self._robots = tuple(dict.fromkeys(robots))
        self._rigid: set[str] = set()
        self._listeners: dict[str, list[TransformListener]] = {}
        self._waiter = ConditionWaiter()
        self._missing = ""
        with ExitStack() as opening:
            robot = self._robots[0] if len(self._robots) == 1 else "*"
            directory = RobotDirectory(session, robot, wire, self._waiter.notify)
            self._directory = opening.enter_context(directory)
            if not is_ros(wire):
                rigid = subscribe(session, get_wire(wire), robot, "robot_description", self._on_descriptions)
                opening.enter_context(rigid)
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def frames(self, robot: str) -> tuple[FrameInfo, ...]:
        """The known frames of ``robot``."""
        return max((one.buffer.frames() for one in self._listeners.get(robot, ())), key=len, default=())

    def wait(self, timeout_s: float) -> str:
        """Wait until all robots are ready; what is missing after ``timeout_s``, empty if nothing is."""

        def are_ready() -> bool:
            self._missing = next((text for robot in self._robots if (text := self._missing_text(robot))), "")
            return not self._missing

        self._waiter.wait_for(are_ready, timeout_s, lambda: self._missing)
        return self._missing

    def _missing_text(self, robot: str) -> str:
        streams, directory = self._directory.streams(robot), self._directory
        if not streams:
            return directory.messages.unknown(robot, directory.robots())
        from zstate.nodes.listener import TransformListener
        from zstate.streams import JOINT_STREAMS

        stream: StreamName = "joint_states" if "robot_description" in streams else "robot_description"
        # Without a writer of joint states, transforms may be published instead.
        follows: list[Follow] = (
            ["joint_states", "tf"] if JOINT_STREAMS.isdisjoint(streams) else ["joint_states"]
        )
        if is_ros(self._wire):
            stream, follows = "tf", ["tf"]
        if robot not in self._listeners:
            self._listeners[robot] = []
            for follow in follows:
                listener = TransformListener(
                    self._session, robot, wire=self._wire, follow=follow, history_on_join=False
                )
                listener.add_observer(self._waiter.notify)
                self._listeners[robot].append(self._opened.enter_context(listener))
        for listener in self._listeners[robot]:
            frames = listener.buffer.frames()  # those of the model arrive by themselves
            moving = [frame for frame in frames if frame.kind in ("joint", "pose")]
            if (moving or (frames and robot in self._rigid)) and all(frame.count for frame in moving):
                return ""
        refused = "; ".join(text for one in self._listeners[robot] for text in one.refusals.values())
        return refused or directory.no_sample_text(robot, stream)

    def _on_descriptions(self, received: list[Received]) -> None:
        """Register robots without moving joints: they publish no samples."""
        from zstate.wire.messages import RobotDescription

        for robot, _, message in received:
            if isinstance(message, RobotDescription) and not message.moving_edges:
                self._rigid.add(robot)
                self._waiter.notify()


class PoseWaiter:
    """Waits for poses of ``source`` in ``target``, and prints on standard error what is missing."""

    def __init__(
        self, listener: TransformListener, directory: RobotDirectory, target: str, source: str
    ) -> None:
        self._listener = listener
        self._directory = directory
        self._messages = directory.messages
        self._frames = (target, source)
        self._reported: tuple[object, ...] | None = None

    def wait(self, at: int | None = None, *, timeout_s: float | None = None) -> Transform:
        """The pose at ``at``, or the newest, as soon as it is known.

        Raises LookupFailed if waiting cannot help. Fails after ``timeout_s``.
        """
        began = time.monotonic()
        while True:
            left_s = GRACE_S if timeout_s is None else began + timeout_s - time.monotonic()
            try:
                transform = self._listener.buffer.wait(*self._frames, at, max(0.0, min(left_s, GRACE_S)))
            except WaitTimeout as reason:
                if timeout_s is not None and left_s <= GRACE_S:
                    self._fail_after(timeout_s, reason)
                hint = self._hint(reason)
                key = (type(reason), reason.edge, getattr(reason, "name", ""), hint)
                if key != self._reported:
                    self._reported = key
                    print_status(f"waiting: {self._reason_text(reason, hint)}")
            except InPast as reason:
                advice = _LEAVE_OUT if reason.is_of_another_time else _NOT_RECEIVED
                fail(f"{self.translate(reason.what_happened)}; {advice}")
            else:
                if self._reported is not None:
                    self._reported = None
                    frames = self._listener.buffer.frames()
                    for robot in self._listener.robots():
                        print_status(self._messages.received_text(robot, frames))
                return transform

    def no_sample_text(self) -> str:
        """Why no newer pose arrives: the edge with the oldest samples."""
        transform = self._listener.buffer.lookup(*self._frames)
        reason = self._listener.buffer.explain(*self._frames, transform.stamp + 1)
        edge = writer = ""
        if isinstance(reason, LookupFailed):
            edge = "" if reason.edge is None else f" of {' -> '.join(map(repr, reason.edge))}"
            writer = "" if reason.writer is None else f", which {reason.writer} wrote"
        age_s = self.age_s(transform)
        old = "" if age_s is None else f": the newest is {format_duration(round(age_s * 1e9))} old"
        return self.translate(f"no new sample{edge}{writer}{old}")

    def age_s(self, transform: Transform) -> float | None:
        """Age of a pose [s]; None if it is static, or stamped by another clock than the buffer's."""
        buffer = self._listener.buffer
        if transform.stamp is None:
            return None
        domains = {frame.domain for _, frame in buffer.path_frames(*self._frames) if frame is not None}
        if not domains <= {None, buffer.clock.domain}:
            return None
        return transform.age(buffer.clock)

    def translate(self, text: str) -> str:
        """A text of the library about these frames, with the names and commands of the wire."""
        return self._messages.translate(text)

    def _fail_after(self, timeout_s: float, reason: WaitTimeout) -> NoReturn:
        advice = ""
        if isinstance(reason, InFuture | InPast) and reason.is_of_another_time:
            advice = f"; {_LEAVE_OUT}"
        elif isinstance(reason, InFuture):
            advice = f"; wait longer (--timeout), or {_LEAVE_OUT}"
        elif isinstance(reason, InPast):
            advice = f"; {_NOT_RECEIVED}"
        fail(f"gave up after {timeout_s:g} s: {self._reason_text(reason, self._hint(reason))}{advice}")

    def _reason_text(self, reason: LookupFailed, hint: str) -> str:
        if isinstance(reason, UnknownFrame) and not reason.frame_count:
            return hint  # no frame is known at all, not only this one
        if isinstance(reason, InFuture | InPast):
            return self.translate(reason.what_happened)  # without the advice for programs
        return f"{self.translate(reason.message())}{f' ({hint})' if hint else ''}"

    def _hint(self, reason: LookupFailed) -> str:
        """What the directory of robots adds to the reason of the buffer."""
        robot, robots = self._listener.robot, self._directory.robots()
        if isinstance(reason, UnknownFrame) and not reason.near_misses:
            return self._messages.missing_text(
                robot, "robot_description", robots, has_frames=bool(reason.frame_count)
            )
        if isinstance(reason, NoData):
            return self._messages.missing_text(robot, "joint_states", robots, has_frames=True)
        return ""
