"""Helpers for tests of commands: commands in this process and as processes, and a robot that stands still."""

from __future__ import annotations

import fcntl
import logging
import os
import pty
import shlex
import signal
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import click.formatting
import pytest
from click.testing import CliRunner
from helpers.fork_server import ForkedProcess, server
from helpers.processes import DEADLINE_S, ZENOH_CLOSE_S, Child, until

from zstate import StatePublisher, Transform, TransformListener, connect, discover, load_model
from zstate.cli.main import _end, run
from zstate.cli.output import logs
from zstate.clock import Clock
from zstate.streams import StreamName

RRBOT = str(Path(__file__).parents[2] / "models" / "rrbot.urdf")
ALL_STREAMS: tuple[StreamName, ...] = ("joint_states", "tf", "tf_static", "robot_description")
SHOULDER, ELBOW = 0.5, -0.2

_ROVER = """
from zstate import connect
from zstate.odometry.cli.rover import run_rover
with connect() as session:
    run_rover(session, 100.0)
"""

MAIN = "from zstate.cli.main import main; main()"
"""The program ``zstate``, as code."""

_IMPORTS = {"view": ("zstate.view.server",), "foxglove": ("zstate.foxglove.server",)}
"""What takes a second to import, by command."""

Spawn = Callable[..., Child]
T = TypeVar("T")


@dataclass(frozen=True)
class Ended:
    """A command that has ended: its exit code and what it wrote."""

    code: int
    stdout: str
    stderr: str


class Command:
    """A command in this process, for a thread beside it: what it has written so far, and its end."""

    def __init__(self, stdout: Callable[[], str], stderr: Callable[[], str]) -> None:
        self._stdout, self._stderr = stdout, stderr
        self._lines_read = 0
        self._is_over = threading.Event()

    @property
    def stdout(self) -> str:
        return self._stdout()

    @property
    def stderr(self) -> str:
        return self._stderr()

    def line(self, timeout_s: float = DEADLINE_S) -> str:
        """The next line of its output."""
        deadline = time.monotonic() + timeout_s
        while (text := self.stdout).count("\n") <= self._lines_read:
            assert not self.is_over(0.002), "it has ended"
            assert time.monotonic() < deadline, f"silent for {timeout_s} s"
        self._lines_read += 1
        return text.split("\n")[self._lines_read - 1]

    def is_over(self, timeout_s: float = DEADLINE_S) -> bool:
        """Waits for its end; returns whether it has come."""
        return self._is_over.wait(timeout_s)

    def end(self) -> None:
        """Called when it has ended: its streams are about to be closed."""
        stdout, stderr = self.stdout, self.stderr
        self._stdout, self._stderr = (lambda: stdout), (lambda: stderr)
        self._is_over.set()


def run_cli(*arguments: str, stdin: bytes = b"") -> Ended:
    """Run a command that ends by itself, in this process; what it changes in the process is restored.

    Standard input and output are no terminals, whatever those of the tests are. For the main thread, as
    commands are. What the command has written is in the notes of an exception that it does not handle.
    """
    return _run(arguments, stdin, lambda _: None)


def _run(arguments: Sequence[str], stdin: bytes, on_start: Callable[[Command], object]) -> Ended:
    """``on_start`` is called before the command, in this thread."""
    assert threading.current_thread() is threading.main_thread(), "one command at a time; see run_process"
    library = logging.getLogger("zstate")
    before = library.handlers.copy(), library.level, library.propagate
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    with pytest.MonkeyPatch.context() as restored, CliRunner().isolation(stdin) as (stdout, stderr, _):
        restored.setattr(sys, "argv", ["zstate", *arguments])
        # The width of help is that of a pipe, neither that of the tests' terminal nor click's for tests.
        restored.setattr(sys, "__stdout__", sys.stdout)
        restored.setattr(click.formatting, "FORCED_WIDTH", None)
        restored.setattr(sys, "excepthook", sys.excepthook)
        restored.setattr(threading, "excepthook", threading.excepthook)
        restored.setattr(logs._Settings, "format", "text")
        restored.setenv(logs.FORMAT_VARIABLE, os.environ.get(logs.FORMAT_VARIABLE, ""))

        def written(stream: BytesIO) -> str:
            sys.stdout.flush()
            sys.stderr.flush()
            return stream.getvalue().decode()

        command = Command(lambda: stdout.getvalue().decode(), lambda: stderr.getvalue().decode())
        try:
            logs.use_environment_format()
            on_start(command)
            code = run(arguments)
        except BaseException as error:
            error.add_note(f"zstate {shlex.join(arguments)} wrote:\n{written(stdout)}{written(stderr)}")
            raise
        finally:
            library.handlers[:], library.propagate = before[0], before[2]
            library.setLevel(before[1])
            for number, handler in handlers.items():
                signal.signal(number, handler)
            command.end()
        return Ended(int(code), written(stdout), written(stderr))


def run_until(find: Callable[[], T | None], *arguments: str, after: str = "\n") -> tuple[Ended, T]:
    """Run a command that goes on until Ctrl-C, in this process; it gets that once ``find()`` returns a value.

    Returns the end of the command, whose exit code must be 130, and the value. ``find`` is called in another
    thread, once the command has written ``after``, by default a line.
    """
    found: list[T] = []

    def look(command: Command) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not found and time.monotonic() < deadline and not command.is_over(0.005):
            has_begun = after in command.stdout or after in command.stderr
            if has_begun and (value := find()) is not None:
                found.append(value)

    ended = _run_beside(look, arguments)
    assert found, f"nothing within {DEADLINE_S} s: {ended}"
    assert ended.code == 130, ended
    return ended, found[0]


def run_watched(watch: Callable[[Command], object], *arguments: str, code: int = 130) -> Ended:
    """Run a command in this process while ``watch(command)`` runs in another thread; then it gets Ctrl-C.

    Its exit code must be ``code``, which is that of a command that has ended by itself before, if so.
    """
    ended = _run_beside(watch, arguments)
    assert ended.code == code, ended
    return ended


def _run_beside(watch: Callable[[Command], object], arguments: Sequence[str]) -> Ended:
    """Ctrl-C must end the command before Zenoh gives up a neighbour, without a traceback."""
    failures: list[Exception] = []
    interrupted_at: list[float] = []

    def follow(command: Command) -> None:
        try:
            watch(command)
        except Exception as failure:
            failure.add_note(f"zstate {shlex.join(arguments)} wrote:\n{command.stdout}{command.stderr}")
            failures.append(failure)
        if not command.is_over(0.0):
            interrupted_at.append(time.monotonic())
            os.kill(os.getpid(), signal.SIGINT)

    threads: list[threading.Thread] = []

    def start(command: Command) -> None:
        threads.append(threading.Thread(target=follow, args=(command,)))
        threads[0].start()

    before = signal.signal(signal.SIGINT, _end)  # as in main()
    try:
        ended = _run(arguments, b"", start)
    finally:
        ended_at = time.monotonic()
        for thread in threads:
            thread.join()
        signal.signal(signal.SIGINT, before)
    if failures:
        raise failures[0]
    assert all(ended_at - instant < ZENOH_CLOSE_S for instant in interrupted_at)
    assert "Traceback" not in ended.stderr
    return ended


def found_pose(listener: TransformListener, target: str, source: str) -> Transform | None:
    """The newest pose, if the listener has one."""
    is_known = listener.buffer.can_lookup(target, source)
    return listener.buffer.lookup(target, source) if is_known else None


def run_process(*arguments: str, stdin: bytes = b"") -> Ended:
    """Run a command that ends by itself, as a process: for what is only seen there, such as its exit."""
    command = [sys.executable, "-m", "zstate", *arguments]
    ended = subprocess.run(command, input=stdin, capture_output=True, timeout=DEADLINE_S, check=False)
    return Ended(ended.returncode, ended.stdout.decode(), ended.stderr.decode())


def failure(*arguments: str, code: int = 1, stdin: bytes = b"") -> str:
    """The message of a command that must fail."""
    ended = run_cli(*arguments, stdin=stdin)
    assert ended.code == code, ended
    return ended.stderr


@contextmanager
def missing_library(name: str) -> Iterator[None]:
    """An interpreter that cannot import ``name``."""
    with pytest.MonkeyPatch.context() as restored:
        for module in [*sys.modules]:
            if module == name or module.startswith(f"{name}."):
                restored.delitem(sys.modules, module)
        restored.setitem(sys.modules, name, None)
        yield


def started(spawn: Spawn, *arguments: str) -> Child:
    """A command that runs until it is stopped: a process, forked from one that has imported zstate."""
    imports = _IMPORTS.get(arguments[0], ())
    return spawn(MAIN, *arguments, imports=imports)


def start_rover(spawn: Spawn) -> None:
    """Start the hardware of `zstate demo rover`, on the test's network, and wait until it is announced."""
    spawn(_ROVER)
    with connect() as session:
        until(lambda: any(one.name == "rover" and one.named("imu") for one in discover(session)))


@contextmanager
def in_terminal(*arguments: str, columns: int = 80) -> Iterator[tuple[ForkedProcess, int]]:
    """A command in a terminal: its process, and the descriptor that writes to it and reads from it."""
    keyboard, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    with pytest.MonkeyPatch.context() as environment:
        environment.delenv("COLUMNS", raising=False)
        process = server().start(MAIN, *arguments, terminal=terminal)
    os.close(terminal)
    try:
        yield process, keyboard
    finally:
        process.kill()
        process.wait(DEADLINE_S)
        os.close(keyboard)


def interrupted(child: Child) -> None:
    """Send Ctrl-C: it must exit before Zenoh gives up a neighbour, with code 130 and no traceback."""
    began = time.monotonic()
    child.process.send_signal(signal.SIGINT)
    assert child.wait() == 130
    assert time.monotonic() - began < ZENOH_CLOSE_S
    assert "Traceback" not in child.stderr


@contextmanager
def published_robot(
    robot: str = "rrbot",
    positions: Sequence[float] = (SHOULDER, ELBOW),
    *,
    streams: Sequence[StreamName] = ALL_STREAMS,
    velocities: Sequence[float] | None = None,
    model: str = RRBOT,
    wire: str = "native",
    router: str = "",
    clock: Clock | None = None,
) -> Iterator[StatePublisher]:
    """Publishes a robot that stands still, a hundred times a second, behind ``router`` if that is set."""
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.01):
            publisher.publish(positions, velocities)

    with (
        connect(mode="client", endpoints=router) if router else connect() as session,
        StatePublisher(session, load_model(model), robot, (wire,), streams=streams, clock=clock) as publisher,
    ):
        thread = threading.Thread(target=publish)
        thread.start()
        try:
            yield publisher
        finally:
            stop.set()
            thread.join()
