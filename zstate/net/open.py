"""Opening a Zenoh session: retried until a router or peer accepts it, or all of them deny it.

Also sets Zenoh's thread-pool sizes: enough that closing dead links does not block reconnecting peers.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import zenoh

from zstate.errors import AccessDenied, NetworkError, PortBusy
from zstate.net.at_exit import session_opening

if TYPE_CHECKING:
    from zstate.net.security.credentials import Credentials

RUNTIME_VARIABLE = "ZENOH_RUNTIME"
RETRY_PERIOD_S = 0.1
CHECK_PERIOD_S = 1.0

# Of Zenoh's runtimes the sockets belong to "net" and "acc", and what receives from them to "rx": each sample
# wakes a thread to wake another. With one runtime for the three, a reader's sample costs 30 us less CPU.
#
# A router sends what it receives in the thread that received it, which waits while the queue of a neighbour
# is full: up to 50 ms for each cloud. With one runtime that may be the thread that polls all sockets: if it
# has found a single task it wakes no other one to poll. So a router has another runtime for "rx": next to
# clouds the p99 of joint states was 2.6 ms, and is 0.6.
#
# zenoh 1.10, closing the socket of a neighbour that was cut off blocks a thread for the 10 s of SO_LINGER,
# issue 1101: delete when fixed. With all threads blocked nothing can connect, so there are more threads than
# one. "tx" closes nothing and keeps its single one: a second is woken in vain.
_THREADS = 4
_ROUTER_THREADS = 128


def runtime(*, is_router: bool) -> str:
    """The value for ``ZENOH_RUNTIME``."""
    if is_router:
        pool = f"(worker_threads: {_ROUTER_THREADS})"
        return f"(rx: {pool}, acc: (handover: net), net: {pool})"
    return f"(rx: (handover: net), acc: (handover: net), net: (worker_threads: {_THREADS}))"


def open_zenoh(config: zenoh.Config) -> zenoh.Session:
    """``zenoh.open``. The first session of a process fixes the thread counts, unless ZENOH_RUNTIME is set.

    Raises Closed in a forked process (see ``session_opening``), and while the process ends.
    """
    with session_opening():
        if RUNTIME_VARIABLE in os.environ:
            return zenoh.open(config)
        mode = config.get_json("mode").strip('"')
        os.environ[RUNTIME_VARIABLE] = runtime(is_router=mode == "router")
        try:
            return zenoh.open(config)
        finally:
            os.environ.pop(RUNTIME_VARIABLE, None)  # it has been read; child processes do not inherit it


def open_with_retry(
    config: zenoh.Config,
    endpoints: Sequence[str],
    credentials: Credentials | None = None,
    timeout_s: float = 0.0,
) -> zenoh.Session:
    """A session with ``config``; if it gets no link, retried for ``timeout_s`` [s].

    Raises PortBusy, Unreachable, NetworkError; and AccessDenied, before the timeout, if all of ``endpoints``
    deny it.
    """
    deadline, next_check = time.monotonic() + timeout_s, 0.0
    while (session := _attempt(config)) is None:
        if time.monotonic() >= min(deadline, next_check):
            from zstate.net.security.connection_check import check_connections  # noqa: PLC0415  # loads ssl

            results = check_connections(endpoints, credentials)
            next_check = time.monotonic() + CHECK_PERIOD_S
            if results.is_denied or time.monotonic() >= deadline:
                # A router that answers the check may have started after our attempt, and deny nothing.
                session = _attempt(config) if isinstance(results.error, AccessDenied) else None
                if session is None:
                    raise results.error
                return session
        time.sleep(RETRY_PERIOD_S)
    return session


# zenoh 1.10, one error for everything: delete the patterns when errors have kinds
def _attempt(config: zenoh.Config) -> zenoh.Session | None:
    """A session, or None without a link."""
    try:
        return open_zenoh(config)
    except zenoh.ZError as error:
        text = str(error)
    busy = re.search(r"bound to (\S+?):? .*Address already in use", text)
    if busy:
        raise PortBusy(
            f"another program listens at {busy[1]!r}; choose another port, or stop that program",
            endpoint=busy[1],
        )
    if "Unable to connect" not in text:
        text = re.sub(r" at /[^\s\]]*", "", text)  # places in Zenoh's sources
        raise NetworkError(f"Zenoh cannot open a session: {text}")
    return None
