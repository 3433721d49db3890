"""Free ports, child processes, deadlines and a stepping clock."""

from __future__ import annotations

import fcntl
import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from helpers.fork_server import ForkedProcess, server

DEADLINE_S = 15.0
ZENOH_CLOSE_S = 10.0
"""For so long Zenoh waits for a neighbour that does not respond, when a session closes."""
SOON_S = 3.0
"""A limit for actions that take less than a second, with slack for a busy machine."""


_TURNS = Path(tempfile.gettempdir(), f"zstate-test-ports-{os.getuid()}")


def find_free_port() -> int:
    """An unused port: below the system's ephemeral range, and unique among parallel test processes."""
    with _TURNS.open("a+") as turns:
        fcntl.flock(turns, fcntl.LOCK_EX)
        turns.seek(0)
        turn = int(turns.read() or 0) + 1
        while not _is_free(port := 12_000 + turn % 20_000):
            turn += 1
        turns.truncate(0)
        turns.write(str(turn))
    return port


def _is_free(port: int) -> bool:
    with socket.socket() as probe, suppress(OSError):
        probe.bind(("127.0.0.1", port))
        return True
    return False


def without_pauses(kinds: Iterable[str]) -> list[str]:
    """The kinds of a writer's events, without the pauses of a writer on a busy machine: stale and resumed."""
    kept: list[str] = []
    for kind in kinds:
        if kind == "resumed" and kept[-1:] == ["stale"]:
            kept.pop()
        else:
            kept.append(kind)
    return kept


def new_threads(earlier: Iterable[threading.Thread]) -> set[threading.Thread]:
    """The threads of this process that are not among ``earlier`` ones, of which some may have ended."""
    return set(threading.enumerate()).difference(earlier)


def until(condition: Callable[[], object], timeout_s: float = DEADLINE_S) -> None:
    """Waits until ``condition()`` is true; fails after ``timeout_s``."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"not so within {timeout_s} s"
        time.sleep(0.002)


def take(seconds: float) -> None:
    """The time that a simulated device takes for an action: an input of the test, which waits for nothing."""
    time.sleep(seconds)


@contextmanager
def repeated(action: Callable[[], object], every_s: float = 0.01) -> Iterator[None]:
    """Calls ``action`` every ``every_s`` inside the block, in a thread."""
    stop = threading.Event()

    def repeat() -> None:
        while not stop.wait(every_s):
            action()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def mounted_disk(place: Path, size: str) -> Iterator[Path]:
    """A disk of that size ("256k") at ``place``, for tests with the marker ``disk``."""
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "zstate-test", str(place)], check=True)
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


class SteppingClock:
    """A clock that jumps to the awaited stamp, plus the lateness given for that wait."""

    domain = "system"

    def __init__(self, start: int = 5, lateness: dict[int, int] | None = None) -> None:
        self.stamp = start
        self.waits: list[int] = []
        self._lateness = lateness or {}

    def now(self) -> int:
        return self.stamp

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        self.stamp = max(self.stamp, stamp) + self._lateness.get(len(self.waits), 0)
        self.waits.append(stamp)
        return not stop.is_set()


class Child:
    """A Python process that runs ``code`` and exchanges lines with the test.

    It is a fork of a process that has imported zstate and ``imports``, unless ``is_forked`` is false.
    """

    process: subprocess.Popen[str] | ForkedProcess

    def __init__(
        self, code: str, *arguments: str, is_forked: bool = True, imports: Sequence[str] = ()
    ) -> None:
        if is_forked:
            self.process = server().start(textwrap.dedent(code), *arguments, imports=imports)
        else:
            self.process = subprocess.Popen(
                [sys.executable, "-u", "-c", textwrap.dedent(code), *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        self._lines: queue.Queue[str] = queue.Queue()
        self._errors: list[str] = []
        self._readers = [
            threading.Thread(target=self._read_lines, daemon=True),
            threading.Thread(target=self._read_errors, daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _read_lines(self) -> None:
        for line in self.process.stdout or ():
            self._lines.put(line.rstrip("\n"))

    def _read_errors(self) -> None:
        self._errors.extend(self.process.stderr or ())

    def line(self, timeout_s: float = DEADLINE_S) -> str:
        """The next line of its output."""
        try:
            return self._lines.get(timeout=timeout_s)
        except queue.Empty:
            raise AssertionError(f"silent for {timeout_s} s; stderr: {self.stderr!r}") from None

    def rest(self) -> str:
        """The lines of its output that were not read; for after its end."""
        lines: list[str] = []
        while not self._lines.empty():
            lines.append(self._lines.get() + "\n")
        return "".join(lines)

    def send_line(self, line: str = "") -> None:
        assert self.process.stdin
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def freeze(self) -> None:
        """Stops the process, as Ctrl-Z does. It runs on for a moment: until a thread of it has the signal."""
        self.process.send_signal(signal.SIGSTOP)
        until(lambda: all(state in "Tt" for state in self._thread_states()))

    def _thread_states(self) -> Iterator[str]:
        for file in Path(f"/proc/{self.process.pid}/task").glob("*/stat"):
            with suppress(FileNotFoundError):  # a thread that has just ended
                yield file.read_text().rpartition(")")[2].split()[0]

    def kill(self) -> None:
        """Kills the process, as ``kill -9`` does."""
        self.process.kill()
        self.process.wait(DEADLINE_S)

    def wait(self, timeout_s: float = DEADLINE_S) -> int:
        """Waits for the end of the process and its output; returns the exit code."""
        code = self.process.wait(timeout_s)
        for reader in self._readers:
            reader.join(timeout_s)
        return code

    @property
    def stderr(self) -> str:
        return "".join(self._errors)
