"""Pen: one channel of a recording, and what one writer said on it; and the pens of one robot."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Hashable

from zstate.record.split import ChannelId
from zstate.record.writer import RecordWriter
from zstate.wire.keys import Stream
from zstate.wire.messages import Clock, Message, Sample
from zstate.wire.ros2.encoder import RosStreamEncoder, TopicAddress
from zstate.wire.ros2.frame_names import FrameNames
from zstate.wire.sample_names import SampleNames

OPEN_CHANNELS = 1024
"""So many channels of a robot are open at once; the one unused for longest is released."""
BURST = 1000
CHANNELS_PER_S = 10.0
"""A robot opens this many channels a second of log time, after the first ``BURST``."""

_NOWHERE = TopicAddress("", "", None)
_NAMED = SampleNames()


class Pen:
    """Writes the messages of one writer on ``stream``. InvalidInput for what CDR has no place for."""

    def __init__(self, writer: RecordWriter, channel: ChannelId, stream: Stream, names: FrameNames) -> None:
        self._writer = writer
        self._channel = channel
        self._stream: Stream = stream
        self._names = names
        self._sample_names = _NAMED
        self._encoder = RosStreamEncoder(stream, _NOWHERE, names, _NAMED)

    def write(self, message: Sample | Clock, sample_names: SampleNames, log_time: int) -> None:
        """Write one sample; ``sample_names`` names its numbers."""
        payload = self._encode(message, sample_names)
        # MCAP begins in 1970; the payload keeps an earlier stamp.
        publish_time = max(message.stamp, 0)
        self._writer.write(self._channel, payload, log_time, publish_time, sequence=message.seq)

    def encode(self, message: Message) -> bytes:
        """The payload of a latched message, which takes long for a large one."""
        return self._encode(message, _NAMED)

    def latch(self, key: str, payload: bytes, log_time: int) -> None:
        """Write what holds until the next of this ``key``."""
        self._writer.latch(self._channel, key, payload, log_time, log_time)

    def unlatch(self, key: str) -> None:
        """Another channel says from now on what holds."""
        self._writer.unlatch(self._channel, key)

    def release(self) -> None:
        """Leave the channel out of the files that follow."""
        self._writer.release(self._channel)

    def _encode(self, message: Message, sample_names: SampleNames) -> bytes:
        if sample_names is not self._sample_names:
            self._sample_names = sample_names
            self._encoder = RosStreamEncoder(self._stream, _NOWHERE, self._names, sample_names)
        return self._encoder.encode(message)


class Pens:
    """The pens of one robot. Writers that come and go without end cannot take all channels of a recording.

    A session has channels of its own, as readers tell the starts of a writer apart by them. So a robot
    whose writers start again and again is given new channels at a bounded rate.
    """

    def __init__(self) -> None:
        self._pens: OrderedDict[Hashable, Pen] = OrderedDict()
        self._allowed = float(BURST)
        self._filled_at = 0

    def find(self, key: Hashable) -> Pen | None:
        """The pen of ``key``, if it is open."""
        pen = self._pens.get(key)
        if pen is not None:
            self._pens.move_to_end(key)
        return pen

    def open(self, key: Hashable, pen: Pen, kept: Collection[Pen]) -> None:
        """Add a pen; beyond ``OPEN_CHANNELS`` the one unused for longest that is not ``kept`` is released."""
        self._pens[key] = pen
        if len(self._pens) > OPEN_CHANNELS:
            unused = next(other for other, pen in self._pens.items() if pen not in kept)
            self._pens.pop(unused).release()

    def may_open(self, log_time: int) -> bool:
        """Whether another one may be opened now, which counts as opening it."""
        passed_s = max(0, log_time - self._filled_at) / 1e9
        self._filled_at = log_time
        self._allowed = min(float(BURST), self._allowed + passed_s * CHANNELS_PER_S)
        if self._allowed < 1.0:
            return False
        self._allowed -= 1.0
        return True
