"""The frames that ROS nodes publish, heard until each of them has spoken."""

from __future__ import annotations

from typing import TYPE_CHECKING

from zstate.cli.console import fail, note
from zstate.cli.frames import QUIET_S
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.waiting import ConditionWaiter

if TYPE_CHECKING:
    from zstate.buffer.frames import FrameInfo
    from zstate.net.session import Session
    from zstate.nodes.listener import TransformListener

# Nodes that publish transforms do so at 1 Hz at least; those that go on saying nothing are named.
_SPOKEN_WITHIN_S = 2.0
_ANNOUNCED_WITHIN_S = 1.0


def gathered_ros_frames(session: Session, robot: str, wire: str) -> tuple[FrameInfo, ...]:
    """Every frame on /tf and /tf_static, with rates and stamps.

    Says on standard error which node publishes transforms, but has sent none. Fails when nobody does.
    """
    from zstate.nodes.listener import TransformListener

    waiter = ConditionWaiter()
    with (
        RobotDirectory(session, robot, wire, waiter.notify) as roster,
        TransformListener(session, robot, wire=wire, follow="tf") as listener,
    ):
        listener.add_observer(waiter.notify)
        if not waiter.wait_for(lambda: listener.buffer.frames() or _nodes(roster), _ANNOUNCED_WITHIN_S):
            fail(roster.words.silence(robot, "tf", roster.robots(), ended=False))
        for node in _silent_nodes(listener, roster, waiter):
            topic = roster.words.place(robot, ("tf",))
            note(f"{node} announces {topic}, but has sent nothing for {_SPOKEN_WITHIN_S:g} s")
        return listener.buffer.frames()


def _silent_nodes(listener: TransformListener, roster: RobotDirectory, waiter: ConditionWaiter) -> list[str]:
    """Wait for two samples of each node and 0.15 s without a new frame; the nodes without any after 2 s."""

    def is_complete(stable: bool) -> bool:
        return stable and not _nodes(roster) - _writers(listener.buffer.frames(), least=2)

    waiter.wait_until_stable(
        lambda: len(listener.buffer.frames()), is_complete, quiet_s=QUIET_S, timeout_s=_SPOKEN_WITHIN_S
    )
    return sorted(_nodes(roster) - _writers(listener.buffer.frames(), least=1))


def _nodes(roster: RobotDirectory) -> set[str]:
    """Who publishes transforms that move."""
    said = (pair for info in roster.robots() for pair in info.writers)
    return {str(writer) for stream, writer in said if stream == "tf"}


def _writers(frames: tuple[FrameInfo, ...], *, least: int) -> set[str | None]:
    """Who has sent ``least`` samples of an edge."""
    return {frame.writer for frame in frames if frame.kind == "pose" and frame.count >= least}
