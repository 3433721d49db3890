"""Queries with more replies than Zenoh's default channel holds, in real sessions on loopback."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest
import zenoh
from helpers.processes import DEADLINE_S, until
from helpers.tokens import current_tokens

from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.net import queryable
from zstate.net.discovery import RobotInfo, discover, discover_readers
from zstate.net.presence import WriterWatch, local_writer
from zstate.net.queryable import Tokens, query, query_tokens
from zstate.net.session import Session, connect
from zstate.net.writer import WireWriter, write_all
from zstate.nodes.static_publisher import StaticPublisher
from zstate.transform import Transform
from zstate.wire.identity import Announcement
from zstate.wire.keys import READER_TOKEN, WRITER_TOKEN
from zstate.wire.messages import StaticTransforms, to_block
from zstate.wire.registry import get_wire

MORE_THAN_THE_DEFAULT = 300  # Zenoh's default channel holds 256


def edge(parent: str, child: str) -> Transform:
    return Transform(parent, child, [1, 0, 0], [0, 0, 0, 1])


@contextmanager
def many_tokens(session: Session, count: int) -> Iterator[list[str]]:
    """Tokens of ``count`` robots, and of as many readers."""
    tokens = [
        key
        for number in range(count)
        for key in (
            WRITER_TOKEN.key(f"r{number}", "joint_states", local_writer(number).identity),
            READER_TOKEN.key(f"r{number}", "joint_states", local_writer(number).identity),
        )
    ]
    with ExitStack() as declared:
        for token in tokens:
            declared.callback(session.zenoh.liveliness().declare_token(token).undeclare)
        yield tokens


def test_more_tokens_than_the_default_channel_holds_are_discovered_in_the_session_that_announces_them():
    received: list[Announcement] = []
    with (
        connect() as session,
        many_tokens(session, MORE_THAN_THE_DEFAULT),
        WriterWatch(session, "*", lambda announced, _: received.append(announced)),
    ):
        assert len(discover(session)) == MORE_THAN_THE_DEFAULT
        assert len(discover_readers(session)) == MORE_THAN_THE_DEFAULT
        session.zenoh.put("zstate/r1/joint_states", b"")
        until(lambda: len(received) == MORE_THAN_THE_DEFAULT)


def test_more_tokens_than_the_default_channel_holds_are_discovered_in_a_watching_session(
    sessions: tuple[Session, Session],
):
    ours, theirs = sessions
    with many_tokens(theirs, MORE_THAN_THE_DEFAULT), WriterWatch(ours, "*", lambda *_: None):
        until(lambda: len(current_tokens(ours, "zstate/*/@writer/*/*", 1.0)) == MORE_THAN_THE_DEFAULT)
        assert len(discover(ours)) == MORE_THAN_THE_DEFAULT
        ours.zenoh.put("zstate/r1/joint_states", b"")


def test_one_session_has_more_static_writers_than_the_default_channel_holds():
    with connect() as session, ExitStack() as opened:
        for number in range(MORE_THAN_THE_DEFAULT):
            wire_writer = WireWriter(session, get_wire("native"), "r1", local_writer(number))
            latched = opened.enter_context(wire_writer).open_latched("tf_static", f"mount{number}")
            edges = (("base", f"camera{number}"),)
            write_all([latched], StaticTransforms(number, edges, to_block([1, 0, 0, 0, 0, 0, 1])))
        last = opened.enter_context(StaticPublisher(session, "r1", "last"))
        last.set(edge("camera0", "lens"))
        with pytest.raises(SecondWriter, match="camera299"):
            last.set(edge("camera0", "camera299"))
        (robot,) = discover(session)
        assert len(robot.named("tf_static")) == MORE_THAN_THE_DEFAULT + 1


def test_a_query_that_a_queryable_never_finishes_ends_with_its_timeout(sessions: tuple[Session, Session]):
    ours, theirs = sessions
    kept: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(8)
    queryable = theirs.zenoh.declare_queryable("zstate/r1/silent", kept)
    until(lambda: list(query(ours.zenoh, "zstate/r1/silent", 0.1)) or queryable.handler.try_recv())
    began = time.monotonic()
    errors = [
        reply.err and reply.err.payload.to_string() for reply in query(ours.zenoh, "zstate/r1/silent", 0.2)
    ]
    assert set(errors) == {"Timeout"}
    assert time.monotonic() - began >= 0.2


def test_closing_the_session_ends_a_query_that_waits(sessions: tuple[Session, Session]):
    ours, theirs = sessions
    kept: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(8)
    queryable = theirs.zenoh.declare_queryable("zstate/r1/silent", kept)
    until(lambda: list(query(ours.zenoh, "zstate/r1/silent", 0.1)) or queryable.handler.try_recv())
    waiting = threading.Thread(target=lambda: list(query(ours.zenoh, "zstate/r1/silent", 60.0)))
    waiting.start()
    until(queryable.handler.try_recv)
    ours.close()
    waiting.join(DEADLINE_S)
    assert not waiting.is_alive()


def test_replies_beyond_the_limit_are_counted_in_a_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(queryable, "MAX_REPLIES", 10)
    with connect() as session, many_tokens(session, 30), caplog.at_level(logging.WARNING, "zstate"):
        assert len(query_tokens(session.zenoh, "zstate/*/@writer/*/*", 1.0).keys) == 10
    (record,) = caplog.records
    assert "has 30 replies; only the first 10 are used" in record.getMessage()


def test_watch_loses_no_token_if_a_burst_overflows_its_ring(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zstate.net.presence.CAPACITY", 64)
    alive: set[Announcement] = set()
    may_go_on = threading.Event()

    def note(announced: Announcement, is_alive: bool) -> None:
        may_go_on.wait()
        (alive.add if is_alive else alive.discard)(announced)

    with connect() as writer, connect() as reader, WriterWatch(reader, "*", note):
        with many_tokens(writer, 300):
            until(lambda: len(current_tokens(reader, "zstate/*/@writer/*/*", 1.0)) == 300)
            may_go_on.set()
            until(lambda: len(alive) == 300)
        until(lambda: not alive)


def test_watch_keeps_the_writers_that_a_reply_lacks_which_was_cut_off(monkeypatch: pytest.MonkeyPatch):
    alive: set[str] = set()
    left: list[str] = []
    may_go_on = threading.Event()
    may_go_on.set()
    cut_off: list[Tokens] = []

    def note(announced: Announcement, is_alive: bool) -> None:
        (alive.add if is_alive else left.append)(announced.robot)
        may_go_on.wait()

    def query(*args: Any) -> Tokens:
        return cut_off.pop() if cut_off else query_tokens(*args)

    monkeypatch.setattr("zstate.net.presence.CAPACITY", 64)
    monkeypatch.setattr("zstate.net.presence.query_tokens", query)
    with ExitStack() as opened:
        writer, reader = opened.enter_context(connect()), opened.enter_context(connect())
        opened.enter_context(many_tokens(writer, 10))
        watch = opened.enter_context(WriterWatch(reader, "*", note))
        until(lambda: len(alive) == 10)
        may_go_on.clear()
        cut_off += [Tokens(frozenset(), is_complete=False)] * 3
        opened.enter_context(many_tokens(writer, 300))
        until(lambda: len(query_tokens(reader.zenoh, "zstate/*/@writer/*/*", 1.0).keys) == 310)
        may_go_on.set()
        until(lambda: len(alive) == 300)
        assert (watch.full_batches > 0, left, cut_off) == (True, [], [])


def test_failing_callback_does_not_affect_other_tokens(monkeypatch: pytest.MonkeyPatch):
    received: list[str] = []

    def note(announced: Announcement, is_alive: bool) -> None:
        if announced.robot == "r3":
            raise InvalidInput("r3")
        received.append(announced.robot)

    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    with connect() as session, many_tokens(session, 9), WriterWatch(session, "*", note) as follower:
        until(lambda: len(received) == 8 and follower.failures)
    assert len(raised) == 1


def test_a_closed_session_refuses_a_query():
    session = connect()
    session.close()
    with pytest.raises(Closed):
        current_tokens(session, "zstate/*/@writer/*/*", 1.0)


@pytest.mark.long
def test_robots_of_a_large_fleet_are_discovered_within_the_default_timeout():
    with connect() as session, connect() as asker, many_tokens(session, 2000):
        until(lambda: len(discover(asker)) == 2000)
        assert isinstance(discover(asker)[0], RobotInfo)
