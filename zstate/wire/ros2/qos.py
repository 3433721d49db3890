"""QoS profile of a ROS 2 endpoint and its three encodings: rmw_zenoh_cpp, zenoh-plugin-ros2dds, rosbag2.

The numbers are those of ``rmw/types.h``, except in zenoh-plugin-ros2dds, which uses those of DDS. Deadline,
lifespan and liveliness are always written as their defaults and ignored when read: Zenoh does not
enforce them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

from zstate.errors import InvalidInput, MessageError
from zstate.wire.keys import shortened

Reliability = Literal["reliable", "best_effort"]
Durability = Literal["volatile", "transient_local"]
History = Literal["keep_last", "keep_all"]

RMW_DEPTH = 42
"""Default depth of rmw_zenoh_cpp."""


class _Encoding(NamedTuple):
    """The numbers of the policies, the ``depth`` that an empty one means, and a plain publisher's QoS."""

    reliability: dict[Reliability, int]
    durability: dict[Durability, int]
    history: dict[History, int]
    depth: int
    example: str


_RMW = _Encoding(
    {"reliable": 1, "best_effort": 2},
    {"transient_local": 1, "volatile": 2},
    {"keep_last": 1, "keep_all": 2},
    RMW_DEPTH,
    "::,10:,:,:,,",
)
_DDS = _Encoding(
    {"best_effort": 0, "reliable": 1},
    {"volatile": 0, "transient_local": 1},
    {"keep_last": 0, "keep_all": 1},
    1,
    ":1:0:0,10",
)

Policy = TypeVar("Policy", bound=str)

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
        reliability = "" if self.reliability == "reliable" else _RMW.reliability[self.reliability]
        durability = "" if self.durability == "volatile" else _RMW.durability[self.durability]
        history = "" if self.history == "keep_last" else _RMW.history[self.history]
        depth = "" if self.depth in (0, RMW_DEPTH) else self.depth
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"

    @classmethod
    def parse_rmw(cls, text: str) -> Qos:
        """The QoS that ``encode_rmw`` or a ROS node wrote. Raises MessageError ("malformed")."""
        return _parse(text, text.split(":")[:3], _RMW)

    def encode_dds(self) -> str:
        """The same in zenoh-plugin-ros2dds, without a type hash: ``:rel:dur:hist,depth``."""
        depth = self.depth or -1
        return (
            f":{_DDS.reliability[self.reliability]}:{_DDS.durability[self.durability]}"
            f":{_DDS.history[self.history]},{depth}"
        )

    @classmethod
    def parse_dds(cls, text: str) -> Qos:
        """The QoS of ``encode_dds`` or a bridge, before any suffix. Raises MessageError ("malformed")."""
        chunks = text.split(":")[1:4]
        return _parse(text, [*chunks[:2], *(kept or "," for kept in chunks[2:])], _DDS)

    def to_rosbag_yaml(self) -> str:
        """The ``offered_qos_profiles`` of a recording: a YAML list of this one.

        Policies are numbers, which every version of rosbag2 reads; names are read since Jazzy.
        """
        return (
            f"- history: {_RMW.history[self.history]}\n"
            f"  depth: {self.depth}\n"
            f"  reliability: {_RMW.reliability[self.reliability]}\n"
            f"  durability: {_RMW.durability[self.durability]}\n"
            f"  deadline:{_FOREVER}\n"
            f"  lifespan:{_FOREVER}\n"
            "  liveliness: 1\n"
            f"  liveliness_lease_duration:{_FOREVER}\n"
            "  avoid_ros_namespace_conventions: false"
        )


def _parse_policy(numbers: dict[Policy, int], text: str, default: Policy) -> Policy:
    return {str(number): policy for policy, number in numbers.items()}[text] if text else default


def _parse_depth(text: str) -> int | None:
    if not _DEPTH.fullmatch(text):
        raise ValueError(text)
    return int(text) if text else None


def _parse(text: str, chunks: list[str], encoding: _Encoding) -> Qos:
    """The QoS in the three ``chunks`` of ``text``: reliability, durability, and history with depth."""
    try:
        reliability, durability, kept = chunks
        first, second = kept.split(",")
        history: History = _parse_policy(encoding.history, first, "keep_last")
        depth = _parse_depth(second)
        return Qos(
            _parse_policy(encoding.reliability, reliability, "reliable"),
            _parse_policy(encoding.durability, durability, "volatile"),
            history,
            0 if history == "keep_all" else encoding.depth if depth is None else depth,
        )
    except (LookupError, ValueError):
        raise MessageError(
            f"a malformed QoS {shortened(text)!r}; expected a form like {encoding.example!r}",
            reason="malformed",
        ) from None
