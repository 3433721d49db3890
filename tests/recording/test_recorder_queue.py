from __future__ import annotations

import time
from contextlib import closing

from helpers.processes import repeated, until
from helpers.robots import SampleCollector, wait_for_reader

from zstate.net.latched import LatchedPublisher
from zstate.net.streams import BULK_CAPACITY, CAPACITY, KeyPublisher, StreamSubscriber
from zstate.recording.recorder import BULK_QUEUE_BYTES, QUEUE_LENGTH, Batch, MessageQueue


def payloads(batches: list[Batch]) -> list[bytes]:
    return [arrival.payload for one in batches for arrival in one.arrivals]


def test_several_subscriptions_share_one_queue_with_reception_times(sessions):
    writer, reader = sessions
    batches: list[Batch] = []
    with (
        MessageQueue(reader) as inbox,
        KeyPublisher(writer, "a/samples", "") as samples,
        LatchedPublisher(writer, "a/value", "") as value,
    ):
        value.set(b"holds")
        inbox.subscribe("joint_states", ["a/samples"], "r1")
        inbox.subscribe("robot_description", ["a/*"], None)
        until(lambda: samples.has_readers)
        wait_for_reader(writer, "a/value")
        before = time.time_ns()
        for number in range(5):
            samples.put(b"%d" % number)
        until(lambda: batches.extend(inbox.pop_all()) or len(payloads(batches)) >= 11)
        assert inbox.pop_all() == []
    ours = [one for one in batches if one.robot == "r1"]
    assert payloads(ours) == [b"0", b"1", b"2", b"3", b"4"]
    assert all(before <= one.stamp <= time.time_ns() and not one.overflowed for one in ours)
    assert {one.stream for one in ours} == {"joint_states"}
    assert b"holds" in payloads([one for one in batches if one.stream == "robot_description"])


def test_bulk_data_that_waits_leaves_room_for_other_samples_and_its_loss_is_reported(sessions):
    writer, reader = sessions
    seen: list[int] = []
    with (
        MessageQueue(reader) as inbox,
        KeyPublisher(writer, "a/cloud", "", is_bulk=True) as clouds,
        KeyPublisher(writer, "a/samples", "") as samples,
        StreamSubscriber(reader, "a/cloud", lambda batch: seen.extend(map(id, batch)), is_bulk=True),
    ):
        inbox.subscribe("cloud", ["a/cloud"], "r1")
        inbox.subscribe("joint_states", ["a/samples"], "r1")
        until(lambda: clouds.has_readers and samples.has_readers)
        large = bytes(8_000_000)
        with repeated(lambda: clouds.put(large)):
            until(lambda: inbox._bytes >= BULK_QUEUE_BYTES)
            waiting = inbox._bytes
            samples.put(b"state")
            until(lambda: inbox._batches[-1].stream == "joint_states")
            before = len(seen)
            until(lambda: len(seen) >= before + 3 * BULK_CAPACITY)  # its ring drops the oldest
        assert waiting < BULK_QUEUE_BYTES + BULK_CAPACITY * len(large)
        batches: list[Batch] = []
        until(lambda: batches.extend(inbox.pop_all()) or any(one.overflowed for one in batches))
    assert b"state" in payloads(batches)


def test_unread_queue_is_bounded_and_its_loss_is_reported(sessions):
    writer, reader = sessions
    sent = QUEUE_LENGTH + 3 * CAPACITY
    with (
        MessageQueue(reader) as inbox,
        KeyPublisher(writer, "a/samples", "") as samples,
        closing(SampleCollector(reader, "a/samples")) as tap,
    ):
        inbox.subscribe("joint_states", ["a/samples"], "r1")
        until(lambda: samples.has_readers)
        for number in range(sent):
            samples.put(b"%d" % number)
            if number % 50 == 49:  # what comes too fast is lost on the way
                tap.payloads(number + 1)
        batches: list[Batch] = []
        until(lambda: batches.extend(inbox.pop_all()) or any(one.overflowed for one in batches))
        samples.put(b"last")
        until(lambda: batches.extend(inbox.pop_all()) or payloads(batches)[-1] == b"last")
    assert QUEUE_LENGTH <= len(payloads(batches)) <= QUEUE_LENGTH + 3 * CAPACITY
    assert len(payloads(batches)) < sent


def test_close_ends_without_a_reader_and_keeps_waiting_batches(sessions):
    writer, reader = sessions
    inbox = MessageQueue(reader)
    with KeyPublisher(writer, "a/samples", "") as samples:
        inbox.subscribe("joint_states", ["a/samples"], "r1")
        until(lambda: samples.has_readers)
        for number in range(QUEUE_LENGTH + 2 * CAPACITY):
            samples.put(b"%d" % number)
    inbox.close()
    inbox.close()
    # How many its ring lost before them is the machine's business.
    waiting = [int(payload) for payload in payloads(inbox.pop_all())]
    assert waiting
    assert waiting == sorted(waiting)
