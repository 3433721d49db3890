"""The frames that ROS nodes publish, heard until each of them has spoken."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from zstate.cli.console import fail, note
from zstate.cli.roster import Roster

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.listener import TransformListener
    from zstate.net.session import Session

# Nodes that publish transforms do so at 1 Hz at least; those that go on saying nothing are named.
_SPOKEN_WITHIN_S = 2.0
_ANNOUNCED_WITHIN_S = 1.0
_QUIET_S = 0.15
_LOOK_EVERY_S = 0.02


def gathered_ros_frames(session: Session, robot: str, wire: str) -> tuple[FrameInfo, ...]:
    """Every frame on /tf and /tf_static, with rates and stamps.

    Says on standard error which node publishes transforms, but has sent none. Fails when nobody does.
    """
    from zstate.listener import TransformListener

    with (
        Roster(session, robot, wire) as roster,
        TransformListener(session, robot, wire=wire, follow="tf") as listener,
    ):
        if not _somebody_is_there(listener, roster):
            fail(roster.words.silence(robot, "tf", roster.robots(), ended=False))
        for node in _silent_nodes(listener, roster):
            topic = roster.words.place(robot, ("tf",))
            note(f"{node} announces {topic}, but has sent nothing for {_SPOKEN_WITHIN_S:g} s")
        return listener.buffer.frames()


def _somebody_is_there(listener: TransformListener, roster: Roster) -> bool:
    deadline = time.monotonic() + _ANNOUNCED_WITHIN_S
    while time.monotonic() < deadline:
        if listener.buffer.frames() or _nodes(roster):
            return True
        time.sleep(_LOOK_EVERY_S)
    return False


def _silent_nodes(listener: TransformListener, roster: Roster) -> list[str]:
    """Wait until all nodes have spoken twice and nothing is new; who had not, when it took too long."""
    deadline = time.monotonic() + _SPOKEN_WITHIN_S
    count, changed = 0, time.monotonic()
    while (now := time.monotonic()) < deadline:
        frames = listener.buffer.frames()
        if len(frames) != count:
            count, changed = len(frames), now
        if now - changed > _QUIET_S and not _nodes(roster) - _writers(frames, least=2):
            break
        time.sleep(_LOOK_EVERY_S)
    return sorted(_nodes(roster) - _writers(listener.buffer.frames(), least=1))


def _nodes(roster: Roster) -> set[str]:
    """Who publishes transforms that move."""
    said = (pair for info in roster.robots() for pair in info.writers)
    return {str(writer) for stream, writer in said if stream == "tf"}


def _writers(frames: tuple[FrameInfo, ...], *, least: int) -> set[str | None]:
    """Who has sent ``least`` samples of an edge."""
    return {frame.writer for frame in frames if frame.kind == "pose" and frame.count >= least}
