"""RecordWriter: a recording as MCAP files, each of which a cut leaves readable."""

from __future__ import annotations

import math
import os
import uuid
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path

from zstate.closing import Closing
from zstate.errors import InvalidInput, RecordingError
from zstate.locks import new_lock
from zstate.record.split import ChannelId, ChannelKey, Declared, Message, Split, channel_key
from zstate.record.splits import later_splits, split_path
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.types import RosType

LEAST_BYTES = 1 << 16
LEAST_SECONDS = 1.0
MOST_CHANNELS = 60_000
"""Of a file; MCAP numbers channels in 16 bits."""

_END_OF_TIME = 1 << 63


class RecordWriter(Closing):
    """Writes CDR messages into ``path``, and into path_1, path_2 ... when it splits. Any thread may write.

    A file ends once it has grown by ``max_bytes`` (the chunk in progress counted without compression,
    the index at its end not counted), its log times span ``max_seconds`` or it has 60,000 channels; the
    next begins with all channels that were not released, and the latched values. These are also repeated
    every 10 s of log time, at the start of a chunk, so that whatever part of a recording remains can be
    understood.

    What was written is safe from ``kill -9`` after ``flush()``, to be called every half a second.
    RecordingError when the file exists (unless ``overwrite``), cannot be made, or cannot grow; what was
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
        if max_bytes is not None and max_bytes < LEAST_BYTES:
            raise InvalidInput(f"max_bytes is {max_bytes}; give {LEAST_BYTES} or more")
        if max_seconds is not None and not LEAST_SECONDS <= max_seconds < math.inf:
            raise InvalidInput(f"max_seconds is {max_seconds:g}; give {LEAST_SECONDS:g} or more")
        self._first = Path(path)
        self._max_bytes = math.inf if max_bytes is None else max_bytes
        self._max_ns = math.inf if max_seconds is None else max_seconds * 1e9
        self._overwrite = overwrite
        if not overwrite and (max_bytes or max_seconds):
            self._refuse_later_splits()
        self._lock = new_lock()
        self._recording = uuid.uuid4().hex
        self._declared: dict[ChannelId, Declared] = {}
        self._ids: dict[ChannelKey, ChannelId] = {}
        self._id = 0
        self._latched: dict[tuple[ChannelId, str], Message] = {}
        self._files: list[Path] = []
        self._finished_bytes = 0
        self._is_open = True
        self._split = self._new_split()

    def _refuse_later_splits(self) -> None:
        for _, file in later_splits(self._first) if self._first.parent.is_dir() else ():
            text = f"{str(file)!r} exists, and this recording may need the name; move it, or choose another"
            raise RecordingError(f"{text} (or overwrite=True)", path=str(file))

    @property
    def files(self) -> tuple[Path, ...]:
        """The files written so far, the current one last."""
        return tuple(self._files)

    @property
    def size(self) -> int:
        """The bytes in all files so far; what is not flushed is not counted."""
        return self._finished_bytes + self._split.size

    def channel(
        self, topic: str, type: RosType, qos: Qos, metadata: Mapping[str, str] | None = None
    ) -> ChannelId:
        """Declare a channel; the same one again gives the same answer."""
        known = {"offered_qos_profiles": qos.to_rosbag_yaml(), "topic_type_hash": type.hash}
        declared = Declared(topic, type, {**known, **(metadata or {})})
        key = channel_key(declared)
        with self._lock, self._ending_on_failure():
            self._check_open()
            known = self._ids.get(key)
            if known is not None:
                return known
            if self._split.channel_count >= MOST_CHANNELS:
                self._begin_split()
            self._id += 1
            channel = self._ids[key] = ChannelId(self._id)
            self._declared[channel] = declared
            self._split.declare(channel, declared)
            return channel

    def release(self, channel: ChannelId) -> None:
        """Declare a channel that nothing is latched on no longer in the files that follow."""
        with self._lock:
            declared = self._declared.pop(channel, None)
            if declared is not None:
                del self._ids[channel_key(declared)]

    def write(
        self, channel: ChannelId, payload: bytes, log_time: int, publish_time: int, *, sequence: int = 0
    ) -> None:
        """Write a message. Log times [ns] need not increase; of ``sequence`` 32 bits are kept."""
        message = self._checked(Message(channel, payload, log_time, publish_time, sequence))
        with self._lock, self._ending_on_failure():
            self._make_room(log_time)
            self._split.add(message)

    def latch(
        self,
        channel: ChannelId,
        key: str,
        payload: bytes,
        log_time: int,
        publish_time: int,
        *,
        sequence: int = 0,
    ) -> None:
        """Write a message that holds until the next of this ``key``: it is repeated, in the next file too.

        A repetition carries the log time of the message it precedes, and its own publish time.
        """
        message = self._checked(Message(channel, bytes(payload), log_time, publish_time, sequence))
        with self._lock, self._ending_on_failure():
            self._latched[channel, key] = message
            if not self._make_room(log_time):
                self._split.add(message)

    def unlatch(self, channel: ChannelId, key: str) -> None:
        """Repeat it no longer."""
        with self._lock:
            self._latched.pop((channel, key), None)

    def flush(self) -> None:
        """Give everything to the operating system, in a chunk of its own."""
        with self._lock, self._ending_on_failure():
            if self._is_open:
                self._split.flush()

    def close(self) -> None:
        with self._lock:
            if self._is_open:
                self._is_open = False
                self._split.finish()

    def _make_room(self, log_time: int) -> bool:
        """Begin the file or the group that this log time belongs into; say whether there was one to begin."""
        self._check_open()
        if self._split.is_over(log_time, self._max_bytes, self._max_ns):
            self._begin_split()
        if not self._split.group_is_over(log_time):
            return False
        self._split.begin_group(log_time, self._latched.values())
        return True

    def _begin_split(self) -> None:
        self._split.finish()
        self._finished_bytes += self._split.size
        self._split = self._new_split()

    def _new_split(self) -> Split:
        part = len(self._files)
        path = split_path(self._first, part)
        split = Split(path, overwrite=self._overwrite, recording=self._recording, part=part)
        self._files.append(path)
        for channel, declared in self._declared.items():
            split.declare(channel, declared)
        return split

    @contextmanager
    def _ending_on_failure(self) -> Generator[None, None, None]:
        """After an error of the disk there is nothing left to write to."""
        try:
            yield
        except RecordingError:
            self._is_open = False
            raise

    def _checked(self, message: Message) -> Message:
        # MCAP's writer would notice half way through a record, or not at all.
        if message.channel not in self._declared:
            text = f"{message.channel} is no channel of {str(self._first)!r}; declare it with channel()"
            raise InvalidInput(text)
        for time in (message.log_time, message.publish_time):
            if not 0 <= time < _END_OF_TIME:
                raise InvalidInput(f"a time is {time}; give nanoseconds since 1970, below 2**63")
        return message

    def _check_open(self) -> None:
        if not self._is_open:
            raise RecordingError(f"the recording {str(self._first)!r} is closed", path=str(self._first))
