"""Subscribers to several key expressions, those whose thread starts later, and those that share a thread."""

from __future__ import annotations

import threading

import pytest
import zenoh
from helpers.processes import DEADLINE_S, until

from zstate.net.latched import LatchedPublisher, LatchedSubscriber
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher, StreamSubscriber
from zstate.wire.protocol import SerializedSample

KEYS = ("zstate/r1/joint_states", "zstate/r2/joint_states")
STATIC = "zstate/r1/tf_static/a"


def test_subscriber_to_two_keys_receives_both_in_order_and_no_third(sessions):
    got: list[SerializedSample] = []
    writer, reader = sessions
    with (
        KeyPublisher(writer, KEYS[0], "") as first,
        KeyPublisher(writer, KEYS[1], "") as second,
        KeyPublisher(writer, "zstate/r3/joint_states", "") as third,
    ):
        with StreamSubscriber(reader, KEYS, got.extend) as subscriber:
            until(lambda: first.has_readers and second.has_readers)
            assert not third.has_readers
            for number in range(100):
                for publisher in (first, second, third):
                    publisher.put(bytes([number]))
            until(lambda: len(got) == 200)
        until(lambda: not first.has_readers and not second.has_readers)
    for key in KEYS:
        assert [one.payload for one in got if one.key == key] == [bytes([number]) for number in range(100)]
    assert (subscriber.full_batches, subscriber.failures) == (0, 0)


@pytest.mark.parametrize("keys", [KEYS, KEYS[:1]])
def test_a_dormant_subscriber_has_a_thread_from_its_first_sample_on_and_loses_none(sessions, keys):
    writer, reader = sessions
    got: list[SerializedSample] = []
    before = set(threading.enumerate())
    with (
        KeyPublisher(writer, KEYS[0], "") as publisher,
        StreamSubscriber(reader, keys, got.extend, is_dormant=True) as subscriber,
    ):
        until(lambda: publisher.has_readers)
        assert not set(threading.enumerate()) - before
        for number in range(100):
            publisher.put(bytes([number]))
        until(lambda: len(got) >= 100)
        assert len(set(threading.enumerate()) - before) == 1
        publisher.put(b"last")
        until(lambda: got[-1].payload == b"last")
    assert [one.payload for one in got] == [*(bytes([number]) for number in range(100)), b"last"]
    assert (subscriber.full_batches, subscriber.failures) == (0, 0)
    assert not set(threading.enumerate()) - before


def test_a_dormant_subscriber_may_be_closed_before_its_first_sample(sessions):
    writer, reader = sessions
    before = set(threading.enumerate())
    with KeyPublisher(writer, KEYS[0], "") as publisher:
        subscriber = StreamSubscriber(reader, KEYS[0], lambda samples: None, is_dormant=True)
        until(lambda: publisher.has_readers)
        subscriber.close()
        until(lambda: not publisher.has_readers)
    assert not set(threading.enumerate()) - before


@pytest.mark.parametrize("keys", [KEYS, KEYS[:1]])
def test_the_thread_of_a_subscriber_ends_with_its_session(sessions, keys):
    writer, reader = sessions
    got: list[SerializedSample] = []
    before = set(threading.enumerate())
    with KeyPublisher(writer, KEYS[0], "") as publisher:
        subscriber = StreamSubscriber(reader, keys, got.extend, is_dormant=True)
        until(lambda: publisher.has_readers)
        publisher.put(b"1")
        until(lambda: got)
        (thread,) = set(threading.enumerate()) - before
        reader.close()
        thread.join(DEADLINE_S)
        assert not thread.is_alive()
        subscriber.close()


def test_failed_declaration_leaves_no_subscriber(sessions):
    writer, reader = sessions
    with KeyPublisher(writer, KEYS[0], "") as publisher:
        with StreamSubscriber(reader, KEYS[0], lambda samples: None):
            until(lambda: publisher.has_readers)
        with pytest.raises(zenoh.ZError):
            StreamSubscriber(reader, (KEYS[0], "//"), lambda samples: None)
        until(lambda: not publisher.has_readers)


def test_subscribers_that_share_a_thread_receive_their_own_values_in_order(sessions):
    writer, reader = sessions
    keys = [STATIC, "zstate/r1/robot_description"]
    received: dict[str, list[SerializedSample]] = {key: [] for key in keys}
    before = set(threading.enumerate())
    with (
        ServiceThread(reader, "requests") as thread,
        LatchedSubscriber(reader, keys[0], received[keys[0]].append, thread=thread),
        LatchedSubscriber(reader, keys[1], received[keys[1]].append, thread=thread),
        LatchedPublisher(writer, keys[0], "") as first,
        LatchedPublisher(writer, keys[1], "") as second,
    ):
        for publisher, key in ((first, keys[0]), (second, keys[1])):
            publisher.set(b"first")
            until(lambda key=key: received[key])
        for number in range(100):
            for publisher in (first, second):
                publisher.set(bytes([number]))
        until(lambda: all(len(values) == 101 for values in received.values()))
        assert [one.name for one in set(threading.enumerate()) - before] == ["zstate requests"]
    for key, values in received.items():
        assert [one.payload for one in values] == [b"first", *(bytes([number]) for number in range(100))]
        assert {one.key for one in values} == {key}


def test_values_beyond_the_capacity_lose_the_oldest_while_another_handler_holds_up_the_thread(sessions):
    writer, reader = sessions
    held, seen, got = list[SerializedSample](), list[bytes](), list[bytes]()
    go_on = threading.Event()

    def hold(value: SerializedSample) -> None:
        held.append(value)
        go_on.wait(DEADLINE_S)

    with (
        ServiceThread(reader, "requests") as thread,
        LatchedSubscriber(reader, "zstate/r1/robot_description", hold, thread=thread),
        LatchedSubscriber(
            reader, STATIC, lambda value: got.append(value.payload), capacity=3, thread=thread
        ) as subscriber,
        LatchedSubscriber(reader, STATIC, lambda value: seen.append(value.payload)),
        LatchedPublisher(writer, STATIC, "") as value,
        LatchedPublisher(writer, "zstate/r1/robot_description", "") as description,
    ):
        value.set(b"first")
        until(lambda: got and seen)
        description.set(b"slow")
        until(lambda: held)
        for number in range(5):
            value.set(bytes([number]))
        until(lambda: len(seen) == 6)  # of a subscriber with a thread of its own
        assert got == [b"first"]
        go_on.set()
        until(lambda: len(got) == 4)
    assert got == [b"first", b"\x02", b"\x03", b"\x04"]
    assert subscriber.full_batches == 1


def test_a_failing_callback_ends_neither_the_shared_thread_nor_others_on_it(sessions, monkeypatch):
    reported: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", reported.append)
    writer, reader = sessions
    got: list[SerializedSample] = []

    def fail(sample: SerializedSample) -> None:
        raise ValueError("a broken handler")

    with (
        ServiceThread(reader, "requests") as thread,
        LatchedSubscriber(reader, STATIC, fail, thread=thread) as failing,
        LatchedSubscriber(reader, STATIC, got.append, thread=thread),
        LatchedPublisher(writer, STATIC, "") as value,
    ):
        for count in (1, 2):
            value.set(b"%d" % count)
            until(lambda count=count: failing.failures == count and len(got) == count)
        assert thread.failures == 0
    assert [str(one.exc_value) for one in reported] == ["a broken handler"]


def test_a_subscriber_on_a_shared_thread_may_close_itself_and_leaves_the_others(sessions):
    writer, reader = sessions
    got: list[SerializedSample] = []
    others: list[SerializedSample] = []

    def close_myself(value: SerializedSample) -> None:
        got.append(value)
        subscriber.close()

    with (
        ServiceThread(reader, "requests") as thread,
        LatchedSubscriber(reader, STATIC, others.append, thread=thread),
        LatchedPublisher(writer, STATIC, "") as value,
    ):
        subscriber = LatchedSubscriber(reader, STATIC, close_myself, thread=thread)
        value.set(b"1")
        until(lambda: got and others)
        value.set(b"2")
        until(lambda: others[-1].payload == b"2")
    assert [one.payload for one in got] == [b"1"]


def test_a_shared_thread_ends_with_its_session(sessions: tuple[Session, Session]):
    writer, reader = sessions
    got: list[SerializedSample] = []
    before = set(threading.enumerate())
    with LatchedPublisher(writer, STATIC, "") as value:
        thread = ServiceThread(reader, "requests")
        subscriber = LatchedSubscriber(reader, STATIC, got.append, thread=thread)
        value.set(b"1")
        until(lambda: got)
        (started,) = [one for one in set(threading.enumerate()) - before if one.name == "zstate requests"]
        reader.close()
        started.join(DEADLINE_S)
        assert not started.is_alive()
        subscriber.close()
        thread.close()
