"""Processes that fork, and processes that open and close many sessions."""

from __future__ import annotations

import json
import re

import pytest
from helpers.fault_processes import TESTS, Start, assert_no_growth, client
from helpers.processes import DEADLINE_S

pytestmark = pytest.mark.processes

FORKING = """
    import json, multiprocessing, os, select, sys, threading, time
    from zstate import JointStateListener, PartialStatePublisher, SimulatedClock, SineSource, StatePublisher
    from zstate import Transform, TransformListener, TransformPublisher, connect, discover, load_model
    from zstate.errors import Closed, LookupFailed
    from zstate.recording.recorder import Recorder

    with (
        connect(**json.loads(sys.argv[1])) as session,
        StatePublisher(session, load_model("rrbot"), "r1") as publisher,
        TransformPublisher(session, "r1", "odometry") as odometry,
        TransformListener(session, "r1") as listener,
        JointStateListener(session, "r1") as joints,
        PartialStatePublisher(session, load_model("rrbot"), ["elbow"], "r3") as part,
        SimulatedClock(session) as clock,
    ):
        odom = [Transform("odom", "world", (0, 0, 0), (0, 0, 0, 1))]
        odometry.publish(odom)
        buffer, model = listener.buffer, publisher.model
        running = threading.Thread(target=publisher.run, args=(SineSource(model), 2000.0), daemon=True)
        running.start()
        buffer.wait("world", "tool", timeout_s=10.0)

        def refused(action):
            try:
                action()
            except Closed as closed:
                return "fork" in str(closed) and "connect()" in str(closed)
            return False

        def waits_fail():
            began, errors = time.monotonic(), []
            far = buffer.latest("world", "tool") + 10**12
            for lookup in (buffer.lookup, buffer.wait):
                for frames in (("world", "tool"), ("world", "nowhere")):
                    try:
                        lookup(*frames, far, timeout_s=60.0)
                    except LookupFailed as failed:
                        errors.append(str(failed))
            return (
                len(errors) == 4
                and time.monotonic() - began < 60.0  # the timeout of each
                and all(f"belongs to process {os.getppid()} and does not run after" in one for one in errors)
                and not any("wait for it" in one for one in errors)
            )

        def in_child(write_fd):
            results = [
                refused(lambda: session.zenoh),
                refused(lambda: publisher.publish([0.0, 0.0])),
                refused(lambda: odometry.publish(odom)),
                refused(lambda: part.publish([0.0])),
                refused(lambda: publisher.run(SineSource(model), 100.0)),
                refused(lambda: list(joints)),
                refused(lambda: joints.read(0)),
                not clock.wait_until(1, threading.Event()),
                refused(lambda: StatePublisher(session, model, "r2")),
                refused(lambda: TransformPublisher(session, "r2")),
                refused(lambda: TransformListener(session, "r2")),
                refused(connect),
                refused(lambda: discover(session)),
                refused(lambda: buffer.watch("world", "tool", print)),
                refused(lambda: Recorder(session, "never.mcap")),
                waits_fail(),
                buffer.lookup("world", "tool").stamp > 0,
            ]
            for one in (clock, joints, part, listener, odometry, publisher, session):
                one.close()
            os.write(write_fd, (json.dumps(results) + "\\n").encode())

        def ends_by_itself(pid):
            ended, _, _ = select.select([os.pidfd_open(pid)], [], [], 10.0)
            if not ended:
                os.kill(pid, 9)
            status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            return status if ended else "hangs"

        def receives_samples():
            return buffer.wait("world", "tool", buffer.latest("world", "tool") + 1, timeout_s=5.0).stamp > 0

        for way in ["os.fork", "multiprocessing"] * int(sys.argv[2]):
            read_fd, write_fd = os.pipe()
            if way == "multiprocessing":
                child = multiprocessing.get_context("fork").Process(target=in_child, args=(write_fd,))
                child.start()
                child.join(10.0)
                code = "hangs" if child.exitcode is None else child.exitcode
            else:
                pid = os.fork()
                if pid == 0:
                    in_child(write_fd)
                    sys.exit(0)
                code = ends_by_itself(pid)
            os.close(write_fd)
            results = json.loads(os.read(read_fd, 1000) or b"null")
            odometry.publish(odom)
            print(json.dumps([way, results, code, receives_samples()]))
    print("closed")
"""

STARTING = """
    import json, sys, time
    sys.path.insert(0, sys.argv[3])
    from helpers.fault_programs import resource_counts
    from zstate import StatePublisher, TransformListener, connect, load_model

    model, options, counts = load_model("rrbot"), json.loads(sys.argv[1]), []

    def once():
        with (
            connect(**options) as session,
            StatePublisher(session, model, "r1") as publisher,
            TransformListener(session, "r1") as listener,
        ):
            publisher.publish([0.1, 0.2])
            listener.buffer.wait("world", "tool", timeout_s=10.0)

    for _ in range(10):
        once()
    before, began = resource_counts(), time.monotonic()
    for _ in range(int(sys.argv[2])):
        once()
    print(json.dumps([before, resource_counts(), time.monotonic() - began]))
"""


@pytest.mark.parametrize("rounds", [1, pytest.param(5, marks=pytest.mark.soak)])
@pytest.mark.parametrize("mode", ["client", "peer"])
def test_forked_child_gets_an_error_naming_connect_and_affects_no_other_process(
    spawn, start: Start, endpoint: str, mode: str, rounds: int
):
    start("router", listen=endpoint)
    child = spawn(FORKING, json.dumps(client(endpoint) if mode == "client" else {}), str(rounds))
    for _ in range(2 * rounds):
        way, refusals, code, receives_samples = json.loads(child.line(30.0))
        assert (refusals, code, receives_samples) == ([True] * 17, 0, True), way
    assert child.line() == "closed"
    assert child.wait() == 0
    assert not re.search("Traceback|panicked", child.stderr)


UNCLOSED = """
    from zstate import Transform, TransformPublisher, connect
    odometry = TransformPublisher(connect(), "r1", "odometry")
    odometry.publish([Transform("odom", "base", (0, 0, 0), (0, 0, 0, 1))])
    print("published")
"""


def test_writer_of_transforms_that_exits_without_close_releases_its_name_and_edges(spawn):
    for _ in range(2):
        child = spawn(UNCLOSED)
        assert child.wait() == 0
        assert (child.line(), child.stderr) == ("published", "")


@pytest.mark.parametrize(
    ("way", "count"),
    [
        ("client", 30),
        ("peer", 15),
        pytest.param("client", 200, marks=pytest.mark.soak),
        pytest.param("peer", 50, marks=pytest.mark.soak),
    ],
)
def test_starts_and_stops_leave_no_resources_behind(spawn, start: Start, endpoint: str, way: str, count: int):
    start("router", listen=endpoint)
    child = spawn(STARTING, json.dumps(client(endpoint) if way == "client" else {}), str(count), TESTS)
    before, after, seconds = json.loads(child.line(6 * DEADLINE_S))
    print(f"{count} starts as {way}: {before} grew to {after} in {seconds:.1f} s")
    assert_no_growth(before, after, rss_kb=15_000)
    assert child.wait() == 0
    assert child.stderr == ""
