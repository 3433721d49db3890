"""A session that Ctrl-C does not have to wait for."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Sequence

import click

from zstate.net.session import Session, connect


def connect_interruptibly(
    config: str | None, mode: str, endpoints: Sequence[str], listen: Sequence[str]
) -> Session:
    """``connect`` in a thread of its own: a signal ends the wait for it, which Zenoh's would not."""
    outcomes: queue.SimpleQueue[Session | Exception] = queue.SimpleQueue()

    def open_session() -> None:
        try:
            outcomes.put(connect(config, mode=mode, endpoints=endpoints, listen=listen))
        except Exception as error:  # raised again where it is waited for
            outcomes.put(error)

    _warn_on_stderr()
    threading.Thread(target=open_session, name="zstate connect", daemon=True).start()
    outcome = outcomes.get()
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


class _Stderr(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        # Looked up at each record: a live table puts itself in the place of standard error.
        click.echo(f"zstate: {record.getMessage()}", err=True)


def _warn_on_stderr() -> None:
    logger = logging.getLogger("zstate")
    logger.addHandler(_Stderr(logging.WARNING))
    logger.propagate = False
