"""How a command joins the network: a session that Ctrl-C does not have to wait for."""

from __future__ import annotations

import logging
import os
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from zstate.net.session import Session


@dataclass(frozen=True, slots=True)
class Network:
    """How to join the network: the session options of one command line."""

    mode: str = "peer"
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    config: str | None = None


@contextmanager
def open_session(network: Network) -> Generator[Session]:
    """A session as the options say. Warnings of the library go to standard error from now on."""
    configured = network.config or os.environ.get("ZENOH_CONFIG")
    if network.mode == "client" and not network.connect and not configured:
        raise click.UsageError("--mode client needs --connect, for instance tcp/192.168.1.10:7447")
    _warn_on_stderr()
    with _connect(network) as session:
        yield session


def _connect(network: Network) -> Session:
    from zstate.cli.worker import Worker
    from zstate.net.session import connect

    # In a thread of its own: a signal ends the wait for it, which Zenoh's would not.
    return Worker(
        "zstate connect",
        lambda: connect(network.config, mode=network.mode, endpoints=network.connect, listen=network.listen),
    ).result()


class _Stderr(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        # Looked up at each record: a live table puts itself in the place of standard error.
        click.echo(f"zstate: {record.getMessage()}", err=True)


def _warn_on_stderr() -> None:
    logger = logging.getLogger("zstate")
    logger.addHandler(_Stderr(logging.WARNING))
    logger.propagate = False
