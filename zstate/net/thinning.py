"""Thinning: streams that a router passes on more slowly than they come, for links that are narrow."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from zstate.errors import InvalidInput
from zstate.net.access import check_namespace
from zstate.wire.keys import Stream, stream_key

THINNED: tuple[Stream, ...] = ("joint_states", "tf")
"""The streams whose samples may be left out: each is followed by a newer one."""


@dataclass(frozen=True, slots=True)
class Thinning:
    """Streams of which a router passes on at most so many samples a second, to each neighbour.

    ``rates_hz`` says how many, of each of ``robots``; ``interfaces`` names the network interfaces to
    whose neighbours that applies, all unless given. Latched values are never left out. Readers count
    the samples left out as missed. Raises InvalidInput.
    """

    rates_hz: Mapping[str, float]
    robots: tuple[str, ...]
    interfaces: tuple[str, ...] = ()
    namespace: str = ""

    def __post_init__(self) -> None:
        check_namespace(self.namespace)
        for stream, rate_hz in self.rates_hz.items():
            if stream not in THINNED:
                raise InvalidInput(f"{stream!r} cannot be downsampled; {' and '.join(THINNED)} can")
            if not (math.isfinite(rate_hz) and rate_hz > 0.0):
                raise InvalidInput(f"{stream!r} at {rate_hz} Hz; give a positive number of samples a second")
        if not self.rates_hz or not self.robots:
            # One rule for all robots would let through so many of them together, and starve some.
            raise InvalidInput(
                "downsampling needs streams and the names of the robots: each is counted apart"
            )

    def settings(self) -> list[dict[str, object]]:
        """The section ``downsampling`` of a Zenoh configuration."""
        among = {"interfaces": list(self.interfaces)} if self.interfaces else {}
        rules = list(self._rules())
        return [{"id": "streams", **among, "flows": ["egress"], "messages": ["put"], "rules": rules}]

    def _rules(self) -> Iterator[dict[str, object]]:
        prefix = f"{self.namespace}/" if self.namespace else ""
        for robot in dict.fromkeys(self.robots):
            for stream in THINNED:
                if stream in self.rates_hz:
                    yield {"key_expr": prefix + stream_key(robot, stream), "freq": self.rates_hz[stream]}
