"""Interface of one file of a recording (a rosbag2 storage), and what every storage consists of."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, TypeAlias

EDGE_WRITER = "zstate.writer"
"""Channel metadata key under which a recorder writes the name of the writer of its edges."""
ROBOT = "zstate.robot"
"""Channel metadata key under which a recorder writes the robot's name."""

STREAM = "zstate.stream"
"""Channel metadata key under which a recorder writes the stream of messages in JSON."""
VERSION = "zstate.version"
"""Channel metadata key of the version of that stream."""

CDR = "cdr"
JSON = "json"

Format: TypeAlias = Literal["mcap", "sqlite3"]
"""rosbag2's storage identifiers."""


class ChannelType(Protocol):
    """The type of the messages of a channel: a RosType, or a JsonType.

    ``encoding`` is that of the messages, and ``schema_encoding`` that of ``definition``, as MCAP names them;
    ``hash`` is empty for a type that ROS does not have.
    """

    @property
    def name(self) -> str: ...
    @property
    def definition(self) -> str: ...
    @property
    def encoding(self) -> str: ...
    @property
    def schema_encoding(self) -> str: ...
    @property
    def hash(self) -> str: ...


@dataclass(frozen=True)
class Channel:
    """One topic as one writer offered it.

    ``type_name`` is the ROS type ("sensor_msgs/msg/JointState"), or the class of messages in JSON, empty if
    the file does not state it.
    ``count`` is the number of records in the recording.
    """

    topic: str
    type_name: str
    encoding: str
    metadata: Mapping[str, str] = field(hash=False)
    count: int

    @property
    def is_readable(self) -> bool:
        """Whether its records are read: CDR, and JSON of a recorder that names the stream."""
        return self.encoding == CDR or (self.encoding == JSON and STREAM in self.metadata)


class Record(NamedTuple):
    """One recorded message. Times are nanoseconds since the Unix epoch.

    ``log_time`` is when it was recorded, ``publish_time`` when it was sent (``log_time`` if the storage does
    not know it), ``sequence`` its writer's count modulo 2**32, or 0.
    """

    channel: Channel
    payload: bytes
    log_time: int
    publish_time: int
    sequence: int

    @property
    def topic(self) -> str:
        return self.channel.topic

    @property
    def type_name(self) -> str:
        return self.channel.type_name

    @property
    def metadata(self) -> Mapping[str, str]:
        return self.channel.metadata


class ReadFilter(NamedTuple):
    """Selects records of these topics (None: all) with log times in [begin, end).

    With ``heads_only`` the payload of a message that has a chunk of its own may be its beginning only.
    """

    topics: frozenset[str] | None
    begin: int
    end: int
    heads_only: bool = False

    def accepts(self, channel: Channel) -> bool:
        """Whether records of ``channel`` are read at all."""
        return channel.is_readable and (self.topics is None or channel.topic in self.topics)


class SortedPart(NamedTuple):
    """Records in the order of their log times, none of them before ``start``."""

    start: int
    records: Callable[[], Iterator[Record]]


class Storage(Protocol):
    """One file of a recording. Its methods raise RecordingError and nothing else.

    ``channels`` are all of its channels, with any encoding; ``span`` its first and last log time; ``profile``
    and ``library`` the writer's own description. ``complete`` is True if the writer closed the file and
    nothing is lost; ``losses`` describes what is. ``missing`` are the messages that a recorder of zstate did
    not get, by "robot/stream".
    """

    path: Path
    format: Format
    size: int
    profile: str
    library: str
    channels: tuple[Channel, ...]
    span: tuple[int, int] | None
    compressions: tuple[str, ...]
    complete: bool
    losses: tuple[str, ...]
    missing: Mapping[str, int]

    def parts(self, read_filter: ReadFilter) -> Sequence[SortedPart]:
        """The selected records of readable channels."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


def merge_channels(channels: Iterable[Channel]) -> tuple[Channel, ...]:
    """The channels of all files of a recording without duplicates, their counts added."""
    found: dict[object, Channel] = {}
    for channel in channels:
        key = replace(channel, count=0), tuple(sorted(channel.metadata.items()))
        known = found.get(key)
        found[key] = channel if known is None else replace(channel, count=known.count + channel.count)
    return tuple(found.values())


def merge_by_log_time(parts: Sequence[SortedPart]) -> Iterator[Record]:
    """All records by log time; records of one instant in the order of the parts.

    A part is opened when the stream reaches its start, so a long recording is never in memory as a whole.
    """
    # Start or next log time, whether the part is open, its number, its next record, and the rest.
    heads: list[tuple[int, bool, int, Record | None, Iterator[Record]]] = [
        (part.start, False, number, None, iter(())) for number, part in enumerate(parts)
    ]
    heapq.heapify(heads)
    while heads:
        _, _, number, record, records = heads[0]
        if record is None:
            records = parts[number].records()
        else:
            yield record
        if (following := next(records, None)) is None:
            heapq.heappop(heads)
        else:
            heapq.heapreplace(heads, (following.log_time, True, number, following, records))
