"""Opening a Zenoh session: again and again, until somebody lets it in or all that are there have refused."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import zenoh

from zstate.errors import AccessDenied, NetworkError, PortBusy
from zstate.net.config import endpoints_in
from zstate.net.runtime import open_zenoh
from zstate.net.security import Credentials

if TYPE_CHECKING:
    from zstate.net.refusal import Answers

AGAIN_S = 0.1
KNOCK_PERIOD_S = 1.0


def open_within(
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
        _check_is_for_want_of_a_link(str(error))
        return None


def _confirmed(config: zenoh.Config, error: NetworkError) -> zenoh.Session:
    # Whoever answered the knock may have started after our attempt, and refuse nobody.
    session = _attempt(config) if isinstance(error, AccessDenied) else None
    if session is None:
        raise error
    return session


def patience_in(config: zenoh.Config) -> float:
    """How long the client that ``config`` describes goes on asking [s]; from now on, that is up to us.

    Zenoh spends all of that time on the first endpoint; without, it asks each of them once. Zero where
    ``config`` describes something else, or leaves the waiting out.
    """
    told: dict[str, Any] = json.loads(config.get_json("connect"))
    timeout_ms, is_needed = (_of_client(told[name]) for name in ("timeout_ms", "exit_on_failure"))
    is_client = json.loads(config.get_json("mode")) == "client"
    if not (is_client and endpoints_in(config) and timeout_ms) or is_needed is False:
        return 0.0
    config.insert_json5("connect/timeout_ms", "0")
    return math.inf if timeout_ms < 0 else timeout_ms / 1000.0


def _of_client(value: Any) -> Any:
    """What a setting says that may say something else for each mode."""
    return cast("dict[str, Any]", value).get("client") if isinstance(value, dict) else value


def _check_is_for_want_of_a_link(text: str) -> None:
    """Zenoh has one error for everything; its text tells them apart."""
    busy = re.search(r"bound to (\S+?):? .*Address already in use", text)
    if busy:
        raise PortBusy(
            f"somebody listens at {busy[1]!r} already; choose another port, or stop that program",
            endpoint=busy[1],
        ) from None
    if "Unable to connect" not in text:
        raise NetworkError(f"Zenoh cannot open a session: {_without_places(text)}") from None


def _answers(endpoints: Sequence[str], credentials: Credentials | None) -> Answers:
    from zstate.net.refusal import knock  # noqa: PLC0415  # loads ssl, which few need

    return knock(endpoints, credentials)


def _without_places(text: str) -> str:
    return re.sub(r" at /[^\s\]]*", "", text)
