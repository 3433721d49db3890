"""Processes that run during a micro benchmark."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from bench.process import free_ports


def use_own_rendezvous() -> None:
    """Sets a private rendezvous address for this process and its children."""
    os.environ["ZSTATE_RENDEZVOUS"] = f"127.0.0.1:{free_ports(1)[0]}"


@contextmanager
def running_command(*arguments: str) -> Iterator[tuple[int, str]]:
    """Runs ``zstate ARGUMENTS`` inside the block; yields its process id and its first line of output."""
    with running_process(sys.executable, "-m", "zstate", *arguments) as started:
        yield started


@contextmanager
def running_process(*command: str, job: str | None = None) -> Iterator[tuple[int, str]]:
    """Runs a process with ``job`` as its input; yields its id and its first line of output."""
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        if job is not None:
            process.stdin.write(job)
            process.stdin.close()
        first_line = process.stdout.readline().strip()
        if not first_line:
            raise SystemExit(f"`{' '.join(command[:4])} ...` has ended")
        yield process.pid, first_line
    finally:
        process.terminate()
        process.wait()
