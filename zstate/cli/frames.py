"""The frames of the announced robots, heard for as short a time as tells all of them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from zstate.cli.console import note
from zstate.cli.roster import announced_robots

if TYPE_CHECKING:
    from zstate.buffer.frames import FrameInfo
    from zstate.listener import TransformListener
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session

_MODELS_WITHIN_S = 3.0
_SAMPLES_WITHIN_S = 1.0
_QUIET_S = 0.15
_LOOK_EVERY_S = 0.02


def gathered_frames(session: Session, robot: str) -> tuple[FrameInfo, ...]:
    """Every frame of ``robot``, or of all robots for "*", with rates and stamps where samples come.

    Says on standard error what is announced but does not arrive. Fails when no such robot is
    announced.
    """
    from zstate.listener import TransformListener

    # Models and statics come while those who write them are asked for.
    with TransformListener(session, robot) as listener:
        robots = announced_robots(session, robot)
        _wait_for_models(listener, robots)
        _wait_for_samples(listener, robots)
        return listener.buffer.frames()


def _wait_for_models(listener: TransformListener, robots: tuple[RobotInfo, ...]) -> None:
    """Until all robots are described and nothing more has come for a moment: statics are many messages."""
    deadline = time.monotonic() + _MODELS_WITHIN_S
    count, changed = 0, time.monotonic()
    while (now := time.monotonic()) < deadline:
        frames = listener.buffer.frames()
        if len(frames) != count:
            count, changed = len(frames), now
        if now - changed > _QUIET_S and not _missing(listener, robots):
            break
        time.sleep(_LOOK_EVERY_S)
    for text in _missing(listener, robots):
        note(text)


def _missing(listener: TransformListener, robots: tuple[RobotInfo, ...]) -> list[str]:
    owners = {frame.name.partition("/")[0] for frame in listener.buffer.frames()}
    heard = {*owners, *listener.robots()}
    missing: list[str] = []
    for robot in robots:
        streams = _streams(robot)
        if "robot_description" in streams and robot.name not in owners:
            missing.append(f"{robot.name}: its model has not arrived within {_MODELS_WITHIN_S:g} s")
        elif "tf_static" in streams and robot.name not in heard:
            missing.append(f"{robot.name}: its static edges have not arrived within {_MODELS_WITHIN_S:g} s")
    return missing


def _wait_for_samples(listener: TransformListener, robots: tuple[RobotInfo, ...]) -> None:
    """Until there are two samples of whatever is written, or it is clear that they are slow."""
    written = {robot.name for robot in robots if "joint_states" in _streams(robot)}
    deadline = time.monotonic() + _SAMPLES_WITHIN_S
    while time.monotonic() < deadline and any(
        frame.kind == "joint" and frame.count < 2
        for frame in listener.buffer.frames()
        if frame.name.partition("/")[0] in written
    ):
        time.sleep(_LOOK_EVERY_S)


def _streams(robot: RobotInfo) -> set[str]:
    return {stream for stream, _ in robot.writers}
