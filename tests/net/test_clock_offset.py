"""Clock offsets of writers, measured over real sessions."""

from __future__ import annotations

import time

import pytest
import zenoh
from helpers.processes import DEADLINE_S, find_free_port, until
from helpers.robots import RRBOT, STAMP, wait_for_stream_readers

from zstate.buffer.buffer import feed_of
from zstate.clock import ManualClock
from zstate.errors import Closed, InFuture, InPast, InvalidInput, Stale
from zstate.net.clock_offset import ClockOffsetMonitor, measure_offsets, unanswered
from zstate.net.queryable import Queryable, Reply
from zstate.net.service_thread import ServiceThread
from zstate.net.session import connect
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.wire.identity import WriterId
from zstate.wire.keys import WRITER_CLOCK
from zstate.wire.messages import ClockMessage
from zstate.wire.native import encode, encoding_of

MS = 1_000_000
SECOND = 1_000_000_000


class OffsetClock:
    """The system clock plus a constant offset."""

    domain = "system"

    def __init__(self, ahead_ns: int) -> None:
        self.ahead_ns = ahead_ns

    def now(self) -> int:
        return time.time_ns() + self.ahead_ns

    def wait_until(self, stamp, stop):
        raise NotImplementedError


@pytest.mark.parametrize("ahead_ns", [0, 1_200 * MS, -3_600 * SECOND])
def test_offset_error_is_at_most_half_the_round_trip(sessions, ahead_ns):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1", clock=OffsetClock(ahead_ns), program="driver"):
        (found,) = measure_offsets(reader, "r1", timeout_s=5.0)
    assert abs(found.offset_ns - ahead_ns) <= found.uncertainty_ns
    assert found.uncertainty_ns == found.round_trip_ns // 2
    assert (found.robot, found.writer.program) == ("r1", "driver")


def test_offset_is_measured_through_a_router():
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    with (
        connect(mode="router", listen=endpoint),
        connect(mode="client", endpoints=endpoint) as writer,
        connect(mode="client", endpoints=endpoint) as reader,
        StatePublisher(writer, RRBOT, "r1", clock=OffsetClock(SECOND)),
    ):
        (found,) = measure_offsets(reader, "*", timeout_s=5.0)
        assert abs(found.offset_ns - SECOND) <= found.uncertainty_ns


def test_offset_is_relative_to_the_clock_argument(sessions):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1", clock=ManualClock(10 * SECOND)):
        (found,) = measure_offsets(reader, "r1", clock=ManualClock(4 * SECOND), timeout_s=5.0)
    # Neither clock moves: the difference is half of the round trip.
    assert found.offset_ns == 6 * SECOND - found.uncertainty_ns


def test_each_writer_of_each_robot_has_its_own_offset(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1", clock=OffsetClock(SECOND)),
        StatePublisher(writer, RRBOT, "r2", clock=OffsetClock(2 * SECOND)),
        StatePublisher(writer, RRBOT, "r3", clock=ManualClock(0, "sim")),
    ):
        until(lambda: len(measure_offsets(reader, "*")) == 2)
        first, second = measure_offsets(reader, "*")
    assert (first.robot, second.robot) == ("r1", "r2")
    assert first.offset_ns < 1_500 * MS < second.offset_ns


def test_invalid_and_missing_replies_are_ignored(sessions):
    writer, reader = sessions
    key = "zstate/r1/@clock/unknown"
    queryable = writer.zenoh.declare_queryable(key, lambda query: query.reply(key, b"noon"))
    assert measure_offsets(reader, "r1", timeout_s=0.3) == ()
    queryable.undeclare()
    assert measure_offsets(reader, "r9", timeout_s=0.1) == ()


@pytest.mark.parametrize("session", [5, 6])
def test_reply_needs_the_key_and_the_session_of_its_writer(sessions, session):
    ours = WriterId("driver", "nuc", 3, 1, 5)
    key = WRITER_CLOCK.key("r1", ours.identity)
    payload = encode(ClockMessage(time.time_ns(), 0, session))
    answer = lambda query: query.reply(key, payload, encoding=encoding_of(ClockMessage))  # noqa: E731
    queryable = sessions[0].zenoh.declare_queryable(key, answer)
    found = measure_offsets(sessions[1], "r1", timeout_s=0.5)
    assert [one.writer for one in found] == ([ours] if session == 5 else [])
    queryable.undeclare()


def test_invalid_arguments_and_a_closed_session_are_refused(sessions):
    with pytest.raises(InvalidInput, match=r"timeout_s is 0.0; give a positive number of seconds"):
        measure_offsets(sessions[0], "r1", timeout_s=0.0)
    sessions[0].close()
    with pytest.raises(Closed):
        measure_offsets(sessions[0], "r1")


def test_clock_key_contains_robot_and_identity():
    assert WRITER_CLOCK.expression("*") == "zstate/*/@clock/*"
    assert WRITER_CLOCK.parse(WRITER_CLOCK.key("r1", "driver,host,1,2,3")) == ("r1", "driver,host,1,2,3")
    for other in ("zstate/r1/@writer/clock", "zstate/r1/tf", "r1/x/@clock/y"):
        with pytest.raises(InvalidInput, match="is not of the form"):
            WRITER_CLOCK.parse(other)


def test_failed_lookup_mentions_a_wrong_writer_clock(sessions):
    writer, reader = sessions
    clock = OffsetClock(1_200 * MS)
    with (
        TransformListener(reader, "r1") as listener,
        StatePublisher(writer, RRBOT, "r1", clock=clock, program="driver") as publisher,
    ):
        wait_for_stream_readers(writer, "r1")
        publisher.publish([0.0, 0.0])
        stamp = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S).stamp

        def refusal(at: int):
            return listener.buffer.explain("world", "tool", at)

        until(lambda: refusal(stamp + 1).clock_offset_ns is not None)
        for at, kind in ((stamp + 1, InFuture), (stamp - 1, InPast)):
            reason = refusal(at)
            assert type(reason) is kind
            assert abs(reason.clock_offset_ns - 1_200 * MS) <= reason.clock_uncertainty_ns
            assert "the clock of 'driver@" in str(reason)
            assert "' is 1.2 s ahead of this one (± " in str(reason)
        feed_of(listener.buffer).use_clock(ManualClock(stamp + 60 * SECOND))
        with pytest.raises(
            Stale, match=r"alive \(`zstate ls`\)\? the clock of 'driver@\S+ pid \d+' is 1\.2 s"
        ):
            listener.buffer.lookup("world", "tool", max_age_s=1.0)
        publisher.close()
        until(lambda: refusal(stamp + 1).clock_offset_ns is None)


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_failed_lookup_does_not_mention_a_correct_clock(sessions, follow):
    writer, reader = sessions
    with (
        TransformListener(reader, "r1", follow=follow) as listener,
        StatePublisher(writer, RRBOT, "r1") as publisher,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        publisher.publish([0.0, 0.0])
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)

        def refusal():
            publisher.publish([0.0, 0.0])  # until one of them comes after its writer was announced
            return listener.buffer.explain("world", "tool", time.time_ns() + SECOND)

        until(lambda: refusal().clock_offset_ns is not None)
        reason = refusal()
        assert abs(reason.clock_offset_ns) <= reason.clock_uncertainty_ns
        assert "the clock of" not in str(reason)


def test_reading_an_offset_often_measures_it_once(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1", clock=OffsetClock(SECOND)),
        ServiceThread(reader, "requests") as thread,
    ):
        monitor = ClockOffsetMonitor(reader, thread, OffsetClock(0))
        until(lambda: measure_offsets(reader, "r1"))
        (known,) = measure_offsets(reader, "r1")
        ask = monitor.watch("r1", known.writer)
        until(lambda: ask() is not None)
        first = ask()
        assert all(ask() is first for _ in range(1000))


def test_monitor_of_a_closed_session_returns_none(sessions):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1"), ServiceThread(reader, "requests") as thread:
        monitor = ClockOffsetMonitor(reader, thread, OffsetClock(0))
        until(lambda: measure_offsets(reader, "r1"))
        (known,) = measure_offsets(reader, "r1")
        reader.close()
        assert monitor.watch("r1", known.writer)() is None


def test_silent_writers_of_one_robot_do_not_delay_the_offset_of_another(sessions):
    writer, reader = sessions
    silent = [WriterId("p", "h", 1, 1, session) for session in range(100)]
    kept: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(10_000)
    queryable = writer.zenoh.declare_queryable("zstate/r2/@clock/*", kept)
    with (
        StatePublisher(writer, RRBOT, "r1", clock=OffsetClock(SECOND)),
        ServiceThread(reader, "requests") as thread,
    ):
        monitor = ClockOffsetMonitor(reader, thread, OffsetClock(0))
        until(lambda: measure_offsets(reader, "r1"))
        (known,) = measure_offsets(reader, "r1")
        for one in silent:
            monitor.watch("r2", one)
        until(queryable.handler.try_recv)
        ask = monitor.watch("r1", known.writer)
        until(lambda: ask() is not None)
        asked = 1
        while queryable.handler.try_recv() is not None:
            asked += 1
        assert asked < len(silent), "it has not waited for each of them"


def test_reply_of_another_writer_does_not_count(sessions):
    writer, reader = sessions
    asked, other = (WriterId("p", "h", 1, 1, session) for session in (7, 8))
    key = WRITER_CLOCK.key("r1", asked.identity)

    def answer(session: int) -> Reply:
        return Reply(encode(ClockMessage(STAMP, 0, session)), encoding_of(ClockMessage))

    with Queryable(writer, key, lambda _: answer(other.session)):
        assert measure_offsets(reader, "r1", timeout_s=0.3) == ()
    with Queryable(writer, key, lambda _: answer(asked.session)):
        until(lambda: [one.writer for one in measure_offsets(reader, "r1")] == [asked])


def test_a_query_that_no_writer_receives_is_told_from_one_that_times_out(sessions):
    writer, reader = sessions
    queries: list[zenoh.Query] = []  # received, and never answered
    frozen, absent = (
        WriterId(name, "host", 7, 0, number) for number, name in enumerate(("frozen", "absent"))
    )
    with StatePublisher(writer, RRBOT, "r1"):
        (measured,) = measure_offsets(reader, "r1", timeout_s=5.0)
        queryable = writer.zenoh.declare_queryable(WRITER_CLOCK.key("r1", frozen.identity), queries.append)
        querier = reader.zenoh.declare_querier(WRITER_CLOCK.key("r1", frozen.identity))
        until(lambda: querier.matching_status.matching)
        of_robot = {("r1", one) for one in (frozen, absent, measured.writer)}
        assert unanswered(reader, of_robot, 1.0) == {("r1", frozen): True, ("r1", absent): False}
    assert queries
    queryable.undeclare()
