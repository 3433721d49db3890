"""Words: what a person is told of robots and their streams, in the terms of the wire that is spoken."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, Protocol

from zstate._util.suggestions import did_you_mean
from zstate.cli.output.console import count_text

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.net.presence import RobotInfo
    from zstate.wire.keys import Stream


def is_ros(wire: str) -> bool:
    """Whether the wire that a user calls so is one of ROS's."""
    return not wire.startswith("native")


def default_stream(wire: str) -> Literal["joint_states", "tf"]:
    """The stream that tells where frames are: what everybody writes, and needs no model on ROS's side."""
    return "tf" if is_ros(wire) else "joint_states"


@lru_cache(maxsize=64)
def publish_command_for(command: str, robot: str) -> str:
    """`zstate publish` or `zstate joints` for ``robot``: by its name where that is a known model's too."""
    from zstate.errors import ModelError
    from zstate.model.catalog import find_entry

    try:
        return f"zstate {command} {find_entry(robot).name}"
    except ModelError:
        return f"zstate {command} FILE --name {robot}"


def messages_for(wire: str) -> WireMessages:
    """The words for the wire that a user calls so. Raises InvalidInput for one that there is not."""
    return RosWords(wire) if is_ros(wire) else NativeWords()


class WireMessages(Protocol):
    """How one wire calls things."""

    @property
    def robot(self) -> str | None:
        """Whose state a command shows that names no robot; None where it must name one."""
        ...

    def place(self, robot: str, streams: Sequence[Stream]) -> str:
        """Where ``streams`` are to be heard."""
        ...

    def announced(self, robots: Sequence[RobotInfo]) -> str:
        """Who is there, for the end of a message about one that is not."""
        ...

    def unknown(self, robot: str, robots: Sequence[RobotInfo]) -> str:
        """That nobody announces ``robot``, and who is there."""
        ...

    def no_sample_text(self, robot: str, stream: Stream, robots: Sequence[RobotInfo], *, ended: bool) -> str:
        """Why no sample of ``stream`` comes (any more, if ``ended``)."""
        ...

    def missing_text(self, robot: str, stream: Stream, robots: Sequence[RobotInfo], *, heard: bool) -> str:
        """Who lacks ``stream``, or its like, so that a pose is not known; ``heard``: some frames are."""
        ...

    def heard(self, robot: str, frames: Sequence[FrameInfo]) -> str:
        """That waiting for ``robot`` is over."""
        ...

    def translate(self, text: str) -> str:
        """An explanation of the library, with the names and commands that serve here."""
        ...


class NativeWords:
    """Robots have names and say so."""

    robot = None

    def place(self, robot: str, streams: Sequence[Stream]) -> str:
        said = streams[0] if len(streams) == 1 else f"{{{','.join(streams)}}}"
        return f"zstate/{robot}/{said}"

    def announced(self, robots: Sequence[RobotInfo]) -> str:
        if not robots:
            from zstate.model.catalog import example_name
            from zstate.net.rendezvous import silent_addresses
            from zstate.net.security.connection_check import check_rendezvous  # loads ssl, which few need

            start = f"start one, for instance with `zstate publish {example_name()} --source sine`"
            silent = check_rendezvous(silent_addresses())
            advice = f"{silent.text}; `zstate doctor` says more" if silent else start
            return f"no robot is announced; {advice}"
        return f"announced: {', '.join(repr(robot.name) for robot in robots)}"

    def unknown(self, robot: str, robots: Sequence[RobotInfo]) -> str:
        hint = did_you_mean(robot, [info.name for info in robots])
        return f"nobody announces the robot {robot!r}{hint} ({self.announced(robots)})"

    def no_sample_text(self, robot: str, stream: Stream, robots: Sequence[RobotInfo], *, ended: bool) -> str:
        streams = {said for info in robots if info.name == robot for said, _ in info.writers}
        if not streams:
            return self.unknown(robot, robots)
        if stream in streams:
            what = f"{robot!r} is announced with {stream}, but no {'new ' * ended}sample comes"
            return f"{what}; `zstate doctor {robot}` says why"
        command = "joints" if stream == "joint_states" else "publish"
        hint = publish_command_for(command, robot)
        return f"nobody writes {stream} of {robot!r}{' any more' * ended}; `{hint}` would"

    def missing_text(self, robot: str, stream: Stream, robots: Sequence[RobotInfo], *, heard: bool) -> str:
        wanted = [info for info in robots if robot in ("*", info.name)]
        if not wanted:
            return self.announced(robots) if robot == "*" else self.unknown(robot, robots)
        without = [info for info in wanted if stream not in {said for said, _ in info.writers}]
        reasons = [self.no_sample_text(info.name, stream, robots, ended=False) for info in without]
        return "; ".join(reasons) or self.announced(wanted)

    def heard(self, robot: str, frames: Sequence[FrameInfo]) -> str:
        own = [frame for frame in frames if frame.name.startswith(f"{robot}/")]
        joints = sum(frame.kind == "joint" for frame in own)
        return f"heard {robot}: {count_text(len(own), 'frame')}, {count_text(joints, 'joint')}"

    def translate(self, text: str) -> str:
        return text


class RosWords:
    """ROS has topics and nodes, and one flat tree of frames."""

    def __init__(self, wire: str) -> None:
        from zstate.wire.registry import get_wire
        from zstate.wire.ros2.topics import DdsKeys, RmwKeys
        from zstate.wire.ros2.wire import Ros2Wire

        spoken = get_wire(wire)
        assert isinstance(spoken, Ros2Wire)
        self._spec = wire
        self._options = spoken.options
        over_dds = spoken.name == "ros2dds"
        self._topics = DdsKeys(spoken.options) if over_dds else RmwKeys(spoken.options)
        self._where = "behind the ros2dds bridge" if over_dds else f"in domain {spoken.options.domain}"

    @property
    def robot(self) -> str | None:
        from zstate.wire.ros2.topics import SHARED

        namespace = self._options.namespace
        return None if namespace == "*" else namespace.rpartition("/")[2] or SHARED

    def topic(self, robot: str, stream: Stream) -> str:
        """The topic that carries ``stream`` of ``robot``, or of whoever there is for "*"."""
        return self._topics.topic("NAMESPACE" if robot == "*" else robot, stream)

    def place(self, robot: str, streams: Sequence[Stream]) -> str:
        topics = ", ".join(self.topic(robot, stream) for stream in streams)
        return f"ROS 2 topic{'s' if len(streams) > 1 else ''} {topics} ({self._where.removeprefix('in ')})"

    def announced(self, robots: Sequence[RobotInfo]) -> str:
        if not robots:
            return f"nobody publishes the state of a robot {self._where}; {self._advice}"
        topics = {self.topic(info.name, stream) for info in robots for stream, _ in info.writers}
        return f"published {self._where}: {', '.join(sorted(topics))}"

    def unknown(self, robot: str, robots: Sequence[RobotInfo]) -> str:
        return self.announced(robots)

    def no_sample_text(self, robot: str, stream: Stream, robots: Sequence[RobotInfo], *, ended: bool) -> str:
        topic, writers = self.topic(robot, stream), self._writers(robot, stream, robots)
        if writers:
            return f"{', '.join(writers)} publishes {topic}, but no {'new ' * ended}message comes"
        return f"nobody publishes {topic} {self._where}{' any more' * ended}; {self._advice}"

    def missing_text(self, robot: str, stream: Stream, robots: Sequence[RobotInfo], *, heard: bool) -> str:
        is_written = bool(self._writers(robot, "tf", robots))
        return "" if heard and is_written else self.no_sample_text(robot, "tf", robots, ended=False)

    def heard(self, robot: str, frames: Sequence[FrameInfo]) -> str:
        return f"heard {self.topic(robot, 'tf')}: {count_text(len(frames), 'frame')}"

    def translate(self, text: str) -> str:
        from zstate.wire.ros2.topics import SHARED

        without_owner = re.sub(rf"(?<![\w/]){SHARED}/", "", text)
        return re.sub(r"`zstate (ls|tree|static)\b", rf"`zstate \1 --wire {self._spec}", without_owner)

    def _writers(self, robot: str, stream: Stream, robots: Sequence[RobotInfo]) -> list[str]:
        infos = [info for info in robots if robot in ("*", info.name)]
        return sorted({str(writer) for info in infos for said, writer in info.writers if said == stream})

    @property
    def _advice(self) -> str:
        return f"are the domain and the router right? `zstate ls --wire {self._spec}` shows who is there"
