"""Ownership of streams, over real sessions on loopback."""

from __future__ import annotations

import pickle
import threading
import time
from collections import deque
from dataclasses import replace
from datetime import datetime, timedelta
from types import SimpleNamespace

import pytest
import zenoh
from helpers.processes import new_threads, until
from helpers.tokens import current_tokens

from zstate.errors import Closed, SecondWriter
from zstate.net.edge_ownership import check_edges
from zstate.net.ownership import TOKEN_EXPIRY_S, WriterClaim
from zstate.net.presence import announce
from zstate.net.session import Session, connect
from zstate.nodes.static_publisher import StaticPublisher
from zstate.streams import StreamName
from zstate.transform import Transform
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import WRITER_TOKEN

FIRST = WriterId("driver", "jetson", 412, 1_000_000_000, 7)
SECOND = WriterId("simulator", "laptop", 9, 2_000_000_000, 8)
THIRD = WriterId("twin", "laptop", 10, 3_000_000_000, 9)


def announcement(
    writer: WriterId, stream: StreamName = "joint_states", name: str = "", robot: str = "r1"
) -> Announcement:
    return Announcement(robot, stream, writer, name)


def announced(session: Session, content: Announcement):
    return announce(session, WRITER_TOKEN.key(content.robot, content.stream, content.identity))


def await_tokens(session: Session, count: int) -> None:
    until(lambda: len(current_tokens(session, "zstate/*/@writer/*/*", 1.0)) == count)


def edge(parent: str, child: str) -> Transform:
    return Transform(parent, child, [1, 0, 0], [0, 0, 0, 1])


def test_second_writer_error_names_the_first_writer_its_start_and_takeover(sessions):
    ours, theirs = sessions
    start = (datetime.now() - timedelta(days=3)).astimezone()
    first = replace(FIRST, since=int(start.timestamp()) * 10**9)
    with announced(theirs, announcement(first)):
        await_tokens(ours, 1)
        with pytest.raises(SecondWriter, match="joint_states of 'r1'") as raised:
            WriterClaim(ours, [announcement(SECOND)])
    started = f"started {start:%Y-%m-%d %H:%M:%S} (3.0 days ago)"
    assert f"'driver@jetson pid 412', {started}, already writes joint_states of 'r1'" in str(raised.value)
    assert "takeover=True" in str(raised.value)
    error = pickle.loads(pickle.dumps(raised.value))
    assert (error.robot, error.stream, error.first, error.edge) == ("r1", "joint_states", first, None)


def test_second_writer_is_refused_even_with_an_earlier_start_time(sessions):
    ours, theirs = sessions
    with announced(theirs, announcement(SECOND)):
        await_tokens(ours, 1)
        with pytest.raises(SecondWriter):
            WriterClaim(ours, [announcement(FIRST)])


@pytest.mark.parametrize(
    "other",
    [
        announcement(FIRST, "tf"),
        announcement(FIRST, robot="r2"),
        announcement(FIRST, "tf_static", "mount"),
        announcement(FIRST, "tf_static"),  # the form before static writers had names
    ],
)
def test_writers_of_other_streams_do_not_conflict(sessions, other):
    ours, theirs = sessions
    with announced(theirs, other):
        await_tokens(ours, 1)
        with WriterClaim(ours, [announcement(SECOND), announcement(SECOND, "tf_static", "room")]) as claim:
            claim.check()


def test_static_edges_under_one_name_have_one_writer(sessions):
    ours, theirs = sessions
    with announced(theirs, announcement(FIRST, "tf_static", "mount")):
        await_tokens(ours, 1)
        with pytest.raises(SecondWriter, match="static edges of 'r1' under the name 'mount'"):
            WriterClaim(ours, [announcement(SECOND, "tf_static", "mount")])


def test_claim_waits_for_a_leaving_writer(sessions):
    ours, theirs = sessions
    leaving = announced(theirs, announcement(FIRST))
    await_tokens(ours, 1)
    timer = threading.Timer(TOKEN_EXPIRY_S / 5, leaving.close)
    timer.start()
    WriterClaim(ours, [announcement(SECOND)]).close()
    timer.join()


@pytest.mark.parametrize("asks_first", [True, False])
def test_simultaneous_writers_only_the_later_one_is_refused_and_stays_refused(sessions, asks_first):
    ours, theirs = sessions
    first, second = WriterClaim(ours, [announcement(FIRST)]), WriterClaim(theirs, [announcement(SECOND)])
    with announced(ours, announcement(FIRST)), announced(theirs, announcement(SECOND)):
        for session in sessions:
            await_tokens(session, 2)
        for claim in (first, second) if asks_first else (second, first):
            if claim is first:
                claim.check()
            else:
                with pytest.raises(SecondWriter) as raised:
                    claim.check()
                assert raised.value.first == FIRST
        first.check()
    await_tokens(theirs, 0)
    with pytest.raises(SecondWriter):
        second.check()
    first.close()
    second.close()


def test_new_session_sees_existing_writers():
    with connect() as theirs, announced(theirs, announcement(FIRST)):
        for _ in range(3):
            with connect() as ours, pytest.raises(SecondWriter):
                WriterClaim(ours, [announcement(SECOND)])


def test_claim_needs_no_thread_and_a_check_is_cheaper_than_a_claim(sessions):
    before = threading.enumerate()
    began = time.thread_time()
    claims = [WriterClaim(sessions[0], [announcement(SECOND, robot=f"r{number}")]) for number in range(100)]
    opened = time.thread_time()
    for claim in claims:
        claim.check()
    checked = time.thread_time()
    assert not new_threads(before)
    assert checked - opened < opened - began
    for claim in claims:
        claim.close()


def test_token_that_comes_during_a_check_is_read_by_the_next_one(sessions):
    """Zenoh's thread may report it between the last change that a check reads and the time of the next."""
    ours, theirs = sessions
    key = WRITER_TOKEN.key("r1", "joint_states", FIRST.identity)

    class Changes(deque[tuple[str, zenoh.SampleKind]]):
        """The first writer comes when a check has read all changes."""

        def __bool__(self) -> bool:
            if len(self) or not latecomers:
                return len(self) > 0
            claim._on_token(latecomers.pop())
            return False

    latecomers: list[zenoh.Sample] = []
    with WriterClaim(ours, [announcement(SECOND)]) as claim, announced(theirs, announcement(THIRD)):
        claim.check()
        until(lambda: claim.check() or claim._rivals)
        # A second later the writer is established: then checks are rare.
        claim._established_at = 0.0
        claim._changes, claim._next_check_s = Changes(), 0.0
        latecomers.append(SimpleNamespace(key_expr=key, kind=zenoh.SampleKind.PUT))  # type: ignore[arg-type]
        claim.check()
        assert not latecomers
        assert claim._next_check_s == 0.0
        claim.check()
        assert {rival.writer for rival in claim._rivals} == {FIRST, THIRD}


def test_check_on_a_closed_session_raises_closed(sessions):
    claim = WriterClaim(sessions[0], [announcement(FIRST)])
    sessions[0].close()
    with pytest.raises(Closed):
        claim.check()
    claim.close()


@pytest.mark.parametrize("robot", ["r1", "r2"])
def test_frame_conflict_error_has_the_edge_and_its_writer(sessions, robot):
    ours, theirs = sessions
    with StaticPublisher(theirs, robot, "mount", program="calibration") as mount:
        mount.set(edge("hall/tool", "hall/camera"))
        await_tokens(ours, 1)
        with pytest.raises(SecondWriter, match="'hall/camera' on 'hall/tool' already, as 'mount'") as raised:
            check_edges(ours, announcement(SECOND, "tf_static", "room"), [("hall/table", "hall/camera")])
        assert raised.value.edge == ("hall/tool", "hall/camera")
        assert raised.value.first.program == "calibration"
        check_edges(ours, announcement(SECOND, "tf_static", "room"), [("hall/tool", "hall/laser")])
        mount.withdraw("hall/camera")
        until(lambda: not is_placed(ours))


def is_placed(session: Session) -> bool:
    try:
        check_edges(session, announcement(SECOND, "tf_static", "room"), [("hall/table", "hall/camera")])
    except SecondWriter:
        return True
    return False


def test_writer_of_the_frames_robot_overrides_another_robots_claim(sessions):
    ours, theirs = sessions
    with StaticPublisher(theirs, "r2", "mount") as mount:
        mount.set(edge("r1/tool", "r1/camera"))
        await_tokens(ours, 1)
        check_edges(ours, announcement(SECOND, "tf_static", "room"), [("r1/table", "r1/camera")])
