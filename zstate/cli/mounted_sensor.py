"""Simulated sensors on robots of the network: commands wait for their poses, and say what is missing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from zstate.cli.output.console import fail, print_status
from zstate.cli.output.wire_text import messages_for
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.waiting import ConditionWaiter
from zstate.nodes.listener import TransformListener
from zstate.wire.keys import full_name

if TYPE_CHECKING:
    from zstate.buffer.buffer import TransformBuffer
    from zstate.net.session import Session
    from zstate.nodes.mounted_sensor import MountedSensor

S = TypeVar("S", bound="MountedSensor")


class Words(NamedTuple):
    """What the texts name: the sensor, one of its measurements, and what it measures."""

    sensor: str
    measurement: str
    world: str


def mounted_on_robot(
    mount: Callable[[TransformBuffer, str, str], S],
    session: Session,
    robot: str,
    *,
    frames: tuple[str, str],
    wire: str,
    seconds: float | None,
    opened: ExitStack,
    words: Words,
) -> tuple[S, str]:
    """What ``mount(buffer, frame, world_frame)`` returns, once its pose is known; and where its world stands.

    ``frames`` are those of the sensor and of the world. What is missing is printed, such as the model of a
    robot that describes itself: without it the root of the robot is not known. The command fails if
    something is missing for ``seconds``.
    """
    messages, waiter = messages_for(wire), ConditionWaiter()
    listener = opened.enter_context(TransformListener(session, robot, wire=wire))
    listener.add_observer(waiter.notify)
    directory = opened.enter_context(RobotDirectory(session, robot, wire, waiter.notify))
    owner = messages.robot or robot
    frame, world_frame = (full_name(owner, name) for name in frames)
    source = mount(listener.buffer, frame, world_frame)

    is_described = False

    def has_model() -> bool:
        return not is_described or owner in listener.buffer.frame_table((owner,)).robots

    def reason() -> str:
        if not directory.streams(robot):
            return messages.unknown(robot, directory.robots())
        if not has_model():
            return directory.no_sample_text(robot, "robot_description")
        return messages.translate(str(source.problem()))

    def wait() -> None:
        if not waiter.wait_for(lambda: source.problem() is None and has_model(), seconds, reason):
            fail(f"no {words.measurement} in {seconds:g} s: {reason()}")

    wait()
    is_described = "robot_description" in directory.confirmed_streams(robot)
    wait()
    shown = messages.translate(source.target)
    print_status(f"simulating a {words.sensor} in {frames[0]}; {words.world} stands in {shown}")
    return source, shown
