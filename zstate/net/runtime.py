"""How many threads Zenoh receives with: enough that those who vanished hold nobody up who comes back."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import os

import zenoh

RUNTIME_VARIABLE = "ZENOH_RUNTIME"

# Zenoh sets SO_LINGER to 10 s: when a neighbour was cut off, closing its socket blocks one of these
# threads for so long (eclipse-zenoh/zenoh#1101). With all of them blocked nobody can connect.
_RECEIVING = {"router": 128}
_RECEIVING_OTHERWISE = 8


def open_zenoh(config: zenoh.Config) -> zenoh.Session:
    """``zenoh.open``; a process's first session decides on the threads, unless ZENOH_RUNTIME does."""
    if RUNTIME_VARIABLE in os.environ:
        return zenoh.open(config)
    mode = config.get_json("mode").strip('"')
    threads = _RECEIVING.get(mode, _RECEIVING_OTHERWISE)
    os.environ[RUNTIME_VARIABLE] = f"(rx: (worker_threads: {threads}))"
    try:
        return zenoh.open(config)
    finally:
        os.environ.pop(RUNTIME_VARIABLE, None)  # it was read, and is not for the processes started here
