"""How many threads Zenoh has: enough that those who vanished hold nobody up who comes back."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import os

import zenoh

from zstate.net.at_exit import session_opening

RUNTIME_VARIABLE = "ZENOH_RUNTIME"

# Of Zenoh's runtimes the sockets belong to "net" and "acc", and what receives from them to "rx": each sample
# wakes a thread to wake another. With one runtime for the three, a reader's sample costs 30 us less CPU.
#
# Zenoh sets SO_LINGER to 10 s: closing the socket of a neighbour who was cut off blocks the thread that
# does it for so long (eclipse-zenoh/zenoh#1101), and with all of them blocked nobody can connect: so there
# are more threads than one. "tx" closes nothing and keeps its single one: a second is woken in vain.
_THREADS = 4
_THREADS_OF_A_ROUTER = 128


def runtime(*, is_router: bool) -> str:
    """What ``ZENOH_RUNTIME`` is set to."""
    threads = _THREADS_OF_A_ROUTER if is_router else _THREADS
    return f"(rx: (handover: net), acc: (handover: net), net: (worker_threads: {threads}))"


def open_zenoh(config: zenoh.Config) -> zenoh.Session:
    """``zenoh.open``; a process's first session decides on the threads, unless ZENOH_RUNTIME does.

    Raises Closed in a forked process (see ``session_opening``), and where the process ends.
    """
    with session_opening():
        if RUNTIME_VARIABLE in os.environ:
            return zenoh.open(config)
        mode = config.get_json("mode").strip('"')
        os.environ[RUNTIME_VARIABLE] = runtime(is_router=mode == "router")
        try:
            return zenoh.open(config)
        finally:
            os.environ.pop(RUNTIME_VARIABLE, None)  # it was read, and is not for the processes started here
