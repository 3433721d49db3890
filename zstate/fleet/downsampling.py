"""Downsampling: a router forwards at most so many samples a second of each robot and stream."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from zstate.errors import InvalidInput
from zstate.fleet.acl import Rule, check_namespace
from zstate.stream_registry import streams_where
from zstate.streams import StreamName
from zstate.wire.keys import check_robot, stream_expression


def downsampled_streams() -> tuple[StreamName, ...]:
    """The streams that may lose samples, those of other packages as well: each is replaced by a newer one."""
    return streams_where(lambda row: row.is_sampled)


@dataclass(frozen=True, slots=True)
class Downsampling:
    """Limits on the samples per second that a router forwards to each neighbour.

    ``rates_hz`` is the limit by stream, for each of ``robots``; ``interfaces`` are the network interfaces
    that it applies to (default: all). The limits of streams with names, such as ``transforms``, are those of
    all their writers of one robot together. Latched values are never dropped. Readers count dropped samples
    as missed. Raises InvalidInput.
    """

    rates_hz: Mapping[str, float]
    robots: tuple[str, ...]
    interfaces: tuple[str, ...] = ()
    namespace: str = ""

    def __post_init__(self) -> None:
        check_namespace(self.namespace)
        check_rates(self.rates_hz)
        if not self.rates_hz or not self.robots:
            # One rule for all robots would limit their sum, and starve some.
            raise InvalidInput(
                "downsampling needs streams and the names of the robots: each has a limit of its own"
            )
        for robot in self.robots:
            check_robot(robot)

    def settings(self) -> list[dict[str, object]]:
        """The section ``downsampling`` of a Zenoh configuration."""
        interfaces = {"interfaces": list(self.interfaces)} if self.interfaces else {}
        rules = rate_rules(self.rates_hz, self.robots, self.namespace)
        return [{"id": "streams", **interfaces, "flows": ["egress"], "messages": ["put"], "rules": rules}]


def check_rates(rates_hz: Mapping[StreamName, float], least_hz: float = sys.float_info.min) -> None:
    """Raises InvalidInput for rates below ``least_hz``, infinite ones, and streams that have no samples."""
    for stream, rate_hz in rates_hz.items():
        if stream not in downsampled_streams():
            raise InvalidInput(f"{stream!r} cannot be downsampled; {', '.join(downsampled_streams())} can")
        if not least_hz <= rate_hz < math.inf:
            what = "a positive number of samples a second" if least_hz else "samples a second, 0 for none"
            raise InvalidInput(f"{stream!r} at {rate_hz} Hz; give {what}")


def rate_rules(rates_hz: Mapping[StreamName, float], robots: Iterable[str], namespace: str) -> list[Rule]:
    """One rule for each robot: they would share the samples that one rule of all lets pass."""
    prefix = f"{namespace}/" if namespace else ""
    return [
        {"key_expr": prefix + stream_expression(robot, stream), "freq": rates_hz[stream]}
        for robot in dict.fromkeys(robots)
        for stream in downsampled_streams()
        if stream in rates_hz
    ]
