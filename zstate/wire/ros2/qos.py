"""QoS profile of a ROS 2 endpoint and its three encodings: rmw_zenoh_cpp, zenoh-plugin-ros2dds, rosbag2.

The numbers are those of ``rmw/types.h``, except in zenoh-plugin-ros2dds, which uses those of DDS. Deadline,
lifespan and liveliness are always written as their defaults and ignored when read: Zenoh does not
enforce them.
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
"""Default depth of rmw_zenoh_cpp."""

Policy = TypeVar("Policy", bound=str)

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
    """Quality of service. ``depth`` is the number of kept messages; 0 with "keep_all"."""

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
        """The last chunk of an endpoint's token in rmw_zenoh_cpp: defaults are empty.

        ``rel:dur:hist,depth:deadline:lifespan:liveliness``; ``::,10:,:,:,,`` is a plain publisher.
        """
        reliability = "" if self.reliability == "reliable" else _RELIABILITY[self.reliability]
        durability = "" if self.durability == "volatile" else _DURABILITY[self.durability]
        history = "" if self.history == "keep_last" else _HISTORY[self.history]
        depth = "" if self.depth in (0, RMW_DEPTH) else self.depth
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"

    @classmethod
    def parse_rmw(cls, text: str) -> Qos:
        """The QoS that ``encode_rmw`` or a ROS node wrote. Raises MessageError ("malformed")."""
        parts = text.split(":")
        try:
            history, depth = parts[2].split(",")
            return cls(
                _parse_policy(_RELIABILITY, parts[0], "reliable"),
                _parse_policy(_DURABILITY, parts[1], "volatile"),
                *_parse_history(_parse_policy(_HISTORY, history, "keep_last"), depth, RMW_DEPTH),
            )
        except (LookupError, ValueError):
            raise _malformed_error(text, "'::,10:,:,:,,'") from None

    def encode_dds(self) -> str:
        """The same in zenoh-plugin-ros2dds, without a type hash: ``:rel:dur:hist,depth``."""
        depth = self.depth or -1
        return (
            f":{_DDS_RELIABILITY[self.reliability]}:{_DDS_DURABILITY[self.durability]}"
            f":{_DDS_HISTORY[self.history]},{depth}"
        )

    @classmethod
    def parse_dds(cls, text: str) -> Qos:
        """The QoS of ``encode_dds`` or a bridge, before any suffix. Raises MessageError ("malformed")."""
        parts = text.split(":")
        try:
            history, depth = parts[3].split(",") if parts[3] else ("", "")
            return cls(
                _parse_policy(_DDS_RELIABILITY, parts[1], "reliable"),
                _parse_policy(_DDS_DURABILITY, parts[2], "volatile"),
                *_parse_history(_parse_policy(_DDS_HISTORY, history, "keep_last"), depth, 1),
            )
        except (LookupError, ValueError):
            raise _malformed_error(text, "':1:0:0,10'") from None

    def to_rosbag_yaml(self) -> str:
        """The ``offered_qos_profiles`` of a recording: a YAML list of this one.

        Policies are numbers, which every version of rosbag2 reads; names are read since Jazzy.
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
    # Readers request best effort (rclcpp's ClockQoS) or reliable (a plain subscription). DDS matches a
    # reliable writer with both, a best-effort writer with the former only. An old time is useless.
    "clock": Qos(depth=1),
}
"""The QoS that the writer of each stream offers, like robot_state_publisher and tf2."""


def _parse_policy(numbers: dict[Policy, int], text: str, default: Policy) -> Policy:
    return {str(number): policy for policy, number in numbers.items()}[text] if text else default


def _parse_history(history: History, depth: str, default: int) -> tuple[History, int]:
    if not _DEPTH.fullmatch(depth):
        raise ValueError(depth)
    return history, 0 if history == "keep_all" else int(depth or default)


def _malformed_error(text: str, example: str) -> MessageError:
    return MessageError(
        f"a malformed QoS {shortened(text)!r}; expected a form like {example}", reason="malformed"
    )
