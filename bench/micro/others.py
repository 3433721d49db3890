"""Other processes that a measurement needs: zstate's own commands, and ports for them."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def meet_nobody_else() -> None:
    """From here on this process, and those it starts, meet on a rendezvous of their own."""
    os.environ["ZSTATE_RENDEZVOUS"] = f"127.0.0.1:{free_port()}"


def free_port() -> int:
    """A port of loopback that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def running(*arguments: str) -> Iterator[None]:
    """``zstate ARGUMENTS`` runs meanwhile, from its first line of output on."""
    command = [sys.executable, "-m", "zstate", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        if not process.stdout.readline():
            raise SystemExit(f"`zstate {' '.join(arguments)}` has ended")
        yield
    finally:
        process.terminate()
        process.communicate()
