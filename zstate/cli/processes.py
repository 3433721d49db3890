"""Calls in background threads, and child processes. Ctrl-C interrupts every wait for them at once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import IO, Generic, TypeVar

from zstate._util.closeable import Closeable
from zstate.cli.output.logs import text_in
from zstate.cli.signals import Ending
from zstate.clock import wait_interruptible

Result = TypeVar("Result")

END_WITHIN_S = 0.8
_PROGRAM_ENDS_WITHIN_S = 3.0
_LONGEST_ERROR = 500

_LONGEST_LINE = 1 << 16

# Parent of a user's program, in one process group with the program and its children. When its standard input
# ends, zstate has exited, for whatever reason: it kills the group, because a program that ignores signals
# or leaves children behind would survive. It ignores signals to the group, which are for the program, and
# exits with the program's status. On Linux the kernel kills the program with it; POSIX has no such feature.
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


class BackgroundCall(Generic[Result]):
    """A call of ``work`` in a daemon thread. Signals interrupt only the main thread, which waits for it."""

    def __init__(self, name: str, work: Callable[[], Result]) -> None:
        self._outcome: Future[Result] = Future()
        self._is_done = threading.Event()

        def run() -> None:
            try:
                self._outcome.set_result(work())
            except BaseException as error:  # raised again by result(), also SystemExit of a library
                self._outcome.set_exception(error)
            finally:
                self._is_done.set()

        threading.Thread(target=run, name=name, daemon=True).start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it has ended, at most ``timeout_s`` [s]; whether it has."""
        return wait_interruptible(self._is_done, timeout_s)

    def result(self, timeout_s: float | None = None) -> Result:
        """The value that ``work`` returned, or its exception. Raises TimeoutError after ``timeout_s``."""
        if not self.wait(timeout_s):
            raise TimeoutError(f"the work took longer than {timeout_s} s")
        return self._outcome.result()


@contextmanager
def orderly_exit(within_s: float = _PROGRAM_ENDS_WITHIN_S) -> Generator[Callable[[], None]]:
    """A signal raises SignalExit in the block, once; later ones are ignored for ``within_s``.

    After that time a signal ends the process at once. The block calls what is yielded before it stops what
    must not go on: from there no signal interrupts it. For the main thread.
    """
    ends_at: float | None = None
    ending = Ending()

    def begin_end() -> None:
        nonlocal ends_at
        ends_at = ends_at or time.monotonic()
        ending.close()

    def on_signal(number: int, _: object) -> None:
        nonlocal ends_at
        if ends_at is None:
            ends_at = time.monotonic()
            ending.begin(number)
        if not ending.is_repeated(number) and time.monotonic() - ends_at > within_s:
            os._exit(128 + number)

    before = {one: signal.signal(one, on_signal) for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield begin_end
    finally:
        ending.close()
        for number, handler in before.items():
            signal.signal(number, handler)


class ChildProcess(Closeable):
    """``zstate ARGUMENTS`` in a child process, which exits with this one, however this one exits.

    With ``is_program`` ARGUMENTS are a user's command instead, run in ``folder``. ``on_line(text, is_error)``
    is called for each line of output, from a thread; ``on_end(self)`` after it has exited and all its lines
    were passed on. ``last_error`` is its last error message, in one line.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        *,
        on_end: Callable[[ChildProcess], None],
        on_line: Callable[[str, bool], None] = lambda _, __: None,
        is_program: bool = False,
        folder: str | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name = name
        self.last_error = ""
        self._is_program = is_program
        # Code of the user takes its time: that of a program, and of the driver inside `zstate drive`.
        self._later_s = _PROGRAM_ENDS_WITHIN_S if is_program or arguments[0] == "drive" else 0.0
        own = ["-ISc", _GUARDIAN] if is_program else ["-m", "zstate", "--until-eof"]
        # A session of its own: Ctrl-C at the terminal reaches this process alone, which stops its children.
        self._process = subprocess.Popen(
            [sys.executable, *own, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
            cwd=folder,
            # Unbuffered: each line arrives when it is printed.
            env={**os.environ, "PYTHONUNBUFFERED": "1", **(environment or {})},
        )
        self.pid = self._process.pid
        self._on_line = on_line
        self._on_end = on_end
        self._readers = [
            threading.Thread(target=self._read, args=output, name=f"zstate {name}", daemon=True)
            for output in ((self._process.stdout, False), (self._process.stderr, True))
        ]
        self._follower = threading.Thread(target=self._follow, daemon=True)
        for thread in (*self._readers, self._follower):
            thread.start()

    @property
    def exit_code(self) -> int | None:
        """The exit code; None while it runs."""
        return self._process.poll()

    def close(self) -> None:
        """Stop it and wait, less than 1 s; a user's program or driver gets 3 s more."""
        self.request_exit()
        self.wait(time.monotonic() + END_WITHIN_S)

    def request_exit(self) -> None:
        """Request its exit without waiting: SIGTERM, or SIGINT for a user's program."""
        if self._process.poll() is None:
            self._signal(signal.SIGINT if self._is_program else signal.SIGTERM)

    def wait(self, deadline: float) -> None:
        """Wait for its exit and its last lines.

        It is killed after ``deadline`` (monotonic), a user's program or driver 3 s later.
        """
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()) + self._later_s)
        except subprocess.TimeoutExpired:
            self._signal(signal.SIGKILL)
            self._process.wait()
        if threading.current_thread() is not self._follower:
            self._follower.join(END_WITHIN_S)

    def _signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            # The whole group: a shell does not forward signals to its children.
            os.killpg(self.pid, number)

    def _follow(self) -> None:
        self._process.wait()
        # Children that it left behind would hold its output open and run on.
        self._signal(signal.SIGTERM)
        for reader in self._readers:
            reader.join(END_WITHIN_S)
        self._on_end(self)

    def _read(self, stream: IO[str] | None, is_error: bool) -> None:
        for line in _lines(stream):
            if is_error and not line.strip():
                continue
            if is_error:
                # An indented line continues the one before, as in findings and Python's tracebacks.
                goes_on = line[0].isspace() and len(self.last_error) < _LONGEST_ERROR
                self.last_error = f"{self.last_error} {line.strip()}".strip() if goes_on else text_in(line)
            self._on_line(line, is_error)


def _lines(stream: IO[str] | None) -> Iterator[str]:
    """The lines of ``stream``, cut at ``_LONGEST_LINE``: an endless line would fill the memory."""
    while stream is not None and (line := stream.readline(_LONGEST_LINE)):
        is_cut = len(line) == _LONGEST_LINE and not line.endswith("\n")
        yield f"{line} ... (cut at {_LONGEST_LINE} characters)" if is_cut else line.rstrip("\n")
        while is_cut and (rest := stream.readline(_LONGEST_LINE)) and not rest.endswith("\n"):
            pass


def end_with_parent() -> None:
    """Exit when standard input ends: the parent process has exited."""

    main = threading.get_ident()

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 1024):
            pass
        # A signal to the process could be delivered to this thread, and the main thread would keep waiting.
        signal.pthread_kill(main, signal.SIGTERM)

    threading.Thread(target=watch, name="zstate parent", daemon=True).start()
