"""The frames of the announced robots, heard for as short a time as tells all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from zstate.cli.console import note
from zstate.cli.processes import BackgroundCall
from zstate.cli.robot_directory import announced_robots
from zstate.cli.waiting import ConditionWaiter
from zstate.cli.words import words_of

if TYPE_CHECKING:
    from zstate.buffer.frames import FrameInfo
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session
    from zstate.nodes.listener import TransformListener

_NO_FRAMES = "announced, but without any frame: who publishes the model? `zstate publish ROBOT` does"
_MODELS_WITHIN_S = 3.0
_SAMPLES_WITHIN_S = 1.0
# A rate that two samples tell may be far off.
_RATE_OVER_NS = 100_000_000
QUIET_S = 0.15


def gathered_frames(session: Session, robot: str) -> tuple[FrameInfo, ...]:
    """Every frame of ``robot``, or of all robots for "*", with rates and stamps where samples come.

    Says on standard error what is announced but does not arrive, and that nobody is announced. Fails when
    ``robot`` is not announced.
    """
    from zstate.net.presence import discover
    from zstate.wire.keys import ANY

    # Models and statics come while those who write them are asked for, which is mostly waiting.
    asked = BackgroundCall(
        "zstate announced",
        lambda: discover(session) if robot == ANY else announced_robots(session, robot),
    )
    from zstate.nodes.listener import TransformListener

    waiter = ConditionWaiter()
    with TransformListener(session, robot) as listener:
        listener.add_observer(waiter.notify)
        robots = asked.result()
        if not robots:
            note(words_of("native").announced(()))
            return ()
        _wait_for_models(listener, robots, waiter)
        _wait_for_samples(listener, robots, waiter)
        frames = listener.buffer.frames()
    if not frames:
        note(_NO_FRAMES)
    return frames


def _wait_for_models(
    listener: TransformListener, robots: tuple[RobotInfo, ...], waiter: ConditionWaiter
) -> None:
    """Wait for all models, and for all static edges or 0.15 s without a new frame; note what is missing."""

    def is_complete(stable: bool) -> bool:
        has_statics = stable or _has_statics(listener.buffer.frames(), robots)
        return has_statics and not _missing(listener, robots)

    waiter.wait_until_stable(
        lambda: len(listener.buffer.frames()), is_complete, quiet_s=QUIET_S, timeout_s=_MODELS_WITHIN_S
    )
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


def _wait_for_samples(
    listener: TransformListener, robots: tuple[RobotInfo, ...], waiter: ConditionWaiter
) -> None:
    """Wait for enough samples of every published joint to measure its rate, at most 1 s."""
    published = {robot.name for robot in robots if "joint_states" in _streams(robot)}

    def have_rates() -> bool:
        frames = (frame for frame in listener.buffer.frames() if frame.name.partition("/")[0] in published)
        return all(frame.kind != "joint" or _tells_its_rate(frame) for frame in frames)

    waiter.wait_for(have_rates, _SAMPLES_WITHIN_S)


def _tells_its_rate(frame: FrameInfo) -> bool:
    return frame.count > 1 and (frame.newest or 0) - (frame.oldest or 0) >= _RATE_OVER_NS


def _streams(robot: RobotInfo) -> set[str]:
    return {stream for stream, _ in robot.writers}
