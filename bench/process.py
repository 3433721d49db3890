"""Worker and service processes started and stopped by the harness."""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from bench.measure import process_tree

ROOT = Path(__file__).parents[1]
START_WITHIN_S = 60.0
END_WITHIN_S = 4.0


class RunFailed(Exception):
    """A process failed; the text names it and quotes its last output."""


class Process:
    """A process whose output lines are read; ``stop`` also ends all its descendants.

    A worker exchanges lines of JSON and ends when its input closes. A service only writes lines and is
    stopped by a signal.
    """

    def __init__(
        self, role: str, command: Sequence[str], environment: Mapping[str, str], *, is_service: bool = False
    ) -> None:
        self.role = role
        self._is_service = is_service
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._last: deque[str] = deque(maxlen=6)
        self._process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT if is_service else subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C reaches only the harness, which stops the processes in order
        )
        threading.Thread(target=self._read_output, args=(self._process.stdout,), daemon=True).start()
        if not is_service:
            threading.Thread(target=self._read_errors, args=(self._process.stderr,), daemon=True).start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def _read_output(self, stream: IO[str]) -> None:
        for line in stream:
            self._lines.put(line.rstrip("\n"))
            if self._is_service:
                self._last.append(line.strip())
        self._lines.put(None)

    def _read_errors(self, stream: IO[str]) -> None:
        self._last.extend(line.strip() for line in stream)

    def send_command(self, **command: object) -> None:
        """Sends a command to a worker."""
        self.send_line(json.dumps(command))

    def send_line(self, line: str) -> None:
        """Writes a line to its standard input."""
        assert self._process.stdin
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self.failed("has ended") from None

    def wait_for_event(self, event: str, within_s: float) -> dict[str, Any]:
        """A worker's next message. Raises RunFailed if it is not ``event`` or does not arrive in time."""
        line = self._line(within_s, repr(event))
        message: dict[str, Any] = json.loads(line)
        if message["event"] != event:
            raise self.failed(f"failed: {message.get('error', line)}")
        return message

    def wait_for_text(self, text: str, within_s: float) -> str:
        """A service's next line that contains ``text``. Raises RunFailed if none arrives in time."""
        deadline = time.monotonic() + within_s
        while text not in (line := self._line(deadline - time.monotonic(), repr(text))):
            pass
        return line

    def _line(self, within_s: float, what: str) -> str:
        try:
            line = self._lines.get(timeout=max(0.0, within_s))
        except queue.Empty:
            raise self.failed(f"did not send {what} within {within_s:.1f} s") from None
        if line is None:
            raise self.failed(f"ended before it sent {what}")
        return line

    def failed(self, why: str) -> RunFailed:
        """An error with ``why`` and the last lines of output."""
        last = f"; its last output: {' / '.join(self._last)}" if self._last else ""
        return RunFailed(f"the {self.role} {why}{last}")

    def stop(self) -> None:
        """Closes its input, then sends SIGINT, then kills it; finally kills its descendants."""
        descendants = _handles(process_tree(self.pid)[1:])
        assert self._process.stdin
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        if self._is_service or not self._has_ended(END_WITHIN_S):
            self._process.send_signal(signal.SIGINT)
        if not self._has_ended(END_WITHIN_S):
            self._process.kill()
            self._process.wait()
        for handle in descendants:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
            os.close(handle)

    def _has_ended(self, within_s: float) -> bool:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(within_s)
        return self._process.poll() is not None


@contextmanager
def running(role: str, *command: str, **variables: str) -> Iterator[Process]:
    """A worker inside the block, with ``variables`` in its environment."""
    process = Process(role, command, variables)
    try:
        yield process
    finally:
        process.stop()


@contextmanager
def running_command(*arguments: str, text: str = "") -> Iterator[tuple[int, str]]:
    """Runs ``zstate ARGUMENTS`` inside the block; yields its process id and its first line with ``text``."""
    process = Process(arguments[0], (sys.executable, "-m", "zstate", *arguments), {}, is_service=True)
    try:
        yield process.pid, process.wait_for_text(text, START_WITHIN_S)
    finally:
        process.stop()


def _handles(pids: Sequence[int]) -> list[int]:
    """Process file descriptors, which stay valid after a process id is reused."""
    handles: list[int] = []
    for pid in pids:
        with suppress(ProcessLookupError):
            handles.append(os.pidfd_open(pid))
    return handles


def free_ports(count: int) -> tuple[int, ...]:
    """Loopback ports without a listener."""
    with ExitStack() as opened:
        probes = [opened.enter_context(socket.socket()) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return tuple(probe.getsockname()[1] for probe in probes)
