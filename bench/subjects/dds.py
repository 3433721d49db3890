"""What the subjects on DDS have in common: domains, and what stands in for a state publisher."""

from __future__ import annotations

import functools
import socket

# The well-known ports of DDSI-RTPS: 7400 + 250 * domain. Above 101 they are among Linux's ephemeral ones.
_FIRST_PORT, _PORTS_OF_A_DOMAIN, _DOMAINS = 7400, 250, 101

NO_STATE_PUBLISHER = (
    "there is no robot_state_publisher and no tf2_ros in it, for there are no wheels of them: the transforms "
    "of all moving edges were computed and serialized for each row before the run, and the writer puts only "
    "the stamps in; this favours it, for a state publisher receives, computes and sends another message",
    "the reader's buffer is a dict: of each message it keeps the edges between base and tip, for 10 s, and "
    "composes them in plain Python, the way between them being known beforehand: less than tf2 does",
)


@functools.cache
def free_domain(ports: tuple[int, ...]) -> int:
    """A domain that nobody on this host seems to be in; one for each run, which has ``ports`` to itself."""
    wished = range(1, _DOMAINS + 1)
    begin = ports[0] % _DOMAINS
    return next(domain for domain in (*wished[begin:], *wished[:begin]) if _is_free(domain))


def _is_free(domain: int) -> bool:
    """Whether the first participant's port can still be had."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", _FIRST_PORT + _PORTS_OF_A_DOMAIN * domain + 10))
        except OSError:
            return False
    return True
