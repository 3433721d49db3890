"""Pen: one channel of a recording, and what one writer said on it."""

from __future__ import annotations

from zstate.record.writer import ChannelId, RecordWriter
from zstate.wire.keys import Stream
from zstate.wire.messages import Clock, Message, Sample
from zstate.wire.ros2.frame_names import FrameNames
from zstate.wire.ros2.outlet import Address, RosOutlet
from zstate.wire.sample_names import SampleNames

_NOWHERE = Address("", "", None)
_NAMED = SampleNames()


class Pen:
    """Writes the messages of one writer on ``stream``. InvalidInput for what CDR has no place for."""

    def __init__(self, writer: RecordWriter, channel: ChannelId, stream: Stream, names: FrameNames) -> None:
        self._writer = writer
        self._channel = channel
        self._stream: Stream = stream
        self._names = names
        self._sample_names = _NAMED
        self._outlet = RosOutlet(stream, _NOWHERE, names, _NAMED)

    def write(self, message: Sample | Clock, sample_names: SampleNames, log_time: int) -> None:
        """Write one sample; ``sample_names`` names its numbers."""
        payload = self._encode(message, sample_names)
        # MCAP begins in 1970; the payload keeps an earlier stamp.
        publish_time = max(message.stamp, 0)
        self._writer.write(self._channel, payload, log_time, publish_time, sequence=message.seq)

    def latch(self, key: str, message: Message, log_time: int) -> None:
        """Write what holds until the next of this ``key``."""
        self._writer.latch(self._channel, key, self._encode(message, _NAMED), log_time, log_time)

    def unlatch(self, key: str) -> None:
        """Another channel says from now on what holds."""
        self._writer.unlatch(self._channel, key)

    def _encode(self, message: Message, sample_names: SampleNames) -> bytes:
        if sample_names is not self._sample_names:
            self._sample_names = sample_names
            self._outlet = RosOutlet(self._stream, _NOWHERE, self._names, sample_names)
        return self._outlet.encode(message)
