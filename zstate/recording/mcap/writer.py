"""MCAP writer that splits, and repeats latched messages so that any part of a recording is readable."""

from __future__ import annotations

import errno
import fcntl
import io
import math
import os
import uuid
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple, NewType, TypeAlias

from mcap.writer import CompressionType, Writer

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import InvalidInput
from zstate.recording.errors import RecordingError
from zstate.recording.mcap.file import IDENTITY, MISSING, later_splits, split_path
from zstate.recording.storage import ChannelType
from zstate.wire.ros2.qos import Qos

LIBRARY = f"zstate {version('zstate')}"

MIN_BYTES = 1 << 16
MIN_SECONDS = 1.0
MAX_CHANNELS = 60_000
"""The most channels of one file; MCAP numbers them in 16 bits."""

GROUP_NS = 10_000_000_000
"""Interval at which latched messages are repeated [ns of log time]."""

_CHUNK_BYTES = 1 << 20
_MESSAGE_SIZE = 31  # of a message's record, without its payload
_SEQUENCE = (1 << 32) - 1
_END_OF_TIME = 1 << 63
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}

ChannelId = NewType("ChannelId", int)
"""A channel of a whole recording; its MCAP id may differ between files."""
ChannelKey: TypeAlias = tuple[str, str, str, frozenset[tuple[str, str]]]


class ChannelDeclaration(NamedTuple):
    """A channel as every file of the recording declares it."""

    topic: str
    type: ChannelType
    metadata: Mapping[str, str]

    @property
    def key(self) -> ChannelKey:
        """Hashable, and the same for equal channels."""
        return self.topic, self.type.name, self.type.definition, frozenset(self.metadata.items())


class RecordedMessage(NamedTuple):
    """One message of a declared channel."""

    channel: ChannelId
    payload: bytes
    log_time: int
    publish_time: int
    sequence: int


class RepeatedMessage(NamedTuple):
    """A message in effect until the next, and whether each file has it only once."""

    message: RecordedMessage
    once_per_file: bool


class _ChunkBuffer(io.BytesIO):
    """Output stream of MCAP's writer, written to the file in one go: whole chunks, or nothing of them.

    The writer calls ``tell`` for the offsets in its index, and ``flush`` at the end of its own.
    """

    def __init__(self, file: io.FileIO) -> None:
        super().__init__()
        self._file = file
        self.file_size = 0

    def tell(self) -> int:
        return self.file_size + super().tell()

    def flush(self) -> None:
        data = self.getvalue()
        try:
            written = 0
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError:
            with suppress(OSError):
                self._file.truncate(self.file_size)
            raise
        self.file_size += len(data)
        self.seek(0)
        self.truncate()


class McapOutput:
    """An MCAP file being written. After a failure it is closed, and ends with a whole chunk.

    ``writer`` is MCAP's own; its output is in memory until ``write_chunk``. Its public ``flush`` (since mcap
    1.5) ends the chunk in progress, which its ``chunk_size`` does also.
    """

    def __init__(self, path: Path, *, overwrite: bool, profile: str = "ros2", library: str = LIBRARY) -> None:
        self._path = path
        try:
            self._file = io.FileIO(path, "w" if overwrite else "x")
        except OSError as error:
            raise _disk_error(path, error) from error
        # Marks the file as being written, for other processes; not all file systems have locks.
        with suppress(OSError):
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._buffer = _ChunkBuffer(self._file)
        self.writer = Writer(self._buffer, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self.writer.start(profile, library)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._buffer.file_size

    @property
    def has_whole_chunk(self) -> bool:
        """Whether a whole chunk is in memory."""
        return self._buffer.tell() > self._buffer.file_size

    def write_chunk(self) -> None:
        """End the chunk in progress and write it to the system, where ``kill -9`` cannot lose it."""
        with self._close_on_failure():
            self.writer.flush()

    def finish(self) -> None:
        """Write the index, and close the file."""
        with self._close_on_failure():
            self.writer.finish()
            self._buffer.flush()
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        with suppress(OSError):
            self._file.close()

    @contextmanager
    def _close_on_failure(self) -> Generator[None, None, None]:
        try:
            yield
        except OSError as error:
            self.abandon()
            raise _disk_error(self._path, error) from error


def _disk_error(path: Path, error: OSError) -> RecordingError:
    text = f"{str(path)!r} cannot be written: {error.strerror}"
    if isinstance(error, FileExistsError):
        text = f"{str(path)!r} exists; choose another name, or pass overwrite=True"
    elif error.errno in _FULL:
        text = (
            f"{str(path)!r} cannot grow: {error.strerror}; free some space. What was written before "
            "stays readable, and `zstate recover` makes a complete file of it"
        )
    elif error.errno == errno.ENOENT:
        text = f"{str(path)!r} cannot be written: there is no folder {str(path.parent)!r}"
    return RecordingError(text, path=str(path))


class SplitFile:
    """One file of a recording: its channels, and groups of chunks that begin with the latched messages."""

    def __init__(self, path: Path, *, overwrite: bool, recording: str, part: int) -> None:
        self.output = McapOutput(path, overwrite=overwrite)
        self.output.writer.add_metadata(IDENTITY, {"id": recording, "part": str(part)})
        try:
            self.output.write_chunk()
        except RecordingError:
            if not overwrite:  # on a full disk, repeated starts must not leave many empty files
                path.unlink()
            raise
        self._schemas: dict[tuple[str, str], int] = {}
        self._numbers: dict[ChannelKey, int] = {}
        self._number_of: dict[ChannelId, int] = {}
        # Bytes of the chunk in progress, without compression, and of all that precedes the first message.
        self._chunk_size = self._head_size = 0
        self.in_chunk = 0
        """The messages of the chunk in progress, without repeated ones: a full disk loses them."""
        self._first: int | None = None
        self._group = 0

    @property
    def is_empty(self) -> bool:
        """Whether the file has no messages."""
        return self._first is None

    @property
    def is_full(self) -> bool:
        """Whether the file has all the channels that MCAP can number."""
        return len(self._numbers) >= MAX_CHANNELS

    def declare(self, channel: ChannelId, declaration: ChannelDeclaration) -> None:
        """Add a channel, unless the file has an equal one."""
        key = declaration.key
        if key not in self._numbers:
            topic, kind, metadata = declaration
            writer = self.output.writer
            schema = kind.name, kind.definition
            if schema not in self._schemas:
                text = kind.definition.encode()
                self._schemas[schema] = writer.register_schema(kind.name, kind.schema_encoding, text)
            self._numbers[key] = writer.register_channel(
                topic, kind.encoding, self._schemas[schema], dict(metadata)
            )
        self._number_of[channel] = self._numbers[key]

    def is_over(self, log_time: int, max_bytes: float, max_ns: float) -> bool:
        """Whether a message of that log time belongs into the next file."""
        if self._first is None:
            return False
        grown = self.output.size + self._chunk_size - self._head_size
        return grown >= max_bytes or abs(log_time - self._first) >= max_ns

    def start_group_if_due(self, log_time: int, latched: Iterable[RepeatedMessage]) -> bool:
        """Start a chunk with the latched messages, under this log time; False while the last group lasts.

        The first group has all of them, the others those that are repeated in a file.
        """
        if self._first is not None and abs(log_time - self._group) < GROUP_NS:
            return False
        self.write_chunk()
        self._group = log_time
        for message, once_per_file in latched:
            if self._first is None or not once_per_file:
                self.add(message._replace(log_time=log_time), is_repeated=True)
        if self._first is None:
            self._first = log_time
            self._head_size = self.output.size + self._chunk_size
        return True

    def add(self, message: RecordedMessage, *, is_repeated: bool = False) -> None:
        """Write it: into memory, until the chunk is full.

        One that fills a chunk, as a cloud does, has one of its own: readers of other streams skip it.
        """
        channel, payload, log_time, publish_time, sequence = message
        if len(payload) >= _CHUNK_BYTES:
            self.write_chunk()
        number = self._number_of[channel]
        self.output.writer.add_message(number, log_time, payload, publish_time, sequence & _SEQUENCE)
        self._chunk_size += len(payload) + _MESSAGE_SIZE
        if self.output.has_whole_chunk:
            self.write_chunk()
        else:
            self.in_chunk += not is_repeated

    def write_chunk(self) -> None:
        """End the chunk, and write it to the system."""
        self.output.write_chunk()
        self._chunk_size = self.in_chunk = 0


class RecordingWriter(Closeable):
    """Writes messages into ``path``, and into path_1, path_2 ... when it splits. Any thread may write.

    A file ends once it has grown by ``max_bytes`` (the chunk in progress counted without compression, the
    index at its end not counted), its log times span ``max_seconds`` or it has 60,000 channels. The next file
    starts with all channels that were not released, and the latched values. These are also repeated every
    10 s of log time, at the start of a chunk, so that any remaining part of a recording is readable; except
    those ``once_per_file``, which are missing until the next file if their one chunk is damaged.

    ``flush()``, to be called every half a second, makes written messages safe from ``kill -9``. Raises
    RecordingError if the file exists (unless ``overwrite``), cannot be created, or cannot grow; what was
    written stays readable, and the recording is then closed.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        max_bytes: int | None = None,
        max_seconds: float | None = None,
        overwrite: bool = False,
    ) -> None:
        if max_bytes is not None and max_bytes < MIN_BYTES:
            raise InvalidInput(f"max_bytes is {max_bytes}; give {MIN_BYTES} or more")
        if max_seconds is not None and not MIN_SECONDS <= max_seconds < math.inf:
            raise InvalidInput(f"max_seconds is {max_seconds:g}; give {MIN_SECONDS:g} or more")
        self._first = Path(path)
        self._max_bytes = math.inf if max_bytes is None else max_bytes
        self._max_ns = math.inf if max_seconds is None else max_seconds * 1e9
        self._overwrite = overwrite
        if not overwrite and (max_bytes or max_seconds) and self._first.parent.is_dir():
            for _, file in later_splits(self._first):
                text = (
                    f"{str(file)!r} exists, and this recording may need the name; move it, or choose another"
                )
                raise RecordingError(f"{text} (or overwrite=True)", path=str(file))
        self._lock = fork_safe_lock()
        self._recording = uuid.uuid4().hex
        self._declared: dict[ChannelId, ChannelDeclaration] = {}
        self._ids: dict[ChannelKey, ChannelId] = {}
        self._id = 0
        self._latched: dict[tuple[ChannelId, str], RepeatedMessage] = {}
        self._files: list[Path] = []
        self._finished_bytes = 0
        self._is_open = True
        self._has_failed = False
        self.lost = 0
        """The messages that were written into memory, and not into the file, when the disk was full."""
        self._split = self._new_split()

    @property
    def files(self) -> tuple[Path, ...]:
        """The files written so far, the current one last."""
        return tuple(self._files)

    @property
    def size(self) -> int:
        """Bytes in all files so far, without unflushed ones."""
        return self._finished_bytes + self._split.output.size

    def channel(
        self, topic: str, type: ChannelType, qos: Qos, metadata: Mapping[str, str] | None = None
    ) -> ChannelId:
        """Declare a channel; an equal declaration returns the same id. Only ROS has ``qos``."""
        facts: dict[str, str] = {}
        if type.hash:
            facts = {"offered_qos_profiles": qos.to_rosbag_yaml(), "topic_type_hash": type.hash}
        declaration = ChannelDeclaration(topic, type, {**facts, **(metadata or {})})
        key = declaration.key
        with self._writing():
            self._check_open()
            known = self._ids.get(key)
            if known is not None:
                return known
            if self._split.is_full:
                self._start_split()
            self._id += 1
            channel = self._ids[key] = ChannelId(self._id)
            self._declared[channel] = declaration
            self._split.declare(channel, declaration)
            return channel

    def release(self, channel: ChannelId) -> None:
        """Leave a channel without latched messages out of the files that follow."""
        with self._lock:
            declaration = self._declared.pop(channel, None)
            if declaration is not None:
                del self._ids[declaration.key]

    def is_read(self, channel: ChannelId) -> bool:
        """True: a recording has all messages."""
        return True

    def write(
        self, channel: ChannelId, payload: bytes, log_time: int, publish_time: int, *, sequence: int = 0
    ) -> None:
        """Write a message. Log times [ns] need not increase; ``sequence`` is cut to 32 bits."""
        self._write(RecordedMessage(channel, payload, log_time, publish_time, sequence))

    def latch(
        self,
        channel: ChannelId,
        key: str,
        payload: bytes,
        log_time: int,
        publish_time: int,
        *,
        once_per_file: bool = False,
    ) -> bool:
        """Write a message that is repeated, in the following files too, until the next of this ``key``.

        A repetition carries the log time of the message it precedes, and its own publish time. With
        ``once_per_file`` only other files repeat it, and the same payload is not written again: False.
        """
        message = RecordedMessage(channel, bytes(payload), log_time, publish_time, 0)
        before = self._latched.get((channel, key))
        if once_per_file and before is not None and before.message.payload == message.payload:
            return False
        self._write(message, key, once_per_file=once_per_file)
        return True

    def _write(
        self, message: RecordedMessage, latched_as: str | None = None, *, once_per_file: bool = False
    ) -> None:
        # MCAP's writer would notice half way through a record, or not at all.
        if message.channel not in self._declared:
            text = f"{message.channel} is no channel of {str(self._first)!r}; declare it with channel()"
            raise InvalidInput(text)
        for time in (message.log_time, message.publish_time):
            if not 0 <= time < _END_OF_TIME:
                raise InvalidInput(f"a time is {time}; give nanoseconds since 1970, below 2**63")
        with self._writing():
            self._check_open()
            if latched_as is not None:
                self._latched[message.channel, latched_as] = RepeatedMessage(message, once_per_file)
            if self._split.is_over(message.log_time, self._max_bytes, self._max_ns):
                self._start_split()
            is_first = self._split.is_empty
            is_repeated = self._split.start_group_if_due(message.log_time, self._latched.values())
            if latched_as is None or not is_repeated or (once_per_file and not is_first):
                self._split.add(message)
            else:
                self._split.in_chunk += 1  # with the repeated ones

    def unlatch(self, channel: ChannelId, key: str) -> None:
        """Stop repeating it."""
        with self._lock:
            self._latched.pop((channel, key), None)

    def flush(self) -> None:
        """Write everything to the operating system, in a chunk of its own."""
        with self._writing():
            if self._is_open:
                self._split.write_chunk()

    def state_missing(self, counts: Mapping[str, int]) -> None:
        """Write how many messages the recorder did not get, by "robot/stream"; once, before it closes."""
        with self._writing():
            self._check_open()
            facts = {name: str(count) for name, count in counts.items()}
            self._split.output.writer.add_metadata(MISSING, facts)

    def close(self) -> None:
        with self._writing():
            if self._is_open:
                self._is_open = False
                self._split.output.finish()

    def _start_split(self) -> None:
        self._split.output.finish()
        self._finished_bytes += self._split.output.size
        self._split = self._new_split()

    def _new_split(self) -> SplitFile:
        part = len(self._files)
        path = split_path(self._first, part)
        split = SplitFile(path, overwrite=self._overwrite, recording=self._recording, part=part)
        self._files.append(path)
        for channel, declaration in self._declared.items():
            split.declare(channel, declaration)
        return split

    @contextmanager
    def _writing(self) -> Generator[None, None, None]:
        """Hold the lock; a disk error closes the recording."""
        with self._lock:
            try:
                yield
            except RecordingError:
                if not self._has_failed:
                    self._has_failed, self.lost = True, self._split.in_chunk
                self._is_open = False
                raise

    def _check_open(self) -> None:
        if not self._is_open:
            raise RecordingError(f"the recording {str(self._first)!r} is closed", path=str(self._first))
