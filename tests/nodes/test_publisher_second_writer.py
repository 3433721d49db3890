"""Two that write the same, as real processes and in one."""

from __future__ import annotations

import time
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import ExitStack

import pytest
from helpers.processes import DEADLINE_S, find_free_port, until
from helpers.robots import RRBOT
from helpers.tokens import current_tokens
from msgspec.structs import replace

from zstate.errors import InvalidInput, SecondWriter
from zstate.ingest.diagnostics import WriterEvent
from zstate.net.presence import announce
from zstate.net.session import Session, connect
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.sources import SineSource
from zstate.stream_registry import is_named
from zstate.transform import Transform
from zstate.wire.identity import WriterId
from zstate.wire.keys import WRITER_TOKEN, stream_key
from zstate.wire.messages import JointState, RobotDescription, order_digest
from zstate.wire.native import encode, encoding_of

WRITER = """
    import sys
    from zstate import SineSource, StatePublisher, connect, load_model
    model = load_model("rrbot")
    with connect() as session, StatePublisher(session, model, "r1", program="driver") as publisher:
        publisher.publish([0.0, 0.0])
        print("writing", flush=True)
        publisher.run(SineSource(model), 100.0)
"""

# Rounds: "go" opens it, on a network that it has just joined; it writes until it is refused or stopped.
RIVAL = """
    import select, sys
    from zstate import StatePublisher, connect, load_model
    from zstate.errors import SecondWriter
    model = load_model("rrbot")
    print("ready", flush=True)
    while sys.stdin.readline():
        try:
            with connect() as session, StatePublisher(session, model, "r1") as publisher:
                while not select.select([sys.stdin], [], [], 0.002)[0]:
                    publisher.publish([0.0, 0.0])
                publisher.publish([0.0, 0.0])
                sys.stdin.readline()
            print("survived", flush=True)
        except SecondWriter as error:
            print("refused by", error.first.pid, flush=True)
"""


def writers_seen(session: Session) -> int:
    return len(current_tokens(session, "zstate/r1/@writer/$*joint_states$*/*", 1.0))


def edge(child: str) -> Transform:
    return Transform("base", child, [1, 0, 0], [0, 0, 0, 1])


def test_second_process_is_refused_with_the_name_of_the_first_which_continues(spawn, sessions):
    first = spawn(WRITER)
    first.line()
    with TransformListener(sessions[1], "r1", history_on_join=False) as listener:
        second = spawn(WRITER)
        assert second.wait() == 1
        assert "driver@" in second.stderr
        assert f"pid {first.process.pid}'" in second.stderr
        assert "already writes joint_states of 'r1'" in second.stderr
        received = listener.stats.received
        until(lambda: listener.stats.received > received)
        assert listener.stats.refused == {}
        assert "conflict" not in {event.kind for event in listener.events()}


def test_publisher_can_be_restarted_at_once_after_kill_9(spawn):
    for _ in range(3):
        writer = spawn(WRITER)
        assert writer.line() == "writing"
        writer.kill()


@pytest.mark.parametrize("same_session", [True, False])
def test_publisher_can_be_reopened_at_once_after_close(sessions, same_session):
    for number in range(5):
        session = sessions[0 if same_session else number % 2]
        with StatePublisher(session, RRBOT, "r1") as publisher:
            publisher.publish([0.0, 0.0])


@pytest.mark.processes
def test_exactly_one_of_two_simultaneous_processes_survives_each_of_20_times(spawn):
    rivals = [spawn(RIVAL), spawn(RIVAL)]
    for rival in rivals:
        rival.line()
    with ThreadPoolExecutor(2) as pool:
        for _ in range(20):
            for rival in rivals:
                rival.send_line("go")
            answer = {pool.submit(rival.line): rival for rival in rivals}
            (refused, *_), others = wait(answer, return_when=FIRST_COMPLETED)
            (winner,) = [rival for rival in rivals if rival is not answer[refused]]
            assert refused.result() == f"refused by {winner.process.pid}"
            assert others
            winner.send_line("end")
            assert others.pop().result() == "survived"


@pytest.mark.parametrize("later_publishes_first", [True, False])
def test_later_publisher_ends_when_two_networks_are_joined(later_publishes_first):
    endpoints = [f"tcp/127.0.0.1:{find_free_port()}" for _ in range(2)]
    with ExitStack() as opened:
        ours, theirs = (opened.enter_context(connect(listen=endpoint)) for endpoint in endpoints)
        first = opened.enter_context(StatePublisher(ours, RRBOT, "r1"))
        second = opened.enter_context(StatePublisher(theirs, RRBOT, "r1"))
        for publisher in (first, second):
            publisher.publish([0.0, 0.0])
        opened.enter_context(connect(endpoints=endpoints))
        for session in (ours, theirs):
            until(lambda s=session: writers_seen(s) == 2)
        if not later_publishes_first:
            first.publish([0.0, 0.0])
        with pytest.raises(SecondWriter) as raised:
            second.run(SineSource(RRBOT), 100.0)
        assert raised.value.first.session == first.description().session
        # With it went all that late joiners would have been given by it.
        until(lambda: writers_seen(ours) == 1)
        with pytest.raises(SecondWriter):
            second.publish([0.0, 0.0])
        first.publish([0.0, 0.0])


@pytest.mark.parametrize("stream", ["joint_states", "robot_description", "partial_joint_states"])
def test_token_of_an_earlier_start_ends_no_running_publisher_until_its_holder_publishes(
    sessions, monkeypatch: pytest.MonkeyPatch, stream
):
    monkeypatch.setattr("zstate.net.ownership._STARTUP_S", 0.0)
    ours, theirs = sessions
    stranger = WriterId("stranger", "laptop", 9, 1, 99)
    with StatePublisher(ours, RRBOT, "r1") as publisher:
        for _ in range(2):
            publisher.publish([0.0, 0.0])
        with announce(theirs, WRITER_TOKEN.key("r1", stream, stranger.identity)):
            until(lambda: len(current_tokens(ours, WRITER_TOKEN.expression("r1"), 1.0)) == 2)
            looked_until = time.monotonic() + 0.3
            while time.monotonic() < looked_until:
                publisher.publish([0.0, 0.0])
            description = replace(publisher.description(), session=stranger.session)
            state = JointState(1, 0, stranger.session, order_digest(RRBOT.joint_names), bytes(16))
            answer = description if stream == "robot_description" else state
            # The token has no name, so it leaves open on which key its holder publishes.
            key = stream_key("r1", stream, "any" if is_named(stream) else "")
            with pytest.raises(SecondWriter) as raised:
                until(lambda: put(theirs, key, answer) or publisher.publish([0.0, 0.0]))
    assert raised.value.first == stranger


def put(session: Session, key: str, message: JointState | RobotDescription) -> None:
    session.zenoh.put(key, encode(message), encoding=encoding_of(type(message)))


def test_streams_of_a_robot_may_have_separate_writers(sessions):
    with (
        StatePublisher(sessions[0], RRBOT, "r1", streams=["joint_states"]) as joints,
        StatePublisher(sessions[1], RRBOT, "r1", streams=["tf", "tf_static", "robot_description"]) as rest,
        StaticPublisher(sessions[1], "r1", "mount"),
        StatePublisher(sessions[1], RRBOT, "r2"),
    ):
        for session in sessions:
            until(lambda s=session: len(current_tokens(s, "zstate/*/@writer/*/*", 1.0)) == 4)
        for publisher in (joints, rest):
            publisher.publish([0.0, 0.0])
        with pytest.raises(SecondWriter) as raised:
            StatePublisher(sessions[0], RRBOT, "r1", streams=["tf"])
    assert raised.value.stream == "tf"


def test_takeover_makes_listeners_use_the_newest_writer_and_log_once(sessions):
    reported: list[WriterEvent] = []
    with (
        TransformListener(sessions[1], "r1", on_event=reported.append) as listener,
        StatePublisher(sessions[0], RRBOT, "r1", streams=["joint_states"], program="driver") as first,
    ):
        until(lambda: [event.kind for event in reported] == ["joined"])
        with StatePublisher(
            sessions[1], RRBOT, "r1", streams=["joint_states"], program="simulator", takeover=True
        ) as second:
            until(lambda: listener.stats.refused.get("second writer", 0) >= 200 or fought(first, second))
            assert [event.kind for event in reported] == ["joined", "joined", "conflict"]
        until(lambda: reported[-1].kind == "left")
    conflict = reported[2]
    assert "simulator@" in conflict.text
    assert "driver@" in conflict.text
    assert conflict.writer is not None
    assert conflict.writer.program == "simulator"


def fought(*publishers: StatePublisher) -> None:
    for publisher in publishers:
        publisher.publish([0.0, 0.0])


def test_ros_wire_allows_several_static_writers(sessions):
    with (
        StatePublisher(sessions[0], RRBOT, "r1", ("ros2",)),
        StatePublisher(sessions[1], RRBOT, "r1", ("ros2",)) as second,
        StaticPublisher(sessions[0], "r1", "mount", "ros2") as mount,
        StaticPublisher(sessions[1], "r1", "mount", "ros2") as again,
    ):
        second.publish([0.0, 0.0])
        mount.set(edge("camera"))
        again.set(edge("camera"))


def test_edge_of_another_static_writer_is_refused_and_not_published(sessions):
    with (
        StaticPublisher(sessions[0], "r1", "mount", program="calibration") as mount,
        StaticPublisher(sessions[1], "r2", "room") as room,
        TransformListener(sessions[1], "*") as listener,
    ):
        mount.set(edge("camera"))
        listener.buffer.wait("r1/base", "r1/camera", timeout_s=DEADLINE_S)
        with pytest.raises(SecondWriter) as raised:
            room.set(Transform("r2/base", "r1/camera", [2, 0, 0], [0, 0, 0, 1]))
        assert raised.value.first.program == "calibration"
        assert raised.value.edge == ("r1/base", "r1/camera")
        with pytest.raises(InvalidInput, match="its edges: none"):
            room.withdraw("r1/camera")
        mount.set(edge("camera"))  # its own it may replace
        room.set(edge("laser"))
        mount.withdraw("camera")
        until(lambda: not listener.buffer.can_lookup("r1/base", "r1/camera"))
        room.set(Transform("r2/base", "r1/camera", [2, 0, 0], [0, 0, 0, 1]))
        listener.buffer.wait("r2/base", "r1/camera", timeout_s=DEADLINE_S)


def test_takeover_of_an_edge_is_reported_to_listeners(sessions):
    with (
        TransformListener(sessions[1], "r1") as listener,
        StaticPublisher(sessions[0], "r1", "mount") as mount,
        StaticPublisher(sessions[0], "r1", "room", takeover=True) as room,
    ):
        mount.set(edge("camera"))
        listener.buffer.wait("base", "camera", timeout_s=DEADLINE_S)
        for _ in range(20):
            room.set(edge("camera"))
        until(lambda: [event.kind for event in listener.events()].count("conflict") == 1)
        room.set(edge("laser"))
        listener.buffer.wait("base", "laser", timeout_s=DEADLINE_S)
        assert [event.kind for event in listener.events()].count("conflict") == 1


def test_second_static_writer_of_one_name_is_refused(sessions):
    with StaticPublisher(sessions[0], "r1", "mount"):
        until(lambda: current_tokens(sessions[1], "zstate/r1/@writer/$*tf_static$*/*", 1.0))
        with pytest.raises(SecondWriter, match="under the name 'mount'"):
            StaticPublisher(sessions[1], "r1", "mount")
        StaticPublisher(sessions[1], "r2", "mount").close()
        StaticPublisher(sessions[1], "r1", "mount", takeover=True).close()
