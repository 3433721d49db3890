"""Programs that end without closing anything end with their own exit code."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import pytest
from helpers.processes import DEADLINE_S, ZENOH_CLOSE_S, Child

from zstate import Recording, SineSource, StatePublisher, connect, load_model


@pytest.fixture
def spawn(spawn: Callable[..., Child]) -> Callable[..., Child]:
    """Interpreters of their own: what an exit does depends on what was imported, and when."""
    return partial(spawn, is_forked=False)


PROGRAMS = {
    "listener": """
        listener = zstate.TransformListener(zstate.connect(), "rrbot")
        listener.buffer.lookup("world", "tool", timeout_s=60.0)
    """,
    "events and a watch": """
        seen = []
        listener = zstate.TransformListener(zstate.connect(), on_event=seen.append)
        watch = listener.buffer.watch("rrbot/world", "rrbot/tool", seen.append)
        listener.buffer.lookup("rrbot/world", "rrbot/tool", timeout_s=60.0)
    """,
    "asyncio": """
        import asyncio
        async def wait():
            listener = zstate.TransformListener(zstate.connect(), "rrbot", follow="tf")
            await listener.buffer.wait_async("world", "tool", timeout_s=60.0)
            return listener
        listener = asyncio.run(wait())
    """,
    "publishers in daemon threads": """
        session, model = zstate.connect(), zstate.load_model("rrbot")
        one = zstate.StatePublisher(session, model, f"one{os.getpid()}")
        two = zstate.StatePublisher(session, model, f"two{os.getpid()}")
        edges = zstate.StaticPublisher(session, f"two{os.getpid()}", "camera")
        edges.set(zstate.Transform("tool", "camera", [0, 0, 1], [0, 0, 0, 1]))
        def publish():
            while True:
                two.publish([0.1, 0.2])
                time.sleep(0.0005)
        threading.Thread(target=one.run, args=(zstate.SineSource(model), 1000.0), daemon=True).start()
        threading.Thread(target=publish, daemon=True).start()
        while not one.stats.sent: time.sleep(0.001)
    """,
    "Zenoh's own callbacks, channels and queryables": """
        import zenoh
        session, seen = zstate.connect(), []
        direct = zenoh.handlers.Callback(seen.append, indirect=False)
        ring = session.zenoh.declare_subscriber("zstate/**", zenoh.handlers.RingChannel(10))
        kept = [
            session.zenoh.declare_subscriber("zstate/**", seen.append),
            session.zenoh.declare_subscriber("zstate/**", direct),
            session.zenoh.declare_queryable("question", lambda query: query.reply("question", b"answer")),
        ]
        threading.Thread(target=lambda: [seen.append(one) for one in ring], daemon=True).start()
        list(session.zenoh.get("question", timeout=5.0))
        while len(seen) < 10: time.sleep(0.001)
    """,
    "connecting": """
        threading.Thread(target=zstate.connect, daemon=True).start()
    """,
}

ENDINGS = {
    "": 0,
    "sys.exit(3)": 3,
    "raise RuntimeError": 1,
    "os.kill(os.getpid(), signal.SIGINT); time.sleep(60.0)": -signal.SIGINT,
}

IN_A_CHILD = """
import multiprocessing, sys, zstate

def listen():
    listener = zstate.TransformListener(zstate.connect(), "rrbot")
    listener.buffer.lookup("world", "tool", timeout_s=60.0)
    sys.exit(3)

if __name__ == "__main__":
    child = multiprocessing.get_context(sys.argv[1]).Process(target=listen)
    child.start()
    child.join()
    sys.exit(child.exitcode)
"""

WITH_A_FROZEN_READER = """
    import os, sys, time, zenoh, zstate
    session = zstate.connect()
    publisher = session.zenoh.declare_publisher("k", congestion_control=zenoh.CongestionControl.DROP)
    listener = zstate.TransformListener(session)
    while not publisher.matching_status.matching: time.sleep(0.001)
    print("matched")
    sys.stdin.readline()
    for _ in range(2000): publisher.put(bytes(10_000))
    print("ending")
    sys.exit(3)
"""


@pytest.fixture
def rrbot(rendezvous: str) -> Iterator[None]:
    """A robot that is published during the whole exit of a program."""
    model = load_model("rrbot")
    with connect() as session, StatePublisher(session, model) as publisher:
        running = threading.Thread(target=publisher.run, args=(SineSource(model), 500.0))
        running.start()
        yield
        publisher.close()
        running.join()


def program(body: str, ending: str, *, in_function: bool) -> str:
    """The source of a program. Objects opened in a function may be freed before the program ends."""
    body = textwrap.dedent(body)
    if in_function:
        body = f"def main():\n{textwrap.indent(body, '    ')}\nmain()\n"
    return f"import os, signal, sys, threading, time, zstate\n{body}\n{ending}"


def some_endings(row: int) -> list[int]:
    """Two endings, one of a program in a function and one at the top; neighbours share one of them."""
    return [row % 4, (row + 1) % 4]


@pytest.mark.usefixtures("rrbot")
@pytest.mark.parametrize(
    ("name", "endings"),
    [
        *((name, some_endings(row)) for row, name in enumerate(PROGRAMS)),
        *(pytest.param(name, range(4), marks=pytest.mark.soak) for name in PROGRAMS),
    ],
)
@pytest.mark.long
def test_program_that_closes_nothing_keeps_its_exit_code(spawn, name: str, endings: Sequence[int]):
    children: list[tuple[Child, int]] = []
    for number in endings:
        ending, code = list(ENDINGS.items())[number]
        children.append((spawn(program(PROGRAMS[name], ending, in_function=number % 2 == 0)), code))
    for child, code in children:
        assert (child.wait(4 * DEADLINE_S), child.stderr.count("FATAL")) == (code, 0), child.stderr


@pytest.mark.usefixtures("rrbot")
@pytest.mark.parametrize("method", ["spawn", "forkserver", "fork"])
def test_multiprocessing_child_keeps_its_exit_code(tmp_path: Path, method: str):
    script = tmp_path / "listening.py"
    script.write_text(IN_A_CHILD)
    done = subprocess.run(
        [sys.executable, script, method], capture_output=True, text=True, timeout=4 * DEADLINE_S, check=False
    )
    assert (done.returncode, done.stderr) == (3, "")


@pytest.mark.usefixtures("rrbot")
def test_unclosed_recording_is_complete_after_exit(spawn, tmp_path: Path):
    body = """
        from zstate.recording.recorder import Recorder
        recorder = Recorder(zstate.connect(), sys.argv[1], "rrbot")
        while not recorder.stats.messages: time.sleep(0.001)
    """
    child: Child = spawn(program(body, "sys.exit(3)", in_function=True), str(tmp_path / "run.mcap"))
    assert (child.wait(4 * DEADLINE_S), child.stderr) == (3, "")
    with Recording(tmp_path / "run.mcap") as recording:
        assert recording.robots == ("rrbot",)


@pytest.mark.usefixtures("rrbot")
def test_program_that_closes_nothing_prints_nothing_at_exit(spawn):
    child: Child = spawn(program(PROGRAMS["publishers in daemon threads"], "", in_function=False))
    assert (child.wait(4 * DEADLINE_S), child.stderr) == (0, "")


@pytest.mark.usefixtures("rrbot")
def test_listener_works_while_python_joins_threads_and_in_atexit_functions(spawn):
    body = """
        import atexit
        listener = zstate.TransformListener(zstate.connect(), "rrbot")
        buffer = listener.buffer
        def next_stamp():
            return buffer.wait("world", "tool", buffer.latest("world", "tool") + 1, timeout_s=60.0).stamp
        def work():
            threading.main_thread().join()
            for _ in range(20): next_stamp()
            print("worked")
        def last():
            next_stamp()
            print("looked again")
        atexit.register(last)
        buffer.wait("world", "tool", timeout_s=60.0)
        threading.Thread(target=work).start()
    """
    child: Child = spawn(program(body, "sys.exit(3)", in_function=False))
    assert (child.wait(4 * DEADLINE_S), child.stderr) == (3, "")
    assert [child.line(), child.line()] == ["worked", "looked again"]


def test_atexit_function_may_close_the_session(spawn):
    child: Child = spawn("""
        import atexit, zstate
        session = zstate.connect()
        atexit.register(session.close)
    """)
    assert (child.wait(4 * DEADLINE_S), child.stderr) == (0, "")


def test_connect_raises_while_the_process_ends(spawn):
    child: Child = spawn("""
        import atexit
        @atexit.register
        def too_late():
            try:
                zstate.connect()
            except zstate.ZStateError as error:
                print(error)
        import zstate
        session = zstate.connect()
    """)
    assert (child.wait(4 * DEADLINE_S), child.stderr) == (0, "")
    assert "this process is ending" in child.line()


def test_exit_with_a_frozen_reader_does_not_wait_until_zenoh_gives_it_up(spawn):
    reader: Child = spawn("""
        import sys, zenoh, zstate
        with zstate.connect() as session:
            inbox = session.zenoh.declare_subscriber("k", zenoh.handlers.RingChannel(1))
            print("ready")
            sys.stdin.readline()
    """)
    reader.line()
    child: Child = spawn(WITH_A_FROZEN_READER)
    assert child.line() == "matched"
    reader.freeze()
    child.send_line()
    assert child.line() == "ending"
    began = time.monotonic()
    assert child.wait() == 3
    assert time.monotonic() - began < ZENOH_CLOSE_S
