"""How a command joins the network: a session that Ctrl-C does not have to wait for."""

from __future__ import annotations

import os
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from zstate.cli.output.console import fail
from zstate.cli.output.logs import warn_on_standard_error
from zstate.cli.output.wire_text import is_ros
from zstate.errors import Unreachable

if TYPE_CHECKING:
    from zstate.net.security.credentials import Credentials
    from zstate.net.session import Session

NATIVE = ("native",)

# A router of this host answers in milliseconds; one elsewhere is given the library's time.
_ROS_ROUTER_WITHIN_S = 2.0
_ROUTER_WITHIN_S = 5.0


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """How to join the network: the session options of one command line, as far as they were given."""

    mode: str | None = None
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: str | Mapping[str, object] | None = None
    credentials: Credentials | None = None

    @property
    def is_explicit(self) -> bool:
        """Whether the user has said anything about it."""
        said = (self.mode, self.connect, self.listen, self.config, self.credentials)
        return any(said) or bool(os.environ.get("ZENOH_CONFIG"))

    @property
    def joins_as(self) -> str:
        """The mode, or what the other options mean without one."""
        from zstate.net.config import implied_mode

        return self.mode or implied_mode(self.connect, self.listen, self.config)


@contextmanager
def open_session(
    network: SessionOptions, wires: tuple[str, ...] = NATIVE, *, timeout_s: float | None = None
) -> Generator[Session]:
    """A session as the options say, for commands that speak ``wires``.

    Where all of these are ROS's and the options say nothing, it is a client of the router of this
    host, where ROS nodes are. A router is given ``timeout_s`` to answer, or a few seconds. Warnings of the
    library go to standard error from now on.
    """
    configured = network.config or os.environ.get("ZENOH_CONFIG")
    if network.mode == "client" and not network.connect and not configured:
        raise click.UsageError("--mode client needs --connect, for instance tcp/192.168.1.10:7447")
    warn_on_standard_error()
    joined = _connect_to_ros if all(map(is_ros, wires)) else _connect
    with joined(network, timeout_s) as session:
        yield session


def _connect_to_ros(network: SessionOptions, timeout_s: float | None) -> Session:
    from zstate.net.config import ROUTER_ENDPOINT

    try:
        if network.is_explicit:
            return _connect(network, timeout_s)
        return _connect(SessionOptions("client", (ROUTER_ENDPOINT,)), timeout_s or _ROS_ROUTER_WITHIN_S)
    except Unreachable as error:
        where = " or ".join(map(repr, error.endpoints)) or "the configured endpoints"
        fail(
            f"nothing answers at {where}, where the router of the ROS 2 nodes should be; start one "
            "(`ros2 run rmw_zenoh_cpp rmw_zenohd`, or `zstate router --ros2`), or say where it is: "
            "--connect tcp/HOST:7447"
        )


def _connect(network: SessionOptions, timeout_s: float | None) -> Session:
    from zstate.cli.processes import BackgroundCall
    from zstate.net.session import connect

    # In a thread of its own: a signal ends the wait for it, which Zenoh's would not.
    worker = BackgroundCall(
        "zstate connect",
        lambda: connect(
            network.config,
            mode=network.joins_as,
            endpoints=network.connect,
            listen=network.listen,
            timeout_s=timeout_s or _ROUTER_WITHIN_S,
            credentials=network.credentials,
        ),
    )
    try:
        return worker.result()
    except Unreachable as error:
        raise _with_advice(error) from None


def _with_advice(error: Unreachable) -> Unreachable:
    from zstate.net.security.connection_check import check_all_tcp  # loads ssl, which few need

    if not error.endpoints:
        return error
    text, then = check_all_tcp(error.endpoints)
    options = "".join(f" --connect {endpoint}" for endpoint in error.endpoints)
    advice = (
        f"try `{then.partition('  #')[0]}`, or `zstate doctor{options}`"
        if then
        else f"`zstate doctor{options}`"
    )
    return Unreachable(f"{text}; {advice}", endpoints=error.endpoints)
