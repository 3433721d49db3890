"""The frames of the announced robots, heard for as short a time as tells all of them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from zstate.cli.console import note
from zstate.cli.roster import announced_robots
from zstate.cli.words import words_of
from zstate.cli.worker import Worker

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.listener import TransformListener
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session

_NO_FRAMES = "announced, but without any frame: who publishes the model? `zstate publish ROBOT` does"
_MODELS_WITHIN_S = 3.0
_SAMPLES_WITHIN_S = 1.0
# A rate that two samples tell may be far off.
_RATE_OVER_NS = 100_000_000
_QUIET_S = 0.15
_LOOK_EVERY_S = 0.02


def gathered_frames(session: Session, robot: str) -> tuple[FrameInfo, ...]:
    """Every frame of ``robot``, or of all robots for "*", with rates and stamps where samples come.

    Says on standard error what is announced but does not arrive, and that nobody is announced. Fails when
    ``robot`` is not announced.
    """
    from zstate.net.presence import discover
    from zstate.wire.keys import ANY

    # Models and statics come while those who write them are asked for, which is mostly waiting.
    asked = Worker(
        "zstate announced",
        lambda: discover(session) if robot == ANY else announced_robots(session, robot),
    )
    from zstate.listener import TransformListener

    with TransformListener(session, robot) as listener:
        robots = asked.result()
        if not robots:
            note(words_of("native").announced(()))
            return ()
        _wait_for_models(listener, robots)
        _wait_for_samples(listener, robots)
        frames = listener.buffer.frames()
    if not frames:
        note(_NO_FRAMES)
    return frames


def _wait_for_models(listener: TransformListener, robots: tuple[RobotInfo, ...]) -> None:
    """Until all that is announced is there, or all robots are described and nothing came for a moment."""
    deadline = time.monotonic() + _MODELS_WITHIN_S
    count, changed = 0, time.monotonic()
    while (now := time.monotonic()) < deadline:
        frames = listener.buffer.frames()
        if len(frames) != count:
            count, changed = len(frames), now
        is_quiet = now - changed > _QUIET_S
        if (is_quiet or _has_statics(frames, robots)) and not _missing(listener, robots):
            break
        time.sleep(_LOOK_EVERY_S)
    for text in _missing(listener, robots):
        note(text)


def _has_statics(frames: tuple[FrameInfo, ...], robots: tuple[RobotInfo, ...]) -> bool:
    """Whether every writer of static edges is known to have placed a frame."""
    from zstate.wire.keys import MODEL_WRITER

    names = [name for robot in robots for name, _ in robot.static_names if name != MODEL_WRITER]
    heard = {frame.writer for frame in frames if frame.kind == "static"}
    return len(names) == len(heard.intersection(names))  # not where two robots have one of the same name


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
    """Until there are enough samples of whatever is written, or it is clear that they are slow."""
    written = {robot.name for robot in robots if "joint_states" in _streams(robot)}
    deadline = time.monotonic() + _SAMPLES_WITHIN_S
    while time.monotonic() < deadline and any(
        frame.kind == "joint" and not _tells_its_rate(frame)
        for frame in listener.buffer.frames()
        if frame.name.partition("/")[0] in written
    ):
        time.sleep(_LOOK_EVERY_S)


def _tells_its_rate(frame: FrameInfo) -> bool:
    return frame.count > 1 and (frame.newest or 0) - (frame.oldest or 0) >= _RATE_OVER_NS


def _streams(robot: RobotInfo) -> set[str]:
    return {stream for stream, _ in robot.writers}
