"""What is in a recording, robot by robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from zstate.errors import MessageError, ModelError
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.recording.decode import LATCHED, RecordedWriter
from zstate.recording.info import RecordingInfo
from zstate.recording.reader import RecordingReader
from zstate.recording.storage import Channel
from zstate.wire.keys import Stream
from zstate.wire.ros2.plain import decode_string


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
    by_name: dict[str, list[tuple[RecordedWriter, Channel]]] = {}
    for channel in info.channels:
        speaker = RecordedWriter.from_channel(channel)
        if speaker is not None and speaker.robot:
            by_name.setdefault(speaker.robot, []).append((speaker, channel))
    with RecordingReader(info.path) as reader:
        return [_robot(name, reader, said, info.duration_s) for name, said in sorted(by_name.items())]


def other_channels(info: RecordingInfo) -> list[Channel]:
    """The clock, and what says nothing of a robot's state."""
    speakers = ((RecordedWriter.from_channel(channel), channel) for channel in info.channels)
    return [channel for speaker, channel in speakers if speaker is None or not speaker.robot]


def mean_rate(channel: Channel, duration_s: float) -> float | None:
    """The messages of a channel a second, over the whole recording."""
    return (channel.count - 1) / duration_s if channel.count > 1 and duration_s > 0.0 else None


def _robot(
    name: str, reader: RecordingReader, said: Sequence[tuple[RecordedWriter, Channel]], duration_s: float
) -> RecordedRobot:
    described = {channel.topic for speaker, channel in said if speaker.stream == "robot_description"}
    model, fault = _model(reader, described, name)
    streams = (_stream(speaker, channel, duration_s) for speaker, channel in said)
    return RecordedRobot(name, model, fault, tuple(streams))


def _model(reader: RecordingReader, topics: set[str], name: str) -> tuple[RobotModel | None, str]:
    """The first model that was recorded."""
    record = next(reader.records(topics), None) if topics else None
    if record is None:
        return None, ""
    try:
        return parse_urdf(decode_string(record.payload), f"the model of {name!r}"), ""
    except (MessageError, ModelError) as error:
        return None, str(error)


def _stream(speaker: RecordedWriter, channel: Channel, duration_s: float) -> RecordedStream:
    rate = None if speaker.stream in LATCHED else mean_rate(channel, duration_s)
    writer = ", ".join(filter(None, (speaker.static_writer, speaker.program)))
    return RecordedStream(speaker.stream, channel.topic, channel.type_name, channel.count, rate, writer)
