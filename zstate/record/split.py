"""A split: one file of a recording while it is written, which stands for itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple, NewType, TypeAlias

from zstate.record.channel import CDR
from zstate.record.output import Output
from zstate.record.splits import IDENTITY
from zstate.wire.ros2.types import RosType

GROUP_NS = 10_000_000_000
"""So often the latched messages are written again [ns]."""

_MESSAGE_SIZE = 31  # of a message's record, beside its payload
_SEQUENCE = (1 << 32) - 1

ChannelId = NewType("ChannelId", int)
"""A channel of a whole recording, whatever its number in each file."""
ChannelKey: TypeAlias = tuple[str, str, frozenset[tuple[str, str]]]


class Declared(NamedTuple):
    """A channel as every file of the recording declares it."""

    topic: str
    type: RosType
    metadata: Mapping[str, str]


def channel_key(channel: Declared) -> ChannelKey:
    """What is the same for equal channels, and hashable."""
    return channel.topic, channel.type.hash, frozenset(channel.metadata.items())


class Message(NamedTuple):
    """One message of a declared channel."""

    channel: ChannelId
    payload: bytes
    log_time: int
    publish_time: int
    sequence: int


class Split:
    """Declared channels, and groups of chunks each of which begins with the latched messages."""

    def __init__(self, path: Path, *, overwrite: bool, recording: str, part: int) -> None:
        self._output = Output(path, overwrite=overwrite)
        self._output.writer.add_metadata(IDENTITY, {"id": recording, "part": str(part)})
        self._output.flush()
        self._schemas: dict[str, int] = {}
        self._numbers: dict[ChannelKey, int] = {}
        self._number_of: dict[ChannelId, int] = {}
        self._waiting = 0
        self._opening = 0
        self._first: int | None = None
        self._group = 0

    @property
    def path(self) -> Path:
        return self._output.path

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._output.size

    @property
    def channel_count(self) -> int:
        """The channels in the file."""
        return len(self._numbers)

    def declare(self, channel: ChannelId, declared: Declared) -> None:
        """Add a channel, unless the file has an equal one."""
        key = channel_key(declared)
        if key not in self._numbers:
            self._numbers[key] = self._register(declared)
        self._number_of[channel] = self._numbers[key]

    def _register(self, declared: Declared) -> int:
        topic, kind, metadata = declared
        writer = self._output.writer
        if kind.name not in self._schemas:
            text = kind.definition.encode()
            self._schemas[kind.name] = writer.register_schema(kind.name, "ros2msg", text)
        return writer.register_channel(topic, CDR, self._schemas[kind.name], dict(metadata))

    def is_over(self, log_time: int, max_bytes: float, max_ns: float) -> bool:
        """Whether the message of that log time belongs into the next file."""
        if self._first is None:
            return False
        grown = self.size + self._waiting - self._opening
        return grown >= max_bytes or abs(log_time - self._first) >= max_ns

    def group_is_over(self, log_time: int) -> bool:
        """Whether a message of that log time begins a group."""
        return self._first is None or abs(log_time - self._group) >= GROUP_NS

    def begin_group(self, log_time: int, latched: Iterable[Message]) -> None:
        """Begin a chunk, with the latched messages under this log time."""
        self.flush()
        self._group = log_time
        for message in latched:
            self.add(message._replace(log_time=log_time))
        if self._first is None:
            self._first = log_time
            self._opening = self.size + self._waiting

    def add(self, message: Message) -> None:
        """Write it: into memory, until the chunk is full."""
        channel, payload, log_time, publish_time, sequence = message
        number = self._number_of[channel]
        self._output.writer.add_message(number, log_time, payload, publish_time, sequence & _SEQUENCE)
        self._waiting += len(payload) + _MESSAGE_SIZE
        if self._output.has_waiting:
            self.flush()

    def flush(self) -> None:
        """End the chunk, and give it to the system."""
        self._output.flush()
        self._waiting = 0

    def finish(self) -> None:
        """Write the index, and close."""
        self._output.finish()
