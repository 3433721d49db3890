"""Shared parts of the DDS subjects: free domains and the replacement of a state publisher."""

from __future__ import annotations

import functools
import socket

# The well-known ports of DDSI-RTPS: 7400 + 250 * domain. Above 101 they overlap Linux's ephemeral ports.
_FIRST_PORT, _PORTS_OF_A_DOMAIN, _DOMAINS = 7400, 250, 101

DOMAIN_VARIABLE = "BENCH_DDS_DOMAIN"
"""The environment variable that gives a worker its domain."""

NO_STATE_PUBLISHER = (
    "it has no robot_state_publisher and no tf2_ros, because no wheels of them exist: the transforms of all "
    "moving edges are computed and serialized for each row before the run, and the writer only inserts the "
    "stamps; this favours it, because a state publisher receives, computes and sends another message",
    "the reader's buffer is a dict: of each message it keeps the edges between base and tip for 10 s and "
    "composes them in plain Python along a precomputed path: less work than tf2 does",
)


@functools.cache
def free_domain(ports: tuple[int, ...]) -> int:
    """A domain without participants on this host; one per run, which owns ``ports``."""
    candidates = range(1, _DOMAINS + 1)
    begin = ports[0] % _DOMAINS
    return next(domain for domain in (*candidates[begin:], *candidates[:begin]) if _is_free(domain))


def _is_free(domain: int) -> bool:
    """Whether the first participant's port is free."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", _FIRST_PORT + _PORTS_OF_A_DOMAIN * domain + 10))
        except OSError:
            return False
    return True
