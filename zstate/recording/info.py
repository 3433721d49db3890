"""Facts of a recording, in total and robot by robot, without reading its messages."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zstate.errors import MessageError, ModelError
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.recording.decode import RecordedWriter, recorded_writers
from zstate.recording.reader import RecordingReader
from zstate.recording.storage import ROBOT, Channel
from zstate.stream_registry import is_latched
from zstate.streams import StreamName
from zstate.wire.measurements import from_float32_block
from zstate.wire.ros2.cdr import decode_string
from zstate.wire.ros2.decoder import RosDecoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import SHARED, FrameNames


@dataclass(frozen=True)
class RecordingInfo:
    """Summary of a recording. ``size`` is in bytes; ``first`` and ``last`` are log times [ns].

    ``profiles``, ``libraries`` and ``compressions`` of its files and the ``robots`` named by its channels are
    without duplicates. ``skipped``, ``complete``, ``losses`` and ``missing`` are those of RecordingReader.
    """

    path: Path
    files: tuple[Path, ...]
    formats: tuple[str, ...]
    size: int
    profiles: tuple[str, ...]
    libraries: tuple[str, ...]
    compressions: tuple[str, ...]
    complete: bool
    losses: tuple[str, ...]
    missing: Mapping[str, int]
    first: int | None
    last: int | None
    channels: tuple[Channel, ...]
    skipped: tuple[Channel, ...]
    robots: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """Between the first and the last message [s]."""
        return 0.0 if self.first is None or self.last is None else (self.last - self.first) / 1e9

    @property
    def bytes_per_s(self) -> float | None:
        """Mean growth of its files; None without a duration."""
        return self.size / self.duration_s if self.duration_s > 0.0 else None

    @property
    def message_count(self) -> int:
        return sum(channel.count for channel in self.channels)


def read_info(path: str | os.PathLike[str]) -> RecordingInfo:
    """Read the summary of a recording. Raises RecordingError as RecordingReader does."""
    with RecordingReader(path) as reader:
        files = reader.storages
        first, last = reader.span or (None, None)
        return RecordingInfo(
            path=reader.path,
            files=tuple(file.path for file in files),
            formats=_unique(file.format for file in files),
            size=sum(file.size for file in files),
            profiles=_unique(file.profile for file in files),
            libraries=_unique(file.library for file in files),
            compressions=_unique(word for file in files for word in file.compressions),
            complete=reader.complete,
            losses=reader.losses,
            missing=reader.missing,
            first=first,
            last=last,
            channels=reader.channels(),
            skipped=reader.skipped,
            robots=_unique(channel.metadata.get(ROBOT, "") for channel in reader.channels()),
        )


def _unique(words: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word for word in words if word))


@dataclass(frozen=True)
class RecordedStream:
    """One writer's messages on one stream.

    ``rate_hz`` is the mean rate; None for latched values. ``rays`` is the number of rays in the first scan of
    the topic; None for other streams.
    """

    stream: StreamName
    topic: str
    type: str
    count: int
    rate_hz: float | None
    writer: str
    rays: int | None = None


@dataclass(frozen=True)
class RecordedRobot:
    """One robot of a recording; ``model`` is None without a usable one, ``fault`` is then the reason."""

    name: str
    model: RobotModel | None
    fault: str
    streams: tuple[RecordedStream, ...]

    def facts(self) -> dict[str, Any]:
        """The same as JSON has it."""
        model, facts = self.model, None
        if model is not None:
            facts = {"name": model.name, "links": list(model.links), "joints": list(model.joint_names)}
        return {"robot": self.name, "model": facts, "streams": [vars(stream) for stream in self.streams]}


def recorded_robots(info: RecordingInfo) -> list[RecordedRobot]:
    """The robots by name. Raises RecordingError if the chunk of a description is damaged."""
    by_name: dict[str, list[tuple[RecordedWriter, Channel]]] = {}
    for writer, channel in zip(recorded_writers(info.channels), info.channels, strict=True):
        if writer is not None and writer.robot:
            by_name.setdefault(writer.robot, []).append((writer, channel))
    robots: list[RecordedRobot] = []
    with RecordingReader(info.path) as reader:
        for name, written in sorted(by_name.items()):
            topics = {channel.topic for writer, channel in written if writer.stream == "robot_description"}
            model, fault = None, ""
            record = next(reader.records(topics), None) if topics else None
            if record is not None:
                try:
                    model = parse_urdf(decode_string(record.payload), f"the model of {name!r}")
                except (MessageError, ModelError) as error:
                    fault = str(error)
            streams: list[RecordedStream] = []
            for writer, channel in written:
                rate = None if is_latched(writer.stream) else mean_rate(channel, info.duration_s)
                names = ", ".join(filter(None, (writer.edge_writer, writer.program)))
                facts = (channel.topic, channel.type_name, channel.count, rate, names)
                rays = _ray_count(reader, channel.topic) if writer.stream == "scan" else None
                streams.append(RecordedStream(writer.stream, *facts, rays))
            robots.append(RecordedRobot(name, model, fault, tuple(streams)))
    return robots


def _ray_count(reader: RecordingReader, topic: str) -> int | None:
    """The rays of the first scan on a topic; None if it cannot be decoded."""
    from zstate.scans.messages import LaserScan  # noqa: PLC0415 - scans are a plugin

    names = FrameNames(Ros2Options(), SHARED)
    for record in reader.records({topic}):
        with suppress(MessageError):
            (message,) = RosDecoder().messages("scan", record.payload, 0, 0, names)
            assert isinstance(message, LaserScan)
            return len(from_float32_block(message.ranges))
        break
    return None


def other_channels(info: RecordingInfo) -> list[Channel]:
    """The channels of no robot: the clock and other topics."""
    writers = recorded_writers(info.channels)
    return [
        channel
        for writer, channel in zip(writers, info.channels, strict=True)
        if writer is None or not writer.robot
    ]


def mean_rate(channel: Channel, duration_s: float) -> float | None:
    """The messages of a channel a second, over the whole recording."""
    return (channel.count - 1) / duration_s if channel.count > 1 and duration_s > 0.0 else None
