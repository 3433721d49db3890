"""Opening a Zenoh session: again and again, until somebody lets it in or all that are there have refused.

How many threads Zenoh has: enough that those who vanished hold nobody up who comes back.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import json
import math
import os
import re
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import zenoh

from zstate.errors import AccessDenied, NetworkError, PortBusy
from zstate.net.at_exit import session_opening
from zstate.net.config import endpoints_in
from zstate.net.security.credentials import Credentials

if TYPE_CHECKING:
    from zstate.net.security.connection_check import CheckResults

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


AGAIN_S = 0.1
KNOCK_PERIOD_S = 1.0


def open_with_retry(
    config: zenoh.Config,
    endpoints: Sequence[str],
    credentials: Credentials | None = None,
    timeout_s: float = 0.0,
) -> zenoh.Session:
    """A session as ``config`` says; where that fails for want of a link, tried again for ``timeout_s`` [s].

    Raises PortBusy, Unreachable, NetworkError; and AccessDenied, without waiting for the time to be over
    where all of ``endpoints`` refuse.
    """
    deadline, next_knock = time.monotonic() + timeout_s, 0.0
    while (session := _attempt(config)) is None:
        if time.monotonic() >= min(deadline, next_knock):
            answers = _answers(endpoints, credentials)
            next_knock = time.monotonic() + KNOCK_PERIOD_S
            if answers.are_refusals or time.monotonic() >= deadline:
                return _confirmed(config, answers.error)
        time.sleep(AGAIN_S)
    return session


def _attempt(config: zenoh.Config) -> zenoh.Session | None:
    try:
        return open_zenoh(config)
    except zenoh.ZError as error:
        _check_is_link_error(str(error))
        return None


def _confirmed(config: zenoh.Config, error: NetworkError) -> zenoh.Session:
    # Whoever answered the knock may have started after our attempt, and refuse nobody.
    session = _attempt(config) if isinstance(error, AccessDenied) else None
    if session is None:
        raise error
    return session


def connect_timeout(config: zenoh.Config) -> float:
    """How long the client that ``config`` describes goes on asking [s]; from now on, that is up to us.

    Zenoh spends all of that time on the first endpoint; without, it asks each of them once. Zero where
    ``config`` describes something else, or leaves the waiting out.
    """
    told: dict[str, Any] = json.loads(config.get_json("connect"))
    timeout_ms, is_needed = (_client_value(told[name]) for name in ("timeout_ms", "exit_on_failure"))
    is_client = json.loads(config.get_json("mode")) == "client"
    if not (is_client and endpoints_in(config) and timeout_ms) or is_needed is False:
        return 0.0
    config.insert_json5("connect/timeout_ms", "0")
    return math.inf if timeout_ms < 0 else timeout_ms / 1000.0


def _client_value(value: Any) -> Any:
    """What a setting says that may say something else for each mode."""
    return cast("dict[str, Any]", value).get("client") if isinstance(value, dict) else value


def _check_is_link_error(text: str) -> None:
    """Zenoh has one error for everything; its text tells them apart."""
    busy = re.search(r"bound to (\S+?):? .*Address already in use", text)
    if busy:
        raise PortBusy(
            f"somebody listens at {busy[1]!r} already; choose another port, or stop that program",
            endpoint=busy[1],
        ) from None
    if "Unable to connect" not in text:
        raise NetworkError(f"Zenoh cannot open a session: {_without_places(text)}") from None


def _answers(endpoints: Sequence[str], credentials: Credentials | None) -> CheckResults:
    from zstate.net.security.connection_check import check_endpoints  # noqa: PLC0415  # loads ssl, which few need

    return check_endpoints(endpoints, credentials)


def _without_places(text: str) -> str:
    return re.sub(r" at /[^\s\]]*", "", text)
