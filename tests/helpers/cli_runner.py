"""Helpers for tests of commands: commands as real processes, and a robot that stands still."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from helpers.processes import DEADLINE_S, SOON_S, Child

from zstate import StatePublisher, connect, load_model
from zstate.clock import Clock
from zstate.wire.keys import Stream

RRBOT = str(Path(__file__).parents[2] / "models" / "rrbot.urdf")
ALL_STREAMS: tuple[Stream, ...] = ("joint_states", "tf", "tf_static", "robot_description")
SHOULDER, ELBOW = 0.5, -0.2

ROVER = """
from zstate import connect
from zstate.cli.rover import run_rover
with connect() as session:
    print("ready")
    run_rover(session, 100.0)
"""
"""The program with the hardware of `zstate demo rover`, on the test's network."""

Spawn = Callable[..., Child]


def zstate(*arguments: str, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    """A command that ends by itself."""
    command = [sys.executable, "-m", "zstate", *arguments]
    return subprocess.run(command, input=stdin, capture_output=True, timeout=DEADLINE_S, check=False)


def failure(*arguments: str, code: int = 1, stdin: bytes = b"") -> str:
    """The message of a command that must fail, without a traceback."""
    ended = zstate(*arguments, stdin=stdin)
    message = ended.stderr.decode()
    assert ended.returncode == code, (ended.returncode, ended.stdout, message)
    assert "Traceback" not in message
    return message


def started(spawn: Spawn, *arguments: str) -> Child:
    """A command that runs until it is stopped."""
    return spawn("from zstate.cli.main import main; main()", *arguments)


def interrupted(child: Child) -> None:
    """Send Ctrl-C: it must exit within a second, with code 130 and no traceback."""
    began = time.monotonic()
    child.process.send_signal(signal.SIGINT)
    assert child.wait() == 130
    assert time.monotonic() - began < SOON_S
    assert "Traceback" not in child.stderr


@contextmanager
def published_robot(
    robot: str = "rrbot",
    positions: Sequence[float] = (SHOULDER, ELBOW),
    *,
    streams: Sequence[Stream] = ALL_STREAMS,
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
