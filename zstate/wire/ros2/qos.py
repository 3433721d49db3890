"""What a ROS 2 endpoint offers or asks of the network, in the three ways in which it is written.

The numbers are those of ``rmw/types.h``, but for DDS's own in zenoh-plugin-ros2dds. Deadline,
lifespan and liveliness are always written as their defaults and passed over when read: Zenoh has
nothing that would keep them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, TypeVar

from zstate.errors import InvalidInput, MessageError
from zstate.wire.keys import Stream, shortened

Reliability = Literal["reliable", "best_effort"]
Durability = Literal["volatile", "transient_local"]
History = Literal["keep_last", "keep_all"]

RMW_DEPTH = 42
"""The depth that rmw_zenoh_cpp takes where none is written."""

Word = TypeVar("Word", bound=str)

_RELIABILITY: dict[Reliability, int] = {"reliable": 1, "best_effort": 2}
_DURABILITY: dict[Durability, int] = {"transient_local": 1, "volatile": 2}
_HISTORY: dict[History, int] = {"keep_last": 1, "keep_all": 2}

_DDS_RELIABILITY: dict[Reliability, int] = {"best_effort": 0, "reliable": 1}
_DDS_DURABILITY: dict[Durability, int] = {"volatile": 0, "transient_local": 1}
_DDS_HISTORY: dict[History, int] = {"keep_last": 0, "keep_all": 1}

_DEPTH = re.compile(r"(-?[0-9]{1,10})?")
_FOREVER = "\n    sec: 9223372036\n    nsec: 854775807"  # RMW_DURATION_INFINITE


@dataclass(frozen=True)
class Qos:
    """Quality of service. ``depth`` counts the kept messages; 0 stands for all with "keep_all"."""

    reliability: Reliability = "reliable"
    durability: Durability = "volatile"
    history: History = "keep_last"
    depth: int = 10

    def __post_init__(self) -> None:
        if (self.depth > 0) != (self.history == "keep_last") or self.depth < 0:
            raise InvalidInput(
                f"a QoS with the history {self.history!r} and the depth {self.depth}; "
                "'keep_last' has a depth from 1 on, 'keep_all' has 0"
            )

    def encode_rmw(self) -> str:
        """The last chunk of an endpoint's token in rmw_zenoh_cpp: empty where it is the default.

        ``rel:dur:hist,depth:deadline:lifespan:liveliness``; ``::,10:,:,:,,`` is a plain publisher.
        """
        reliability = "" if self.reliability == "reliable" else _RELIABILITY[self.reliability]
        durability = "" if self.durability == "volatile" else _DURABILITY[self.durability]
        history = "" if self.history == "keep_last" else _HISTORY[self.history]
        depth = "" if self.depth in (0, RMW_DEPTH) else self.depth
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"

    @classmethod
    def parse_rmw(cls, text: str) -> Qos:
        """What ``encode_rmw`` wrote, or a ROS node. Raises MessageError ("malformed")."""
        parts = text.split(":")
        try:
            history, depth = parts[2].split(",")
            return cls(
                _word(_RELIABILITY, parts[0], "reliable"),
                _word(_DURABILITY, parts[1], "volatile"),
                *_kept(_word(_HISTORY, history, "keep_last"), depth, RMW_DEPTH),
            )
        except (LookupError, ValueError):
            raise _unreadable(text, "'::,10:,:,:,,'") from None

    def encode_dds(self) -> str:
        """The same in zenoh-plugin-ros2dds, without a type hash: ``:rel:dur:hist,depth``."""
        depth = self.depth or -1
        return (
            f":{_DDS_RELIABILITY[self.reliability]}:{_DDS_DURABILITY[self.durability]}"
            f":{_DDS_HISTORY[self.history]},{depth}"
        )

    @classmethod
    def parse_dds(cls, text: str) -> Qos:
        """What ``encode_dds`` wrote, or a bridge, whatever follows. Raises MessageError ("malformed")."""
        parts = text.split(":")
        try:
            history, depth = parts[3].split(",") if parts[3] else ("", "")
            return cls(
                _word(_DDS_RELIABILITY, parts[1], "reliable"),
                _word(_DDS_DURABILITY, parts[2], "volatile"),
                *_kept(_word(_DDS_HISTORY, history, "keep_last"), depth, 1),
            )
        except (LookupError, ValueError):
            raise _unreadable(text, "':1:0:0,10'") from None

    def to_rosbag_yaml(self) -> str:
        """The ``offered_qos_profiles`` of a recording: a YAML list of this one.

        With numbers for the policies, which every version of rosbag2 reads; names are for Jazzy on.
        """
        return (
            f"- history: {_HISTORY[self.history]}\n"
            f"  depth: {self.depth}\n"
            f"  reliability: {_RELIABILITY[self.reliability]}\n"
            f"  durability: {_DURABILITY[self.durability]}\n"
            f"  deadline:{_FOREVER}\n"
            f"  lifespan:{_FOREVER}\n"
            "  liveliness: 1\n"
            f"  liveliness_lease_duration:{_FOREVER}\n"
            "  avoid_ros_namespace_conventions: false"
        )


STREAM_QOS: dict[Stream, Qos] = {
    "joint_states": Qos(depth=10),
    "tf": Qos(depth=100),
    "tf_static": Qos(durability="transient_local", depth=1),
    "robot_description": Qos(durability="transient_local", depth=1),
    # Readers ask best effort (rclcpp's ClockQoS) or reliable (a plain subscription). DDS joins a
    # reliable writer to both, a best-effort writer to the former only. An old time is of no use.
    "clock": Qos(depth=1),
}
"""What the writer of each stream offers: as robot_state_publisher and tf2 do."""


def _word(numbers: dict[Word, int], text: str, default: Word) -> Word:
    if not text:
        return default
    return {str(number): word for word, number in numbers.items()}[text]


def _kept(history: History, depth: str, default: int) -> tuple[History, int]:
    if not _DEPTH.fullmatch(depth):
        raise ValueError(depth)
    return history, 0 if history == "keep_all" else int(depth or default)


def _unreadable(text: str, example: str) -> MessageError:
    return MessageError(f"a malformed QoS {shortened(text)!r}; written as {example}", reason="malformed")
