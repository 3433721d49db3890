"""The session of a command, from its options. Ctrl-C interrupts connecting."""

from __future__ import annotations

import os
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from zstate.cli.output.console import GRACE_S, fail, print_status
from zstate.cli.output.logs import warn_on_standard_error
from zstate.cli.output.wire_text import is_ros
from zstate.errors import Unreachable

if TYPE_CHECKING:
    from zstate.cli.processes import BackgroundCall
    from zstate.net.security.credentials import Credentials
    from zstate.net.session import Session

NATIVE = ("native",)

# A router on this host answers in milliseconds; a remote one gets the library's default.
_LOCAL_ROUTER_WITHIN_S = 2.0
_ROUTER_WITHIN_S = 5.0


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """The session options of a command line; None or empty if not set."""

    mode: str | None = None
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: str | Mapping[str, object] | None = None
    credentials: Credentials | None = None

    @property
    def is_explicit(self) -> bool:
        """Whether any option or ZENOH_CONFIG is set."""
        values = (self.mode, self.connect, self.listen, self.config, self.credentials)
        return any(values) or bool(os.environ.get("ZENOH_CONFIG"))

    @property
    def joins_as(self) -> str:
        """The mode, or the one that the other options imply."""
        from zstate.net.environment import implied_mode

        return self.mode or implied_mode(self.connect, self.listen, self.config)

    def for_wires(self, wires: tuple[str, ...]) -> SessionOptions:
        """The options that ``open_session`` uses.

        If all of ``wires`` are ROS wires and no option is set, the session is a client of the router on this
        host, which ROS nodes use.
        """
        from zstate.net.config import ROUTER_ENDPOINT

        is_default = all(map(is_ros, wires)) and not self.is_explicit
        return SessionOptions("client", (ROUTER_ENDPOINT,)) if is_default else self

    def open(self, timeout_s: float) -> Session:
        """Connect with these options."""
        from zstate.net.session import connect

        return connect(
            self.config,
            mode=self.joins_as,
            endpoints=self.connect,
            listen=self.listen,
            timeout_s=timeout_s,
            credentials=self.credentials,
        )


@contextmanager
def open_session(
    network: SessionOptions, wires: tuple[str, ...] = NATIVE, *, timeout_s: float | None = None
) -> Generator[Session]:
    """A session for commands on ``wires``; connecting to a router may take ``timeout_s``, or a few seconds.

    With ``timeout_s`` the command prints after 0.5 s where no router answers. From now on, warnings of the
    library go to standard error.
    """
    from zstate.cli.processes import BackgroundCall

    configured = network.config or os.environ.get("ZENOH_CONFIG")
    if network.mode == "client" and not network.connect and not configured:
        raise click.UsageError("--mode client needs --connect, for instance tcp/192.168.1.10:7447")
    warn_on_standard_error()
    options = network.for_wires(wires)
    within_s = timeout_s or (_ROUTER_WITHIN_S if options is network else _LOCAL_ROUTER_WITHIN_S)
    # In a background thread: a signal interrupts waiting for it, but not Zenoh's own wait.
    call = BackgroundCall("zstate connect", lambda: options.open(within_s))
    try:
        session = _result(call, options.connect, timeout_s)
    except Unreachable as error:
        if not all(map(is_ros, wires)):
            raise _with_advice(error) from None
        where = endpoints_text(error.endpoints)
        fail(
            f"nothing answers at {where}, where the router of the ROS 2 nodes should be; start one "
            "(`ros2 run rmw_zenoh_cpp rmw_zenohd`, or `zstate router --ros2`), or set its address: "
            "--connect tcp/HOST:7447"
        )
    with session:
        yield session


def _result(call: BackgroundCall[Session], endpoints: Sequence[str], timeout_s: float | None) -> Session:
    """The session of ``call``; with ``timeout_s``, a status line is printed if it takes over ``GRACE_S``."""
    if timeout_s is not None:
        try:
            return call.result(min(GRACE_S, timeout_s))
        except Unreachable:
            raise
        except TimeoutError:
            print_status(f"waiting: no answer yet at {endpoints_text(endpoints)}", event="waiting")
    return call.result()


def endpoints_text(endpoints: Sequence[str]) -> str:
    """Where a session connects."""
    return " or ".join(map(repr, endpoints)) or "the configured endpoints"


def _with_advice(error: Unreachable) -> Unreachable:
    from zstate.net.security.connection_check import check_all_tcp  # loads ssl, which few commands need

    if not error.endpoints:
        return error
    text, then = check_all_tcp(error.endpoints)
    options = "".join(f" --connect {endpoint}" for endpoint in error.endpoints)
    doctor, command = f"`zstate doctor{options}`", then.partition("  #")[0]
    advice = f"try `{command}`, or {doctor}" if then else doctor
    return Unreachable(f"{text}; {advice}", endpoints=error.endpoints)
