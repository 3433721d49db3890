"""Channels and their records: what every recording consists of, whatever its storage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

ROBOT = "zstate.robot"
"""The key of a channel's metadata under which a recorder names the robot it belongs to."""

CDR = "cdr"


@dataclass(frozen=True)
class Channel:
    """One topic as one writer offered it.

    ``type_name`` is ROS's ("sensor_msgs/msg/JointState"), empty where the file does not say it.
    ``count`` is how many records the recording holds of it.
    """

    topic: str
    type_name: str
    encoding: str
    metadata: Mapping[str, str] = field(hash=False)
    count: int


class Record(NamedTuple):
    """One message as it was recorded. Times are nanoseconds since the Unix epoch.

    ``log_time`` is when it was recorded, ``publish_time`` when it was sent (where the storage does not
    know: ``log_time``), ``sequence`` its writer's count modulo 2**32, or 0.
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


def joined(channels: Iterable[Channel]) -> tuple[Channel, ...]:
    """The channels of all files of a recording, each once, with their counts added."""
    found: dict[object, Channel] = {}
    for channel in channels:
        key = replace(channel, count=0), tuple(sorted(channel.metadata.items()))
        known = found.get(key)
        found[key] = channel if known is None else replace(channel, count=known.count + channel.count)
    return tuple(found.values())
