"""Decoded messages of a stream, with the robot of each key; what cannot be decoded is reported."""

from __future__ import annotations

import threading

import pytest
from helpers.processes import until

from zstate.net.latched import LatchedPublisher
from zstate.net.streams import KeyPublisher
from zstate.net.subscription import Received, subscribe
from zstate.wire.measurements import renumbered
from zstate.wire.messages import JointState, StaticTransforms, order_digest, to_block
from zstate.wire.native import NativeWire, encode, encoding_of

STATE = JointState(5, 0, 1, order_digest(("a",)), to_block([0.5]))
STATICS = StaticTransforms(1, (("base", "camera"),), to_block([0.0, 0, 0, 0, 0, 0, 1]))


@pytest.mark.parametrize("robot", ["r1", "*"])
def test_messages_of_a_stream_arrive_with_their_robot_and_broken_ones_are_reported(sessions, robot: str):
    received: list[Received] = []
    errors: list[tuple[str, str]] = []
    key, encoding = "zstate/r1/joint_states", encoding_of(JointState)
    with (
        KeyPublisher(sessions[0], key, encoding) as publisher,
        subscribe(
            sessions[1],
            NativeWire(),
            robot,
            "joint_states",
            received.extend,
            on_error=lambda *error: errors.append(error),
        ),
    ):
        until(lambda: publisher.has_readers)
        publisher.put(encode(STATE)[:-3])
        publisher.put(encode(STATE))
        until(lambda: received)
    assert received == [("r1", key, STATE)]
    assert [reason for reason, _ in errors] == ["truncated"]
    assert errors[0][1].startswith(f"{key}: ")


def test_a_refusal_is_reported_between_the_messages_before_and_after_it(sessions):
    calls: list[str] = []
    is_first, goes_on = threading.Event(), threading.Event()

    def on_messages(received: list[Received]) -> None:
        if not is_first.is_set():  # the others arrive in one batch
            is_first.set()
            assert goes_on.wait(10.0)
        calls.extend(str(one.message.seq) for one in received)

    with (
        KeyPublisher(sessions[0], "zstate/r1/joint_states", encoding_of(JointState)) as publisher,
        subscribe(
            sessions[1],
            NativeWire(),
            "r1",
            "joint_states",
            on_messages,
            on_refused=lambda _: calls.append("refused"),
        ),
    ):
        until(lambda: publisher.has_readers)
        publisher.put(encode(renumbered(STATE, 1, 5)))
        assert is_first.wait(10.0)
        for seq in (2, 3):
            publisher.put(encode(renumbered(STATE, seq, 5)))
        publisher.put(encode(STATE)[:-3])
        publisher.put(encode(renumbered(STATE, 4, 5)))
        goes_on.set()
        until(lambda: "4" in calls)
    assert calls == ["1", "2", "3", "refused", "4"]


def test_a_key_without_a_robot_is_reported_as_foreign(sessions):
    errors: list[str] = []
    received: list[Received] = []
    with (
        KeyPublisher(sessions[0], "zstate/@x/joint_states", "") as foreign,
        KeyPublisher(sessions[0], "zstate/R 1/joint_states", encoding_of(JointState)) as publisher,
        subscribe(
            sessions[1],
            NativeWire(),
            "*",
            "joint_states",
            received.extend,
            on_error=lambda reason, _: errors.append(reason),
        ),
    ):
        until(lambda: publisher.has_readers)
        foreign.put(b"x")
        publisher.put(encode(STATE))
        until(lambda: errors)
    assert errors == ["foreign"]
    assert received == []


def test_withdrawn_value_is_reported_by_its_key_without_an_error(sessions):
    received: list[Received] = []
    withdrawn: list[str] = []
    errors: list[object] = []
    key, encoding = "zstate/r1/tf_static/mount", encoding_of(StaticTransforms)
    with (
        LatchedPublisher(sessions[0], key, encoding) as publisher,
        subscribe(
            sessions[1],
            NativeWire(),
            "r1",
            "tf_static",
            received.extend,
            on_error=lambda *error: errors.append(error),
            on_withdrawn=withdrawn.append,
        ),
    ):
        publisher.set(encode(STATICS))
        until(lambda: received)
        publisher.withdraw()
        until(lambda: withdrawn)
    assert received == [("r1", key, STATICS)]
    assert withdrawn == [key]
    assert errors == []
