"""Publishers, listeners and routers in separate processes."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, Child, until
from helpers.robots import RRBOT

from zstate.buffer.frame_tree import FrameInfo
from zstate.model.kinematics import Kinematics
from zstate.net.session import connect
from zstate.nodes.listener import TransformListener
from zstate.sources import SineSource

pytestmark = pytest.mark.processes

PUBLISHER = """
    import sys
    from zstate import SineSource, StatePublisher, connect, load_model
    model = load_model("rrbot")
    try:
        with (
            connect(**eval(sys.argv[2])) as session,
            StatePublisher(session, model, sys.argv[1]) as publisher,
        ):
            print("publishing")
            publisher.run(SineSource(model), rate_hz=200.0)
    except KeyboardInterrupt:
        print("interrupted")
"""
LISTENER = """
    import json, sys
    from zstate import TransformListener, connect
    try:
        with connect(**eval(sys.argv[1])) as session, TransformListener(session) as listener:
            print("listening")
            for line in sys.stdin:
                robot, after = line.split()
                at = None if after == "now" else int(after)
                pose = listener.buffer.wait(f"{robot}/world", f"{robot}/tool", at, timeout_s=10.0)
                print(json.dumps([pose.stamp, pose.kind, pose.pose7.tolist()]))
            print("done")
    except KeyboardInterrupt:
        print("interrupted")
"""
WAITER = """
    from zstate import TransformListener, connect
    try:
        with connect() as session, TransformListener(session) as listener:
            print("waiting")
            listener.buffer.wait("world", "tool", timeout_s=600.0)
    except KeyboardInterrupt:
        print("interrupted")
"""
ROUTER = """
    import sys, threading
    from zstate import connect
    try:
        with connect(mode="router", listen=sys.argv[1]):
            print("routing")
            threading.Event().wait()
    except KeyboardInterrupt:
        print("interrupted")
"""
UNREACHABLE = """
    import sys
    from zstate import ZStateError, connect
    try:
        connect(mode="client", endpoints=sys.argv[1], timeout_s=0.5)
    except ZStateError as error:
        print(isinstance(error, TimeoutError), error)
"""
PEER = "{}"
KINEMATICS = Kinematics(RRBOT)
TOOL = RRBOT.links.index("tool")


def started(child: Child) -> Child:
    """The child, after its first line."""
    assert child.line() in ("publishing", "listening", "waiting", "routing"), child.stderr
    return child


def ask(listener: Child, robot: str = "r1", after: str = "now") -> int:
    """The stamp of a lookup; its pose is checked against the known sine."""
    listener.send_line(f"{robot} {after}")
    stamp, kind, pose7 = json.loads(listener.line())
    assert kind == "exact"
    expected = KINEMATICS.link_poses(SineSource(RRBOT).read(stamp).positions)[TOOL]
    same_sign = np.array(pose7) * np.r_[1, 1, 1, np.full(4, np.sign(np.dot(pose7[3:], expected[3:])))]
    assert np.allclose(same_sign, expected, rtol=0, atol=1e-12)
    return stamp


def interrupt(child: Child) -> None:
    """Ctrl-C ends the child without other output."""
    child.process.send_signal(signal.SIGINT)
    code = child.process.wait(2.0 * DEADLINE_S)
    assert (code, child.line()) == (0, "interrupted")
    child.wait()
    assert child.stderr == ""


def test_processes_of_one_host_connect_without_configuration_in_any_order(spawn):
    early = started(spawn(LISTENER, PEER))
    publisher = started(spawn(PUBLISHER, "r1", PEER))
    late = started(spawn(LISTENER, PEER))
    for listener in (early, late):
        first = ask(listener)
        assert ask(listener) >= first
    for child in (late, publisher, early):
        interrupt(child)


def test_clients_exchange_samples_through_a_router_process(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    client = repr({"mode": "client", "endpoints": endpoint})
    router = started(spawn(ROUTER, endpoint))
    early = started(spawn(LISTENER, client))
    publisher = started(spawn(PUBLISHER, "r1", client))
    late = started(spawn(LISTENER, client))
    for listener in (early, late):
        assert ask(listener) > 0
    for child in (publisher, early, late, router):
        interrupt(child)


def test_processes_end_at_ctrl_c_after_the_router_died(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    client = repr({"mode": "client", "endpoints": endpoint})
    router = started(spawn(ROUTER, endpoint))
    publisher, listener = started(spawn(PUBLISHER, "r1", client)), started(spawn(LISTENER, client))
    ask(listener)
    router.kill()
    interrupt(publisher)
    interrupt(listener)


def test_clients_continue_after_their_router_restarts(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    client = repr({"mode": "client", "endpoints": endpoint})
    router = started(spawn(ROUTER, endpoint))
    started(spawn(PUBLISHER, "r1", client))
    listener = started(spawn(LISTENER, client))
    ask(listener)
    router.kill()
    started(spawn(ROUTER, endpoint))
    restarted = time.time_ns()
    with connect(mode="client", endpoints=endpoint) as session, TransformListener(session) as fresh:
        fresh.buffer.wait("world", "tool", timeout_s=10.0)
    until(lambda: ask(listener) >= restarted)


def test_one_buffer_holds_two_robots_of_two_processes(spawn):
    for robot in ("r1", "r2"):
        started(spawn(PUBLISHER, robot, PEER))
    listener = started(spawn(LISTENER, PEER))
    assert ask(listener, "r1") > 0
    assert ask(listener, "r2") > 0


def test_restarted_publisher_is_received_again_and_other_robots_are_unaffected(spawn):
    with connect() as session, TransformListener(session) as listener:
        buffer = listener.buffer
        killed = started(spawn(PUBLISHER, "r1", PEER))
        started(spawn(PUBLISHER, "r2", PEER))
        for robot in ("r1", "r2"):
            buffer.wait(f"{robot}/world", f"{robot}/tool", timeout_s=10.0)

        def lower(robot: str) -> FrameInfo:
            return next(frame for frame in buffer.frames() if frame.name == f"{robot}/lower")

        oldest = lower("r2").oldest
        killed.kill()
        killed_at = time.time_ns()
        again = started(spawn(PUBLISHER, "r1", PEER))
        # A new epoch for r1: no sample of the old writer is kept, although the history is 10 s.
        until(lambda: (lower("r1").oldest or 0) > killed_at, timeout_s=5.0)
        # All samples of r2 are kept; earlier ones may have been back-filled since.
        assert 0 < (lower("r2").oldest or 0) <= (oldest or 0)
        until(lambda: f"pid {again.process.pid}" in (lower("r1").writer or ""))
        stats = listener.stats
        assert (stats.late, stats.refused) == (0, {})
        assert listener.robots() == ("r1", "r2")


def test_wait_for_a_missing_robot_can_be_interrupted(spawn):
    child = started(spawn(WAITER))
    # Python loses a signal between its last check and the wait itself, which is not tested here.
    stat = Path(f"/proc/{child.process.pid}/stat")
    sleeping: list[bool] = []
    until(
        lambda: sleeping.append(") S " in stat.read_text()) or (len(sleeping) >= 20 and all(sleeping[-20:]))
    )
    interrupt(child)


@pytest.mark.parametrize("frozen", ["publisher", "listener"])
def test_frozen_process_does_not_block_others(spawn, frozen: str):
    publisher = started(spawn(PUBLISHER, "r1", PEER))
    listener = started(spawn(LISTENER, PEER))
    ask(listener)
    children = {"publisher": publisher, "listener": listener}
    children.pop(frozen).freeze()
    (other,) = children.values()
    interrupt(other)


def test_unreachable_router_error_is_one_line_with_the_remedy(spawn, free_port: int):
    child = spawn(UNREACHABLE, f"tcp/127.0.0.1:{free_port}")
    message = child.line()
    assert message.startswith(f"True nothing answers at 'tcp/127.0.0.1:{free_port}'")
    assert "zstate router" in message
    assert (child.wait(), child.stderr) == (0, "")
