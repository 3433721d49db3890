"""zstate commands as processes, and free ports for them."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def use_own_rendezvous() -> None:
    """Sets a private rendezvous address for this process and its children."""
    os.environ["ZSTATE_RENDEZVOUS"] = f"127.0.0.1:{free_port()}"


def free_port() -> int:
    """An unused loopback port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def running_command(*arguments: str) -> Iterator[None]:
    """Runs ``zstate ARGUMENTS`` inside the block, from its first line of output on."""
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
