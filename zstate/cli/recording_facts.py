"""What is in a recording, robot by robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from zstate.errors import MessageError, ModelError
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.record.channel import ROBOT, Channel
from zstate.record.info import RecordingInfo
from zstate.record.reader import RecordReader
from zstate.wire.keys import Stream
from zstate.wire.ros2.plain import decode_string
from zstate.wire.ros2.qos import STREAM_QOS
from zstate.wire.ros2.topics import robot_of_topic, type_of


def stream_of(channel: Channel) -> Stream | None:
    """The stream of a robot that a channel carries, or None for any other topic."""
    name = channel.topic.rpartition("/")[2]
    for stream in STREAM_QOS:
        if name == stream and channel.type_name == type_of(stream).name:
            return stream
    return None


@dataclass(frozen=True)
class RecordedStream:
    """What one writer said. ``rate_hz`` is the mean over the whole recording, None of latched values."""

    stream: Stream
    topic: str
    type: str
    count: int
    rate_hz: float | None
    writer: str


@dataclass(frozen=True)
class RecordedRobot:
    """One robot of a recording; ``model`` is None where there is none, ``fault`` says if it is of no use."""

    name: str
    model: RobotModel | None
    fault: str
    streams: tuple[RecordedStream, ...]

    def facts(self) -> dict[str, Any]:
        """The same as JSON has it."""
        model = self.model
        return {
            "robot": self.name,
            "model": None
            if model is None
            else {"name": model.name, "links": list(model.links), "joints": list(model.joint_names)},
            "streams": [vars(stream) for stream in self.streams],
        }


def recorded_robots(info: RecordingInfo) -> list[RecordedRobot]:
    """The robots by name. RecordingError when a description's chunk turns out to be damaged."""
    by_name: dict[str, list[Channel]] = {}
    for channel in info.channels:
        if stream_of(channel) not in (None, "clock"):
            name = channel.metadata.get(ROBOT) or robot_of_topic(channel.topic)
            by_name.setdefault(name, []).append(channel)
    with RecordReader(info.path) as reader:
        return [_robot(name, reader, channels, info.duration_s) for name, channels in sorted(by_name.items())]


def other_channels(info: RecordingInfo) -> list[Channel]:
    """The clock, and what says nothing of a robot's state."""
    return [channel for channel in info.channels if stream_of(channel) in (None, "clock")]


def mean_rate(channel: Channel, duration_s: float) -> float | None:
    """The messages of a channel a second, over the whole recording."""
    return (channel.count - 1) / duration_s if channel.count > 1 and duration_s > 0.0 else None


def _robot(name: str, reader: RecordReader, channels: Sequence[Channel], duration_s: float) -> RecordedRobot:
    model, fault = _model(reader, {c.topic for c in channels if stream_of(c) == "robot_description"}, name)
    return RecordedRobot(name, model, fault, tuple(_stream(channel, duration_s) for channel in channels))


def _model(reader: RecordReader, topics: set[str], name: str) -> tuple[RobotModel | None, str]:
    """The first model that was recorded."""
    record = next(reader.records(topics), None) if topics else None
    if record is None:
        return None, ""
    try:
        return parse_urdf(decode_string(record.payload), f"the model of {name!r}"), ""
    except (MessageError, ModelError) as error:
        return None, str(error)


def _stream(channel: Channel, duration_s: float) -> RecordedStream:
    stream = stream_of(channel)
    assert stream is not None
    is_latched = STREAM_QOS[stream].durability == "transient_local"
    rate = None if is_latched else mean_rate(channel, duration_s)
    names = (channel.metadata.get("zstate.writer", ""), channel.metadata.get("zstate.program", ""))
    writer = ", ".join(filter(None, names))
    return RecordedStream(stream, channel.topic, channel.type_name, channel.count, rate, writer)
