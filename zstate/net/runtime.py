"""How many threads Zenoh has: enough that those who vanished hold nobody up who comes back."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import os

import zenoh

RUNTIME_VARIABLE = "ZENOH_RUNTIME"

# Zenoh sets SO_LINGER to 10 s: closing the socket of a neighbour who was cut off blocks the thread that
# does it for so long (eclipse-zenoh/zenoh#1101). That is one of those that receive where nothing came for a
# lease, and one of "net" where nothing could be sent; the last to let go may be one that sends. With all of
# a kind blocked nobody can connect: Zenoh has 2 that receive, and 1 of the others.
_THREADS = {"rx": 8, "tx": 4, "net": 4}
_THREADS_OF_A_ROUTER = {"rx": 128, "tx": 64, "net": 64}


def runtime(*, is_router: bool) -> str:
    """What ``ZENOH_RUNTIME`` is set to."""
    threads = _THREADS_OF_A_ROUTER if is_router else _THREADS
    return "({})".format(", ".join(f"{pool}: (worker_threads: {count})" for pool, count in threads.items()))


def open_zenoh(config: zenoh.Config) -> zenoh.Session:
    """``zenoh.open``; a process's first session decides on the threads, unless ZENOH_RUNTIME does."""
    if RUNTIME_VARIABLE in os.environ:
        return zenoh.open(config)
    mode = config.get_json("mode").strip('"')
    os.environ[RUNTIME_VARIABLE] = runtime(is_router=mode == "router")
    try:
        return zenoh.open(config)
    finally:
        os.environ.pop(RUNTIME_VARIABLE, None)  # it was read, and is not for the processes started here
