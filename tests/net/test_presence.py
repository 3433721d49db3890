import os
import time
from contextlib import ExitStack

import pytest
from helpers.processes import Child, until
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import InvalidInput
from zstate.net.discovery import RobotInfo, discover, discover_readers
from zstate.net.presence import LivelinessToken, WriterWatch, announce, announce_reader, local_writer
from zstate.net.session import Session, connect
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import WRITER_TOKEN, check_writer
from zstate.wire.registry import get_wire

DRIVER = WriterId("arm driver", "jetson", 412, 5, 7)
CAMERA = WriterId("camera", "nuc", 9, 6, 8)

WRITER = """
    import sys
    from zstate.net.presence import announce, local_writer
    from zstate.net.session import connect
    from zstate.wire.keys import WRITER_TOKEN
    token = WRITER_TOKEN.key(sys.argv[1], "joint_states", local_writer(3, "driver").identity)
    with connect() as session, announce(session, token):
        print("announced")
        sys.stdin.readline()
"""


def announced(session: Session, robot: str, stream: StreamName, writer: WriterId) -> LivelinessToken:
    return announce(session, WRITER_TOKEN.key(robot, stream, writer.identity))


def test_writer_text_is_program_host_and_pid():
    assert str(WriterId("zstate-publish", "jetson", 412, 0, 0)) == "zstate-publish@jetson pid 412"


NAMES = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
WRITERS = st.builds(WriterId, *[NAMES] * 2, *[st.integers(0, 2**63 - 1)] * 2, st.integers(0, 2**64 - 1))


@given(WRITERS)
def test_every_identity_is_one_key_chunk_and_round_trips(writer: WriterId):
    assert check_writer(writer.identity) == writer.identity
    assert WriterId.parse(writer.identity) == writer


@pytest.mark.parametrize(
    "identity",
    [
        *("", "a", "a,b,c,d,e", "a,b,1,2", "a,b,1,2,3,4", "a,b,-1,2,3", "a,b,1_0,2,3"),
        *(f"a,b,{pid},1,1" for pid in ("1" * 5000, 2**63, "1" * 30, "01", "\u0661")),
        *(f"a,b,1,{since},1" for since in ("1" * 5000, 2**63, "1" * 30)),
        *(f"a,b,1,1,{session}" for session in ("1" * 5000, 2**64, "1" * 30)),
        *(f"{'a' * 256},b,1,1,1", f"a,{'b' * 256},1,1,1", f"{'%C3%BC' * 256},b,1,1,1", "a b,c,1,1,1"),
        *("*,b,1,1,1", "a%,b,1,1,1", "a%ff,b,1,1,1"),
    ],
)
def test_invalid_identity_is_refused(identity: str):
    with pytest.raises(InvalidInput):
        WriterId.parse(identity)


@given(st.from_regex(r"[\w.,-]{0,6}", fullmatch=True))
def test_token_contains_the_name_of_static_edges_if_there_is_one(name: str):
    announced = Announcement("r1", "tf_static", DRIVER, name)
    assert Announcement.parse("r1", "tf_static", check_writer(announced.identity)) == announced
    assert Announcement.parse("r1", "tf_static", DRIVER.identity).name == ""


@pytest.mark.parametrize("name", ["a/b", "line\nend", "\x1b[2J", "@writer", " "])
def test_token_with_an_invalid_static_name_is_foreign(name: str):
    with pytest.raises(InvalidInput):
        Announcement.parse("r1", "tf_static", Announcement("r1", "tf_static", DRIVER, name).identity)


def test_tokens_of_other_streams_have_no_name():
    with pytest.raises(InvalidInput):
        Announcement.parse("r1", "joint_states", f"{DRIVER.identity},mount")


def test_local_writer_has_program_host_and_pid_of_this_process():
    before = time.time_ns()
    writer = local_writer(7)
    assert (writer.pid, writer.session) == (os.getpid(), 7)
    assert before <= writer.since <= time.time_ns()
    assert writer.program
    assert local_writer(7, "driver").program == "driver"


def test_discover_returns_every_robot_with_its_writers_sorted():
    with (
        connect() as one,
        connect() as two,
        announced(one, "r2", "tf_static", CAMERA),
        announced(one, "r1", "tf_static", CAMERA),
        announced(two, "r1", "joint_states", DRIVER),
        connect() as asker,
    ):
        assert discover(asker) == (
            RobotInfo("r1", (("joint_states", DRIVER), ("tf_static", CAMERA))),
            RobotInfo("r2", (("tf_static", CAMERA),)),
        )


def test_discover_in_a_new_session_finds_other_processes(spawn):
    for robot in ("r1", "r2", "r3"):
        assert spawn(WRITER, robot).line() == "announced"
    with connect() as asker:
        assert [robot.name for robot in discover(asker)] == ["r1", "r2", "r3"]


def test_discover_without_robots_takes_its_timeout():
    with connect() as session:
        started = time.monotonic()
        assert discover(session, timeout_s=0.3) == ()
        assert time.monotonic() - started >= 0.3
        for timeout_s in (0.0, -1.0, float("nan"), float("inf"), 1e300):
            with pytest.raises(InvalidInput, match="timeout_s"):
                discover(session, timeout_s=timeout_s)


def test_readers_are_announced_separately_from_writers():
    with connect() as one, connect() as asker, ExitStack() as reading:
        wire = get_wire("native")
        for robot, streams in (("r1", ("tf", "tf_static")), ("*", ("tf",)), ("*", ("tf",))):
            for announcement in announce_reader(one, wire, robot, streams):
                reading.enter_context(announcement)
        readers = discover_readers(asker)
        assert [(reader.robot, reader.stream) for reader in readers] == [
            ("*", "tf"),
            ("*", "tf"),
            ("r1", "tf"),
            ("r1", "tf_static"),
        ]
        assert {reader.writer.pid for reader in readers} == {os.getpid()}
        assert discover(asker, timeout_s=0.1) == ()
        reading.close()
        until(lambda: not discover_readers(asker, timeout_s=0.1))


def test_foreign_tokens_are_ignored_and_counted():
    with connect() as stranger, connect() as session:
        tokens = [
            stranger.zenoh.liveliness().declare_token(f"zstate/r1/@writer/{rest}")
            for rest in ("joint_states/nonsense", "unknown_stream/a,b,1,2,3", "tf/a,b,1,2,x")
        ]
        with (
            announced(stranger, "r1", "tf", DRIVER),
            WriterWatch(session, "*", lambda *event: None) as follower,
        ):
            until(lambda: follower.foreign == 3)
            assert discover(session) == (RobotInfo("r1", (("tf", DRIVER),)),)
        for token in tokens:
            token.undeclare()


def test_writer_of_two_tokens_for_one_stream_leaves_with_the_last_of_them():
    events: list[tuple[str, bool]] = []
    with (
        connect() as writer,
        connect() as reader,
        WriterWatch(reader, "r1", lambda one, alive: events.append((one.stream, alive))),
    ):
        with announced(writer, "r1", "tf", DRIVER):
            until(lambda: events == [("tf", True)])
            with announce(writer, WRITER_TOKEN.key("r1", ["tf", "joint_states"], DRIVER.identity)):
                until(lambda: events[1:] == [("joint_states", True)])
            until(lambda: events[2:] == [("joint_states", False)])
        until(lambda: events[3:] == [("tf", False)])


def test_watch_reports_current_new_and_leaving_writers():
    events: list[tuple[Announcement, bool]] = []
    camera, driver = Announcement("r1", "tf", CAMERA), Announcement("r1", "joint_states", DRIVER)
    with (
        connect() as writer,
        connect() as reader,
        announced(writer, "r1", "tf", CAMERA),
        WriterWatch(reader, "r1", lambda *event: events.append(event)),
    ):
        until(lambda: (camera, True) in events)
        token = announced(writer, "r1", "joint_states", DRIVER)
        until(lambda: (driver, True) in events)
        with announced(writer, "r2", "tf", DRIVER):
            token.close()
            token.close()
            until(lambda: (driver, False) in events)
    assert {announced.robot for announced, _ in events} == {"r1"}


def test_watch_reports_a_killed_writer(spawn):
    events: list[tuple[Announcement, bool]] = []
    with connect() as reader, WriterWatch(reader, "*", lambda *event: events.append(event)):
        child: Child = spawn(WRITER, "r1")
        until(lambda: len(events) == 1)
        child.kill()
        until(lambda: len(events) == 2)
    (came, was_alive), (went, is_alive) = events
    assert came == went
    assert (was_alive, is_alive) == (True, False)
    assert (came.robot, came.stream) == ("r1", "joint_states")
    assert (came.writer.program, came.writer.pid) == ("driver", child.process.pid)
