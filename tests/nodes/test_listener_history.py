"""Who joins now looks up the last seconds, as if it had been there."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, Child, until
from helpers.robots import RRBOT, STAMP, SampleCollector, kinematic_pose, wait_for_stream_readers

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InPast, InvalidInput
from zstate.model.load import load_model
from zstate.net.presence import announce
from zstate.net.requests import Requests
from zstate.net.sample_history import HistoryRequest, SampleCache, serve_history
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session, connect
from zstate.nodes.listener import TransformListener
from zstate.nodes.lookup_service import RecentBuffer
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.sources import SineSource
from zstate.transform import Transform
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.messages import JointState, order_digest, to_block
from zstate.wire.native import encode, encoding_of
from zstate.wire.protocol import SerializedSample

MS = 1_000_000
PERIOD = 10 * MS
PAST_NS = 500 * MS
JOINTS = "zstate/r1/joint_states"
ROUTER = """
    import sys
    from zstate.net.session import connect
    with connect(mode="router", listen=sys.argv[1]):
        print("up")
        sys.stdin.readline()
"""


def positions(number: int) -> list[float]:
    return [0.01 * number, 0.25 - 0.003 * number]


def publish(publisher: StatePublisher, first: int, end: int, stamp: int = STAMP) -> None:
    for number in range(first, end):
        publisher.publish(positions(number), stamp=stamp + number * PERIOD)


def has_samples(listener: TransformListener, *numbers: int) -> Callable[[], bool]:
    """Whether it answers at these samples."""
    buffer = listener.buffer
    return lambda: all(buffer.can_lookup("world", "tool", STAMP + one * PERIOD) for one in numbers)


def poses(listener: TransformListener, stamps: list[int]) -> list[list[float]]:
    return [listener.buffer.lookup("world", "tool", stamp).pose7.tolist() for stamp in stamps]


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_new_listener_knows_the_last_two_seconds_bit_for_bit(sessions: tuple[Session, Session], follow):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1", follow=follow) as early,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        publish(publisher, 0, 400)
        until(has_samples(early, 399))
        with TransformListener(reader, "r1", follow=follow) as late:
            until(has_samples(late, 199, 399))
            until(lambda: late.stats.recalled == 201)
            stamps = [STAMP + number * PERIOD for number in range(199, 400)]
            stamps += [stamp + 3_333_333 for stamp in stamps[:-1]]
            assert poses(late, stamps) == poses(early, stamps)
            with pytest.raises(InPast):
                late.buffer.lookup("world", "tool", stamps[0] - 1)
            assert (late.stats.received, late.stats.missed, late.stats.refused) == (0, 0, {})
            assert late.robots() == ("r1",)


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_history_and_live_samples_join_without_a_gap(sessions: tuple[Session, Session], follow):
    writer, reader = sessions
    model = load_model("gripper")
    sine, stop, stamps = SineSource(model), threading.Event(), []

    def write() -> None:
        while not stop.wait(0.001):
            stamp = STAMP + len(stamps) * MS
            reading = sine.read(stamp)
            publisher.publish(reading.positions, reading.velocities, stamp=stamp)
            stamps.append(stamp)

    with (
        StatePublisher(writer, model, "r1") as publisher,
        TransformListener(reader, "r1", follow=follow, history_on_join=False) as early,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        thread = threading.Thread(target=write)
        thread.start()
        until(lambda: len(stamps) > 300)
        # Its own session: on the way to that of the other listener are samples, which it would receive.
        with connect() as joining, TransformListener(joining, "r1", follow=follow) as late:
            until(lambda: late.buffer.can_lookup(model.root, "palm", None))
            first, seen = stamps[0], len(stamps)
            moving = next(joint for joint in model.joints if joint.type != "fixed")
            edge = moving.parent, moving.child
            until(lambda: late.buffer.can_lookup(*edge, first) and len(stamps) > seen + 100)
            stop.set()
            thread.join()
            until(lambda: late.buffer.latest(*edge) == early.buffer.latest(*edge) == stamps[-1])
            for stamp in stamps:
                answers = [listener.buffer.lookup(*edge, stamp) for listener in (late, early)]
                assert [answer.kind for answer in answers] == ["exact", "exact"]
                assert answers[0] == answers[1]
            # Zenoh may drop a sample on a link that has just opened (missed); then the history has it.
            assert late.stats.dropped == late.stats.late == 0
            assert late.stats.recalled >= 300


@pytest.mark.parametrize("how", ["lookup", "wait", "wait_async", "join"])
def test_wait_for_a_recent_instant_after_joining_ends_with_the_exact_pose(
    sessions: tuple[Session, Session], how: str
):
    """A publisher at 200 Hz, and one listener after the other; each asks for half a second ago at once."""
    writer, reader = sessions
    sine = SineSource(RRBOT)
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        runner = threading.Thread(target=publisher.run, args=(sine, 200.0))
        runner.start()
        try:
            began = time.time_ns()
            until(lambda: time.time_ns() - began > PAST_NS + 100 * MS)
            assert publisher.cache is not None
            sent = RecentBuffer(RRBOT, "r1", publisher.cache)
            for _ in range(5):
                with TransformListener(reader, "r1") as listener:
                    asked = time.time_ns() - PAST_NS
                    # Bit for bit: no neighbour of that instant was still missing.
                    assert waited(how, listener.buffer, asked) == sent.buffer().lookup("world", "tool", asked)
        finally:
            publisher.close()
            runner.join()


def waited(how: str, buffer: TransformBuffer, at: int) -> Transform:
    """The pose of the tool at ``at``, by one of the calls that wait."""
    if how == "lookup":
        return buffer.lookup("world", "tool", at, timeout_s=DEADLINE_S)
    if how == "wait":
        return buffer.wait("world", "tool", at, DEADLINE_S)
    if how == "wait_async":
        return asyncio.run(buffer.wait_async("world", "tool", at, DEADLINE_S))
    return asyncio.run(joined(buffer, at))


async def joined(buffer: TransformBuffer, at: int) -> Transform:
    async def samples() -> AsyncIterator[SimpleNamespace]:
        yield SimpleNamespace(frame="tool", stamp=at)

    async for _, transform in buffer.join(samples(), "world", timeout_s=DEADLINE_S):
        return transform
    raise AssertionError("the sample was dropped")


def test_large_history_is_received_page_by_page_through_a_router(spawn: Callable[..., Child], free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    spawn(ROUTER, endpoint).line()
    with (
        connect(mode="client", endpoints=endpoint) as writer,
        connect(mode="client", endpoints=endpoint) as reader,
        connect(mode="client", endpoints=endpoint) as witness,
        StatePublisher(writer, RRBOT, "r1", cache_s=100.0) as publisher,
    ):
        tap = SampleCollector(witness, JOINTS)
        wait_for_stream_readers(writer, "r1")
        for first in range(0, 2000, 100):  # what is still on its way to the router would be received live
            publish(publisher, first, first + 100)
            tap.payloads(first + 100)
        with TransformListener(reader, "r1", history_s=100.0) as listener:
            until(lambda: listener.stats.recalled == 2000)
            for number in (0, 1, 1000, 1999):
                expected = kinematic_pose(RRBOT, positions(number), "world", "tool")
                pose = listener.buffer.lookup("world", "tool", STAMP + number * PERIOD)
                assert np.allclose(pose.matrix, expected, rtol=0.0, atol=1e-12)


def test_samples_published_without_a_router_are_received_afterwards(
    spawn: Callable[..., Child], free_port: int
):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = spawn(ROUTER, endpoint)
    router.line()
    with (
        connect(mode="client", endpoints=endpoint) as writer,
        connect(mode="client", endpoints=endpoint) as reader,
        StatePublisher(writer, RRBOT, "r1", cache_s=100.0) as publisher,
        TransformListener(reader, "r1", history_s=100.0) as listener,
    ):
        wait_for_stream_readers(writer, "r1")
        publish(publisher, 0, 10)
        until(has_samples(listener, 0, 9))
        router.kill()
        until(lambda: not list(reader.zenoh.info.routers_zid()))
        until(lambda: not list(writer.zenoh.info.routers_zid()))
        publish(publisher, 10, 500)
        assert not has_samples(listener, 10)()
        spawn(ROUTER, endpoint).line()
        wait_for_stream_readers(writer, "r1")
        publish(publisher, 500, 501)
        until(has_samples(listener, 500))
        # Sample 500 comes live, or is recalled as well. The oldest one that is recalled comes last.
        until(lambda: listener.buffer.lookup("world", "tool", STAMP + 10 * PERIOD).kind == "exact")
        until(lambda: listener.stats.recalled >= 490)
        for number in range(501):
            answer = listener.buffer.lookup("world", "tool", STAMP + number * PERIOD)
            assert answer.kind == "exact"


def test_listener_requests_no_more_history_than_its_buffer_keeps(sessions: tuple[Session, Session]):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1", cache_s=100.0) as publisher:
        publish(publisher, 0, 1000)
        with TransformListener(reader, "r1", history_s=1.0) as listener:
            until(lambda: listener.stats.recalled == 101)
            publish(publisher, 1000, 1001)
            until(has_samples(listener, 1000))
            assert listener.stats.recalled == 101


def test_no_history_without_a_cache_or_with_history_on_join_off(
    sessions: tuple[Session, Session],
):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1", cache_s=0.0) as publisher:
        assert publisher.cache is None
        publish(publisher, 0, 10)
        assert list(reader.zenoh.get(JOINTS, timeout=5.0)) == []
    with StatePublisher(writer, RRBOT, "r2") as publisher:
        publish(publisher, 0, 10)
        with TransformListener(reader, "r2", history_on_join=False) as listener:
            wait_for_stream_readers(writer, "r2")
            publish(publisher, 10, 12)
            until(lambda: has_samples(listener, 10, 11)() and listener.stats.received == 2)
            assert listener.stats.recalled == 0
            assert not has_samples(listener, 9)()
    with pytest.raises(InvalidInput, match="cache_s"):
        StatePublisher(writer, RRBOT, "r3", cache_s=-1.0)


def test_invalid_cache_duration_is_refused_without_leaks(sessions: tuple[Session, Session]):
    writer, _ = sessions
    with pytest.raises(InvalidInput, match="cache_s"):
        StatePublisher(writer, RRBOT, "r1", cache_s=float("nan"))
    with StatePublisher(writer, RRBOT, "r1"):
        pass


def test_gap_in_a_cache_counts_as_no_loss(sessions: tuple[Session, Session]):
    """A listener that receives sample 10 first and 0 to 9 as history has missed nothing."""
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        publish(publisher, 0, 10)
        with TransformListener(reader, "r1") as listener:
            wait_for_stream_readers(writer, "r1")
            publish(publisher, 10, 20)
            until(lambda: has_samples(listener, 0, 19)() and listener.stats.received == 10)
            assert listener.stats.missed == listener.stats.dropped == 0


def test_only_samples_of_the_current_writer_are_cached(sessions: tuple[Session, Session]):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1") as first:
        publish(first, 0, 10)
    with StatePublisher(writer, RRBOT, "r1") as second:
        publish(second, 20, 30)
        with TransformListener(reader, "r1") as listener:
            until(lambda: listener.stats.recalled == 10)
            assert has_samples(listener, 20, 29)()
            assert not has_samples(listener, 9)()


def test_writer_that_joins_later_starts_its_own_history(
    sessions: tuple[Session, Session],
):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        with StatePublisher(writer, RRBOT, "r1") as first:
            wait_for_stream_readers(writer, "r1")
            publish(first, 0, 10)
            until(has_samples(listener, 0, 9))
        with StatePublisher(writer, RRBOT, "r1") as second:
            publish(second, 20, 30)
            until(has_samples(listener, 20, 29))
            assert not has_samples(listener, 9)()
            assert listener.stats.missed == 0


def test_every_robot_of_a_fleet_provides_its_history(sessions: tuple[Session, Session]):
    writer, reader = sessions
    publishers = [StatePublisher(writer, RRBOT, f"r{number}") for number in range(10)]
    for number, publisher in enumerate(publishers):
        publish(publisher, number, number + 20)
    others = set(threading.enumerate())
    with TransformListener(reader) as listener:
        until(lambda: listener.stats.recalled == 200)
        for number in range(10):
            stamp = STAMP + (number + 5) * PERIOD
            pose = listener.buffer.lookup(f"r{number}/world", f"r{number}/tool", stamp)
            expected = kinematic_pose(RRBOT, positions(number + 5), "world", "tool")
            assert np.allclose(pose.matrix, expected, rtol=0.0, atol=1e-12)
        asking = set(threading.enumerate()) - others
        assert [thread.name for thread in asking].count("zstate requests") == 1
    for publisher in publishers:
        publisher.close()


def test_publisher_that_only_derives_transforms_provides_their_history(sessions: tuple[Session, Session]):
    writer, reader = sessions
    streams = ("robot_description", "tf_static", "tf")
    with StatePublisher(writer, RRBOT, "r1", streams=streams) as publisher:
        publish(publisher, 0, 10)
        assert list(reader.zenoh.get(JOINTS, timeout=5.0)) == []
        with TransformListener(reader, "r1", follow="tf") as listener:
            until(lambda: listener.stats.recalled == 10)
            expected = kinematic_pose(RRBOT, positions(3), "world", "tool")
            pose = listener.buffer.lookup("world", "tool", STAMP + 3 * PERIOD)
            assert np.allclose(pose.matrix, expected, rtol=0.0, atol=1e-12)


def test_history_equals_the_published_samples_byte_for_byte(sessions: tuple[Session, Session]):
    writer, reader = sessions
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_stream_readers(writer, "r1")
        publisher.publish([0.5, 1.0], [0.1, 0.2], [3.0, 4.0], STAMP)
        publisher.publish([0.5, 1.0], stamp=STAMP + 1)
        assert publisher.cache is not None
        expected = tap.payloads(2)
        pages: list[list[SerializedSample]] = []
        with ServiceThread(reader, "requests") as thread:
            Requests(reader, thread, 1).add(
                HistoryRequest(
                    JOINTS,
                    publisher.cache.writer,
                    lambda page, _: bool(pages.append(page)),
                    lambda *_: None,
                )
            )
            until(lambda: pages)
    assert [one.payload for one in pages[0]] == expected
    assert {one.encoding for one in pages[0]} == {encoding_of(JointState)}
    tap.close()


def test_statics_and_history_give_a_transform_before_the_listener_joined(
    sessions: tuple[Session, Session],
):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1") as publisher, StaticPublisher(writer, "r1", "mount") as statics:
        statics.set(Transform("tool", "hook", (0.0, 0.0, 0.25), (0.0, 0.0, 0.0, 1.0)))
        start = time.time_ns() - 2_000_000_000
        for number in range(200):
            publisher.publish(positions(number), stamp=start + number * PERIOD)
        with TransformListener(reader, "r1") as listener:
            asked = start + 50 * PERIOD
            until(lambda: listener.buffer.can_lookup("world", "hook", asked))
            expected = kinematic_pose(RRBOT, positions(50), "world", "tool")
            expected[:3, 3] += 0.25 * expected[:3, 2]
            pose = listener.buffer.lookup("world", "hook", asked)
            assert np.allclose(pose.matrix, expected, rtol=0.0, atol=1e-12)


def test_history_of_another_session_is_refused(sessions):
    writer, reader = sessions
    memory = SampleCache(10.0, 2, 8)
    order = order_digest(RRBOT.joint_names)
    memory.append(STAMP, 0, encode(JointState(STAMP, 0, 9, order, to_block([0.5, 0.25]))))
    announced = Announcement("r1", "joint_states", WriterId("driver", "nuc", 1, 2, 8))
    with (
        StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]),
        serve_history(writer, "r1", "joint_states", memory),
        announce(writer, f"zstate/r1/@writer/joint_states/{announced.identity}"),
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: listener.stats.refused == {"foreign answer": 1})
        listener.buffer.wait("lower", "tool", timeout_s=DEADLINE_S)
        assert not listener.buffer.can_lookup("world", "tool")
