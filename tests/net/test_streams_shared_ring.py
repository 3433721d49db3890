"""One ring for several subscribers: order, loss of the oldest, wakeups, end."""

from __future__ import annotations

import threading

import pytest
import zenoh
from helpers.processes import DEADLINE_S, until

from zstate.net.streams import KeyPublisher, SharedRing, StreamSubscriber
from zstate.wire.protocol import SerializedSample

KEYS = ("zstate/r1/joint_states", "zstate/r2/joint_states")


def test_full_ring_loses_the_oldest_items():
    ring: SharedRing[int] = SharedRing(3)
    for item in range(5):
        ring.put(item)
    assert [ring.try_recv() for _ in range(4)] == [2, 3, 4, None]


def test_every_item_reaches_a_receiver_that_waits_for_each():
    ring: SharedRing[int] = SharedRing(20_000)
    got: list[int] = []

    def receive() -> None:
        with pytest.raises(zenoh.ZError):
            while True:
                got.append(ring.recv())

    receiver = threading.Thread(target=receive, daemon=True)
    receiver.start()
    writers = [
        threading.Thread(target=lambda: [ring.put(number) for number in range(5000)]) for _ in range(2)
    ]
    for writer in writers:
        writer.start()
    until(lambda: len(got) == 10_000)
    ring.close()
    receiver.join(DEADLINE_S)
    assert not receiver.is_alive()
    assert sorted(got) == sorted([*range(5000)] * 2)


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


def test_thread_of_a_subscriber_to_two_keys_ends_with_the_session(sessions):
    before = set(threading.enumerate())
    subscriber = StreamSubscriber(sessions[1], KEYS, lambda samples: None)
    (thread,) = set(threading.enumerate()) - before
    sessions[1].close()
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
