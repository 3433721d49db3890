"""Lookups by one query, for devices that have no buffer."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest
from helpers.lookup_client import query_lookup
from helpers.processes import Child, until
from helpers.robots import RRBOT, STAMP, UPRIGHT, assert_pose, kinematic_pose

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.errors import Disconnected, InFuture, InPast, NoData, UnknownFrame, Unreachable
from zstate.net.session import Session, connect
from zstate.nodes.lookup_service import LookupService, RecentBuffer
from zstate.nodes.publisher import StatePublisher
from zstate.streams import StreamName
from zstate.transform import Transform

PERIOD = 10_000_000
KEY = "zstate/r1/lookup"
ROUTER = """
    import sys
    from zstate.net.session import connect
    with connect(mode="router", listen=sys.argv[1]):
        print("up")
        sys.stdin.readline()
"""
DEVICE = """
    # What a device does that knows Zenoh and nothing of zstate.
    import json, sys, zenoh
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
    with zenoh.open(config) as session:
        for selector in map(str.strip, sys.stdin):
            for reply in session.get(selector):
                result = reply.ok or reply.err
                print(bool(reply.ok), result.encoding, result.payload.to_string())
            print("end")
"""


def await_answers(session: Session, robot: str = "r1") -> None:
    until(lambda: list(session.zenoh.get(f"zstate/{robot}/lookup", timeout=5.0)))


def two_robots() -> TransformBuffer:
    buffer = TransformBuffer()
    for robot, height in (("r1", 1.0), ("r2", 2.0)):
        buffer.insert_static(Transform(f"{robot}/base", f"{robot}/tool", (0.0, 0.0, height), UPRIGHT))
    feed_of(buffer).name_robot("r1")
    feed_of(buffer).name_robot("r2")
    return buffer


def test_replies_equal_lookups_in_the_buffer(sessions: tuple[Session, Session]):
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT, "r1")
    for number in range(3):
        buffer.insert_joints(track, STAMP + number * PERIOD, [0.5 * number, 0.25])
    with LookupService(sessions[0], buffer, "r1") as service:
        await_answers(sessions[1])
        for at in (None, STAMP, STAMP + 1, STAMP + PERIOD):
            answer, expected = (
                query_lookup(sessions[1], "r1", "world", "tool", at),
                buffer.lookup("world", "tool", at),
            )
            assert_pose(answer, expected.matrix)
            assert (answer.stamp, answer.kind) == (expected.stamp, expected.kind)
        until(lambda: service.answered == 5)
        assert service.full_batches == 0


@pytest.mark.parametrize(
    ("asked", "error"),
    [
        (("world", "hand", None), UnknownFrame),
        (("world", "island", None), Disconnected),
        (("world", "mover", None), NoData),
        (("world", "tool", STAMP + 5), InFuture),
        (("world", "tool", STAMP - 5), InPast),
    ],
)
def test_lookup_error_of_the_buffer_is_raised_at_the_client(sessions, asked, error):
    buffer = TransformBuffer()
    buffer.insert_joints(buffer.add_robot(RRBOT, "r1"), STAMP, [0.5, 0.25])
    buffer.insert_static(Transform("sea", "island", (0.0, 0.0, 0.0), UPRIGHT))
    buffer.insert(Transform("world", "mover", (0.0, 0.0, 0.0), UPRIGHT, STAMP))
    if error is NoData:
        buffer.clear()
    with LookupService(sessions[0], buffer, "r1"):
        await_answers(sessions[1])
        with pytest.raises(error) as here:
            buffer.lookup(*asked)
        with pytest.raises(error) as there:
            query_lookup(sessions[1], "r1", *asked)
    assert str(there.value) == str(here.value)
    assert there.value.facts() == here.value.facts()


def test_ambiguous_bare_name_means_the_robots_own_frame(sessions: tuple[Session, Session]):
    buffer = two_robots()
    with LookupService(sessions[0], buffer, "r1"), LookupService(sessions[0], buffer, "r2"):
        for robot, height in (("r1", 1.0), ("r2", 2.0)):
            await_answers(sessions[1], robot)
            assert query_lookup(sessions[1], robot, "base", "tool").translation[2] == height
        assert query_lookup(sessions[1], "r1", "r2/base", "r2/tool").translation[2] == 2.0


def test_every_publisher_answers_lookups_of_its_recent_samples(sessions: tuple[Session, Session]):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1", cache_s=1.0) as publisher:
        await_answers(reader)
        with pytest.raises(NoData):
            query_lookup(reader, "r1", "world", "tool")
        for number in range(150):
            publisher.publish([0.01 * number, 0.25], stamp=STAMP + number * PERIOD)
            if number % 40 == 0:
                query_lookup(reader, "r1", "world", "tool")
        for number in (49, 100, 149):
            answer = query_lookup(reader, "r1", "world", "tool", STAMP + number * PERIOD)
            assert_pose(answer, kinematic_pose(RRBOT, [0.01 * number, 0.25], "world", "tool"))
        with pytest.raises(InPast):
            query_lookup(reader, "r1", "world", "tool", STAMP + 48 * PERIOD)
        with pytest.raises(UnknownFrame):
            query_lookup(reader, "r1", "world", "camera")
    with pytest.raises(Unreachable):
        query_lookup(reader, "r1", "world", "tool", timeout_s=0.2)


def test_publisher_without_a_cache_answers_from_its_newest_sample(sessions: tuple[Session, Session]):
    with StatePublisher(sessions[0], RRBOT, "r1", cache_s=0.0) as publisher:
        await_answers(sessions[1])
        for number in range(3):
            publisher.publish([0.5 * number, 0.25], stamp=STAMP + number * PERIOD)
        answer = query_lookup(sessions[1], "r1", "world", "tool")
        assert answer.stamp == STAMP + 2 * PERIOD
        assert_pose(answer, kinematic_pose(RRBOT, [1.0, 0.25], "world", "tool"))
        with pytest.raises(InPast):
            query_lookup(sessions[1], "r1", "world", "tool", STAMP + PERIOD)


def test_driver_and_state_publisher_of_one_robot_answer_the_same(sessions: tuple[Session, Session]):
    driver, other = sessions
    derived: tuple[StreamName, ...] = ("robot_description", "tf_static", "tf")
    with (
        StatePublisher(driver, RRBOT, "r1", streams=("joint_states",)) as joints,
        StatePublisher(other, RRBOT, "r1", streams=derived) as state,
    ):
        await_answers(other)
        for publisher in (joints, state):
            publisher.publish([0.5, 0.25], stamp=STAMP)
        for session in sessions:
            answer = query_lookup(session, "r1", "world", "tool")
            assert (answer.stamp, answer.kind) == (STAMP, "exact")


def test_publisher_with_a_clock_set_back_answers_from_the_new_epoch(sessions):
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        assert publisher.cache is not None
        recent = RecentBuffer(RRBOT, "r1", publisher.cache)
        publisher.publish([0.0, 0.0], stamp=STAMP)
        assert recent.buffer().latest("world", "tool") == STAMP
        for number in range(2):
            publisher.publish([0.5, 0.0], stamp=number)
        assert recent.buffer().latest("world", "tool") == 1
        assert recent.buffer().lookup("world", "tool", 0).kind == "exact"


def test_client_in_another_process_gets_replies_through_a_router(spawn: Callable[..., Child], free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    spawn(ROUTER, endpoint).line()
    buffer = TransformBuffer()
    buffer.insert_joints(buffer.add_robot(RRBOT, "r1"), STAMP, [0.5, 0.25])
    with (
        connect(mode="client", endpoints=endpoint) as session,
        connect(mode="client", endpoints=endpoint) as other,
        LookupService(session, buffer, "r1"),
    ):
        await_answers(other)
        device = spawn(DEVICE, endpoint)

        def reply(parameters: str) -> tuple[bool, dict[str, object]]:
            device.send_line(f"{KEY}?{parameters}")
            is_answer, encoding, text = device.line().split(" ", 2)
            assert (encoding, device.line()) == ("application/json", "end")
            return is_answer == "True", json.loads(text)

        assert reply(f"target=world;source=tool;at={STAMP}") == (
            True,
            buffer.lookup("world", "tool", STAMP).to_dict(),
        )
        is_answer, error = reply("target=world;source=tol")
        assert (is_answer, error["error"], error["near_misses"]) == (False, "UnknownFrame", ["tool"])
        is_answer, error = reply(f"target=world;source=tool;at={STAMP + 12_000_000}")
        assert (is_answer, error["error"]) == (False, "InFuture")
        assert "12.0 ms after the only sample" in str(error["message"])
        is_answer, error = reply("target=world;source=tool;when=now")
        assert (is_answer, error["error"]) == (False, "InvalidInput")
        assert "no parameter 'when'" in str(error["message"])
