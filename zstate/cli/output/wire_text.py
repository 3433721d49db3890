"""Messages about robots and streams in the vocabulary of a wire format: zstate's or ROS 2's."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

from zstate._util.format import did_you_mean
from zstate.cli.output.console import count_text

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.net.discovery import RobotInfo
    from zstate.streams import StreamName


OTHER_HOSTS = "--mode lan, or --connect tcp/HOST:7447 to a router"
"""The options with which commands find robots of other hosts."""


def is_ros(wire: str) -> bool:
    """Whether ``wire``, a value of --wire, is a ROS wire format."""
    return not wire.startswith("native")


def default_stream(wire: str) -> Literal["joint_states", "tf"]:
    """The stream from which poses are computed. On a ROS wire tf, which needs no model."""
    return "tf" if is_ros(wire) else "joint_states"


@lru_cache(maxsize=64)
def publish_command_for(command: str, robot: str) -> str:
    """`zstate publish` or `zstate joints` for ``robot``, which may have the name of a catalog model."""
    from zstate.errors import ModelError
    from zstate.model.catalog import find_entry

    try:
        return f"zstate {command} {find_entry(robot).name}"
    except ModelError:
        return f"zstate {command} FILE --name {robot}"


def messages_for(wire: str) -> NativeMessages | RosMessages:
    """The messages for ``wire``, a value of --wire. Raises InvalidInput if there is no such wire format."""
    return RosMessages(wire) if is_ros(wire) else NativeMessages()


class NativeMessages:
    """Messages for the native wire: robots have names and announce themselves."""

    robot: str | None = None
    """The robot of a command that names none; None if it must name one."""

    def topics(self, robot: str, streams: Sequence[StreamName]) -> str:
        """The keys or topics of ``streams``."""
        names = streams[0] if len(streams) == 1 else f"{{{','.join(streams)}}}"
        return f"zstate/{robot}/{names}"

    def announced(self, robots: Sequence[RobotInfo]) -> str:
        """The announced robots; with advice if there is none."""
        if not robots:
            from zstate.model.catalog import example_name

            start = f"start one, for instance with `zstate publish {example_name()} --source sine`"
            advice = self.incomplete_text() or f"{start}; robots of other hosts: {OTHER_HOSTS}"
            return f"no robot is announced; {advice}"
        return f"announced: {', '.join(repr(robot.name) for robot in robots)}"

    def incomplete_text(self) -> str:
        """Why robots of this host may be missing: a program where they meet does not answer; else empty."""
        from zstate.net.rendezvous import silent_addresses
        from zstate.net.security.connection_check import check_rendezvous  # loads ssl, which few need

        silent = check_rendezvous(silent_addresses())
        return "" if silent is None else f"{silent.text}; `zstate doctor` shows more"

    def unknown(self, robot: str, robots: Sequence[RobotInfo]) -> str:
        """That ``robot`` is not announced, and which robots are."""
        hint = did_you_mean(robot, [info.name for info in robots])
        return f"robot {robot!r} is not announced{hint} ({self.announced(robots)})"

    def no_sample_text(
        self, robot: str, stream: StreamName, robots: Sequence[RobotInfo], *, ended: bool
    ) -> str:
        """Why no sample of ``stream`` arrives (any more, if ``ended``)."""
        streams = {written for info in robots if info.name == robot for written, _ in info.writers}
        from zstate.stream_registry import find_stream

        if not streams:
            return self.unknown(robot, robots)
        if stream == "joint_setpoints":
            if stream in streams:
                return (
                    f"the driver host of {robot!r} writes no {'new ' * ended}setpoints: nothing commands it"
                )
            start = "start the program with its zstate.driving.DriverHost"
            return f"{robot!r} has no driver host{' any more' * ended}; {start}"
        if stream in streams:
            fact = f"{robot!r} is announced with {stream}, but no {'new ' * ended}sample arrives"
            return f"{fact}; `zstate doctor {robot}` finds the reason"
        if stream == "joint_states" and "partial_joint_states" in streams:
            fact = f"the joints of {robot!r} come from drivers of some joints each"
            return f"{fact}; `zstate echo {robot} --stream partial_joint_states` prints them"
        command = f"zstate transform TARGET SOURCE --xyz X Y Z --robot {robot}"
        if stream == "partial_joint_states":
            command = f"{publish_command_for('joints', robot)} --only NAME"
        elif stream != "transforms":
            command = publish_command_for("joints" if stream == "joint_states" else "publish", robot)
        start = f"start one: `{command}`"
        row = find_stream(stream)
        if row is not None and (row.start or row.is_measured):
            program = f"start the program that publishes it, with a zstate.StreamPublisher of {stream!r}"
            start = (row.start or program).replace("{robot}", robot)
        return f"{stream} of {robot!r} has no writer{' any more' * ended}; {start}"

    def missing_text(
        self, robot: str, stream: StreamName, robots: Sequence[RobotInfo], *, has_frames: bool
    ) -> str:
        """Which robots lack ``stream`` so that a pose is unknown; ``has_frames`` if some frames are known."""
        selected = [info for info in robots if robot in ("*", info.name)]
        if not selected:
            return self.announced(robots) if robot == "*" else self.unknown(robot, robots)
        without = [info for info in selected if stream not in {written for written, _ in info.writers}]
        reasons = [self.no_sample_text(info.name, stream, robots, ended=False) for info in without]
        return "; ".join(reasons) or self.announced(selected)

    def received_text(self, robot: str, frames: Sequence[FrameInfo]) -> str:
        """That ``robot`` has arrived."""
        own = [frame for frame in frames if frame.name.startswith(f"{robot}/")]
        joints = sum(frame.kind == "joint" for frame in own)
        return f"receiving {robot}: {count_text(len(own), 'frame')}, {count_text(joints, 'joint')}"

    def translate(self, text: str) -> str:
        """``text`` of the library, with the names and commands of this wire format."""
        return text


class RosMessages:
    """The same messages for ROS wires: topics, nodes, and one flat tree of frames."""

    def __init__(self, wire: str) -> None:
        from zstate.wire.registry import get_wire
        from zstate.wire.ros2.topics import DdsKeys, RmwKeys
        from zstate.wire.ros2.wire import Ros2Wire

        wire_format = get_wire(wire)
        assert isinstance(wire_format, Ros2Wire)
        self._spec = wire
        self._options = wire_format.options
        over_dds = wire_format.name == "ros2dds"
        self._topics = DdsKeys(self._options) if over_dds else RmwKeys(self._options)
        self._where = "behind the ros2dds bridge" if over_dds else f"in domain {self._options.domain}"
        self._advice = (
            f"check the domain and the router; `zstate ls --wire {wire}` shows all nodes and topics"
        )

    @property
    def robot(self) -> str | None:
        from zstate.wire.ros2.topics import SHARED

        namespace = self._options.namespace
        return None if namespace == "*" else namespace.rpartition("/")[2] or SHARED

    def topic(self, robot: str, stream: StreamName) -> str:
        """The topic that carries ``stream`` of ``robot``; for "*" with NAMESPACE as the robot."""
        return self._topics.topic("NAMESPACE" if robot == "*" else robot, stream)

    def topics(self, robot: str, streams: Sequence[StreamName]) -> str:
        topics = ", ".join(self.topic(robot, stream) for stream in streams)
        return f"ROS 2 topic{'s' if len(streams) > 1 else ''} {topics} ({self._where.removeprefix('in ')})"

    def announced(self, robots: Sequence[RobotInfo]) -> str:
        if not robots:
            return f"no node publishes the state of a robot {self._where}; {self._advice}"
        topics = {self.topic(info.name, stream) for info in robots for stream, _ in info.writers}
        return f"published {self._where}: {', '.join(sorted(topics))}"

    def unknown(self, robot: str, robots: Sequence[RobotInfo]) -> str:
        return self.announced(robots)

    def no_sample_text(
        self, robot: str, stream: StreamName, robots: Sequence[RobotInfo], *, ended: bool
    ) -> str:
        topic, writers = self.topic(robot, stream), self._writers(robot, stream, robots)
        if writers:
            return f"{', '.join(writers)} publishes {topic}, but no {'new ' * ended}message arrives"
        return f"no node publishes {topic} {self._where}{' any more' * ended}; {self._advice}"

    def missing_text(
        self, robot: str, stream: StreamName, robots: Sequence[RobotInfo], *, has_frames: bool
    ) -> str:
        is_written = bool(self._writers(robot, "tf", robots))
        return "" if has_frames and is_written else self.no_sample_text(robot, "tf", robots, ended=False)

    def received_text(self, robot: str, frames: Sequence[FrameInfo]) -> str:
        return f"receiving {self.topic(robot, 'tf')}: {count_text(len(frames), 'frame')}"

    def translate(self, text: str) -> str:
        from zstate.wire.ros2.topics import SHARED

        without_owner = re.sub(rf"(?<![\w/]){SHARED}/", "", text)
        return re.sub(r"`zstate (ls|tree|static)\b", rf"`zstate \1 --wire {self._spec}", without_owner)

    def _writers(self, robot: str, stream: StreamName, robots: Sequence[RobotInfo]) -> list[str]:
        infos = [info for info in robots if robot in ("*", info.name)]
        return sorted({str(writer) for info in infos for one, writer in info.writers if one == stream})
