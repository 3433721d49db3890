"""Other processes of this one: their lines, their end, and ours with theirs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import IO

from zstate.cli.logs import text_in
from zstate.closing import Closing

END_WITHIN_S = 0.8
_PROGRAM_ENDS_WITHIN_S = 3.0
_LONGEST_ERROR = 500

_LONGEST_LINE = 1 << 16

# The parent of a user's program, in one process group with it and what it starts. When its standard input
# ends, whoever started it is gone, however that ended: it ends the group, which a program that ignores
# signals or has left others behind would survive. Signals to the group are for the program, and it ends
# as the program does. Linux ends the program with it; the rest of POSIX does not offer that.
_GUARDIAN = """
import ctypes, os, select, signal, sys, threading, time
for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: None)
guardian = os.getpid()
end, kept_open = os.pipe()
program = os.fork()
if program == 0:
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    os.dup2(end, 0)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
        if os.getppid() != guardian:
            os._exit(1)
    try:
        os.execvp(sys.argv[1], sys.argv[1:])
    except OSError as error:
        os.write(2, f"{sys.argv[1]!r} cannot be started: {error.strerror}\\n".encode())
        os._exit(1)
def end_group():
    while os.read(0, 1024):
        pass
    os.killpg(0, signal.SIGTERM)
    time.sleep(PATIENCE)
    os.killpg(0, signal.SIGKILL)
watch = threading.Thread(target=end_group, daemon=True)
watch.start()
_, status = os.waitpid(program, 0)
if select.select([0], [], [], 0)[0]:
    watch.join()
code = os.waitstatus_to_exitcode(status)
if code >= 0:
    os._exit(code)
signal.signal(-code, signal.SIG_DFL) if -code != signal.SIGKILL else None
os.kill(guardian, -code)
""".replace("PATIENCE", str(_PROGRAM_ENDS_WITHIN_S))


class ChildCommand(Closing):
    """``zstate ARGUMENTS`` in a process of its own, which ends with this one, however that ends.

    With ``is_program`` ARGUMENTS are a command of the user's own instead, in ``folder``. Each line it says
    goes to ``on_line``, with whether it came on standard error, from a thread; ``on_end`` is called once it
    is gone and all its lines are heard. ``last_error`` is its last error, in one line.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        *,
        on_end: Callable[[ChildCommand], None],
        on_line: Callable[[str, bool], None] = lambda _, __: None,
        is_program: bool = False,
        folder: str | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name = name
        self.last_error = ""
        self._is_program = is_program
        own = ["-ISc", _GUARDIAN] if is_program else ["-m", "zstate", "--until-eof"]
        # A session of its own: Ctrl-C at the terminal reaches this process alone, which ends the others.
        self._process = subprocess.Popen(
            [sys.executable, *own, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
            cwd=folder,
            # Lines are to come when they are said.
            env={**os.environ, "PYTHONUNBUFFERED": "1", **(environment or {})},
        )
        self.pid = self._process.pid
        self._on_line = on_line
        self._on_end = on_end
        self._readers = [
            threading.Thread(target=read, name=f"zstate {name}", daemon=True)
            for read in (self._follow_lines, self._follow_errors)
        ]
        for thread in (*self._readers, threading.Thread(target=self._follow, daemon=True)):
            thread.start()

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self._process.poll()

    def close(self) -> None:
        """End it and wait for that, less than a second; a program of the user's has three."""
        self.ask_to_end()
        self.wait(time.monotonic() + END_WITHIN_S)

    def ask_to_end(self) -> None:
        """End it without waiting: as Ctrl-C does, for programs of the user's."""
        if self._process.poll() is None:
            self._signal(signal.SIGINT if self._is_program else signal.SIGTERM)

    def wait(self, deadline: float) -> None:
        """Wait until it has ended, which it was asked to, and make it end after ``deadline`` (monotonic)."""
        later_s = _PROGRAM_ENDS_WITHIN_S if self._is_program else 0.0
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()) + later_s)
        except subprocess.TimeoutExpired:
            self._signal(signal.SIGKILL)
            self._process.wait()

    def _signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            # The whole group: a shell does not hand signals on to what it runs.
            os.killpg(self.pid, number)

    def _follow(self) -> None:
        self._process.wait()
        # What it has started and left behind would hold its output open, and go on without it.
        self._signal(signal.SIGTERM)
        for reader in self._readers:
            reader.join(END_WITHIN_S)
        self._on_end(self)

    def _follow_lines(self) -> None:
        for line in _lines(self._process.stdout):
            self._on_line(line, False)

    def _follow_errors(self) -> None:
        for line in _lines(self._process.stderr):
            if line.strip():
                # What is indented goes on with what was said before it, as findings and Python's errors do.
                goes_on = line[0].isspace() and len(self.last_error) < _LONGEST_ERROR
                self.last_error = f"{self.last_error} {line.strip()}".strip() if goes_on else text_in(line)
                self._on_line(line, True)


def _lines(stream: IO[str] | None) -> Iterator[str]:
    """The lines of ``stream``, cut where they are too long: one without an end would fill the memory."""
    while stream is not None and (line := stream.readline(_LONGEST_LINE)):
        is_cut = len(line) == _LONGEST_LINE and not line.endswith("\n")
        yield f"{line} ... (cut at {_LONGEST_LINE} characters)" if is_cut else line.rstrip("\n")
        while is_cut and (rest := stream.readline(_LONGEST_LINE)) and not rest.endswith("\n"):
            pass


def end_with_parent() -> None:
    """End this process when its standard input does: whoever started it is gone."""

    main = threading.get_ident()

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 1024):
            pass
        # To the process, it could reach this thread, and the main thread would go on waiting.
        signal.pthread_kill(main, signal.SIGTERM)

    threading.Thread(target=watch, name="zstate parent", daemon=True).start()
