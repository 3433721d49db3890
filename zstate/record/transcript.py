"""Transcript: the records of a recording, as the messages that listeners know."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from hashlib import blake2b
from typing import NamedTuple

from zstate.errors import MessageError
from zstate.record.channel import ROBOT, Channel, Record
from zstate.record.reader import RecordReader
from zstate.wire.keys import Stream
from zstate.wire.messages import Message
from zstate.wire.ros2.frame_names import FrameNames
from zstate.wire.ros2.hearing import RosHearing
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import SHARED, robot_of_topic, type_of

STREAMS: tuple[Stream, ...] = ("robot_description", "tf_static", "joint_states", "tf", "clock")
"""What is understood of a recording."""

LATCHED: tuple[Stream, ...] = ("robot_description", "tf_static")
"""What holds until it is said anew."""

_SESSION, _PREFIX = "zstate.session", "zstate.frame_prefix"


@dataclass(frozen=True, slots=True)
class Speaker:
    """One writer of one stream, as one channel of a recording tells of it.

    ``robot`` is empty for the clock. ``static_writer`` is the name under which static edges were
    written, each time all of them; None in the bags of ROS, where those of several messages add up.
    ``program`` says who wrote, ``session`` which start of it. ``foreign`` channels tell nothing of
    writers: their robot is that of the topic's namespace, and all writers of a topic are one.
    """

    robot: str
    stream: Stream
    session: int
    static_writer: str | None
    program: str | None
    foreign: bool

    @classmethod
    def of(cls, channel: Channel) -> Speaker | None:
        """Who speaks on ``channel``; None when it carries nothing of a robot's state."""
        stream = _stream(channel)
        if stream is None:
            return None
        facts = channel.metadata
        foreign = _SESSION not in facts
        robot = robot_of_topic(channel.topic) if foreign else facts.get(ROBOT, "")
        return cls(
            robot="" if stream == "clock" else robot,
            stream=stream,
            session=_session_of(channel.topic) if foreign else int(facts[_SESSION]),
            static_writer=facts.get("zstate.writer"),
            program=facts.get("zstate.program"),
            foreign=foreign,
        )


class Said(NamedTuple):
    """One message, who said it, and when it was recorded [ns]."""

    speaker: Speaker
    message: Message
    log_time: int


class Transcript:
    """What was said in a recording, ours or a bag of ROS 2.

    Messages that cannot be understood are left out; ``refuse(reason, text)`` is told of each. Sequence
    numbers are the writers', or count the messages of a foreign channel.
    """

    def __init__(self, reader: RecordReader, refuse: Callable[[str, str], None]) -> None:
        self._reader = reader
        self._refuse = refuse
        self._known: dict[Channel, _Understood | None] = {}
        self._counts: Counter[Speaker] = Counter()
        self._topics: dict[str, set[Speaker]] = {}
        self.ignored: tuple[Channel, ...] = ()
        for channel in reader.channels():
            understood = self._understood(channel)
            if understood is None:
                self.ignored += (channel,)
            else:
                self._counts[understood.speaker] += channel.count
                self._topics.setdefault(channel.topic, set()).add(understood.speaker)

    @property
    def speakers(self) -> dict[Speaker, int]:
        """Everybody who says something, with the number of messages."""
        return {speaker: count for speaker, count in self._counts.items() if count}

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots that something is said of, by name; "ros" is what stands in no namespace of a bag."""
        return tuple(sorted({speaker.robot for speaker in self.speakers if speaker.robot}))

    def concerning(self, robots: Collection[str] | None) -> set[Speaker]:
        """Those who speak of ``robots`` (None: of any).

        The clock belongs to every robot, and so do the transforms that stand in no namespace of a bag.
        """
        return {speaker for speaker in self.speakers if robots is None or _concerns(speaker, robots)}

    @property
    def span(self) -> tuple[int, int] | None:
        """The first and the last log time [ns] of the whole recording; None when it is empty."""
        return self._reader.span

    def said(
        self,
        robots: Collection[str] | None = None,
        streams: Collection[Stream] = STREAMS,
        begin: int | None = None,
        end: int | None = None,
    ) -> Iterator[Said]:
        """What those ``concerning`` robots said on ``streams``, in the order of log times in [begin, end)."""
        wanted = {speaker for speaker in self.concerning(robots) if speaker.stream in streams}
        topics = {topic for topic, speakers in self._topics.items() if speakers & wanted}
        counts: Counter[Speaker] = Counter()
        # Without topics nothing is wanted, while None would mean all.
        for record in self._reader.records(topics, begin, end) if topics else ():
            understood = self._understood(record.channel)
            if understood is not None and understood.speaker in wanted:
                counts[understood.speaker] += 1
                yield from self._messages(record, understood, counts[understood.speaker])

    def _messages(self, record: Record, understood: _Understood, count: int) -> Iterator[Said]:
        speaker = understood.speaker
        seq = count if speaker.foreign else record.sequence
        try:
            messages = understood.hearing.messages(
                speaker.stream, record.payload, speaker.session, seq, understood.names
            )
        except MessageError as error:
            self._refuse(error.reason, f"{record.topic}: {error}")
            return
        for message in messages:
            yield Said(speaker, message, record.log_time)

    def _understood(self, channel: Channel) -> _Understood | None:
        if channel not in self._known:
            speaker = Speaker.of(channel)
            self._known[channel] = None if speaker is None else _Understood.of(speaker, channel)
        return self._known[channel]


class _Understood(NamedTuple):
    """A channel that is understood, and what its messages are read with."""

    speaker: Speaker
    names: FrameNames
    hearing: RosHearing

    @classmethod
    def of(cls, speaker: Speaker, channel: Channel) -> _Understood:
        options = Ros2Options(frame_prefix=channel.metadata.get(_PREFIX, ""))
        return cls(speaker, FrameNames(options, speaker.robot or SHARED), RosHearing())


def _stream(channel: Channel) -> Stream | None:
    name = channel.topic.rpartition("/")[2]
    for stream in STREAMS:
        if name == stream and channel.type_name == type_of(stream).name:
            return stream
    return None


def _concerns(speaker: Speaker, robots: Collection[str]) -> bool:
    is_shared = speaker.foreign and speaker.robot == SHARED and speaker.stream in ("tf", "tf_static")
    return speaker.stream == "clock" or is_shared or speaker.robot in robots


def _session_of(topic: str) -> int:
    return int.from_bytes(blake2b(topic.encode(), digest_size=4).digest(), "little")
