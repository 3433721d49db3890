"""Process: one that the harness has started, and ends."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from bench.measure import family

ROOT = Path(__file__).parents[1]
END_WITHIN_S = 4.0


class RunFailed(Exception):
    """A process did not do its part; the text says which, and what it said last."""


class Process:
    """A process whose lines are heard; when it is ended, so is everything it has started.

    A worker is talked with in lines of JSON, and ends when its input does. A service is only listened to,
    and ended by a signal.
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
            start_new_session=True,  # Ctrl-C is for the harness, which then ends everybody in order
        )
        threading.Thread(target=self._hear, args=(self._process.stdout,), daemon=True).start()
        if not is_service:
            threading.Thread(target=self._hear_errors, args=(self._process.stderr,), daemon=True).start()

    @property
    def pid(self) -> int:
        """Its number."""
        return self._process.pid

    def _hear(self, stream: IO[str]) -> None:
        for line in stream:
            self._lines.put(line.rstrip("\n"))
            if self._is_service:
                self._last.append(line.strip())
        self._lines.put(None)

    def _hear_errors(self, stream: IO[str]) -> None:
        self._last.extend(line.strip() for line in stream)

    def tell(self, **command: object) -> None:
        """A command for a worker."""
        self.say(json.dumps(command))

    def say(self, line: str) -> None:
        """A line on its standard input."""
        assert self._process.stdin
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self.failed("has ended") from None

    def expect(self, event: str, within_s: float) -> dict[str, Any]:
        """A worker's next line, which must be this event."""
        line = self._line(within_s, repr(event))
        said: dict[str, Any] = json.loads(line)
        if said["event"] != event:
            raise self.failed(f"failed: {said.get('error', line)}")
        return said

    def expect_text(self, text: str, within_s: float) -> None:
        """A service's line that contains ``text``."""
        deadline = time.monotonic() + within_s
        while text not in self._line(deadline - time.monotonic(), repr(text)):
            pass

    def _line(self, within_s: float, what: str) -> str:
        try:
            line = self._lines.get(timeout=max(0.0, within_s))
        except queue.Empty:
            raise self.failed(f"did not say {what} in time") from None
        if line is None:
            raise self.failed(f"ended before it said {what}")
        return line

    def failed(self, why: str) -> RunFailed:
        """The reason, with what it said last."""
        last = f"; it said last: {' / '.join(self._last)}" if self._last else ""
        return RunFailed(f"the {self.role} {why}{last}")

    def end(self) -> None:
        """Its input ends, then it is asked to, then it and its descendants are made to."""
        descendants = _handles(family(self.pid)[1:])
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


def _handles(pids: Sequence[int]) -> list[int]:
    """What stands for these processes even after their numbers were given to others."""
    handles: list[int] = []
    for pid in pids:
        with suppress(ProcessLookupError):
            handles.append(os.pidfd_open(pid))
    return handles
