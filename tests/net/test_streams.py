import threading
import time

import pytest
from helpers.processes import DEADLINE_S, repeated, until

from zstate.errors import Closed
from zstate.net.session import connect
from zstate.net.stream_inbox import StreamInbox
from zstate.net.streams import KeyPublisher, StreamSubscriber, capacity_for
from zstate.wire.protocol import SerializedSample

KEY = "zstate/r/joint_states"
ENCODING = "zstate/JointState;v=1"


def test_samples_arrive_in_order_with_key_and_encoding(sessions):
    got: list[SerializedSample] = []
    with (
        KeyPublisher(sessions[0], KEY, ENCODING) as publisher,
        StreamSubscriber(sessions[1], "zstate/*/joint_states", got.extend) as subscriber,
    ):
        until(lambda: publisher.has_readers)
        for number in range(100):
            publisher.put(bytes([number]))
        until(lambda: len(got) == 100)
    assert got == [SerializedSample(KEY, bytes([number]), ENCODING) for number in range(100)]
    assert (subscriber.full_batches, subscriber.failures) == (0, 0)


def test_other_readers_and_writers_of_a_session_continue_when_one_reader_closes(sessions):
    here, there = sessions
    ours, theirs = "zstate/ours/joint_states", "zstate/theirs/joint_states"
    gone: list[SerializedSample] = []
    received: dict[str, list[SerializedSample]] = {"here": [], "there": []}
    many = "zstate/*/joint_states"
    with (
        KeyPublisher(here, ours, "") as mine,
        KeyPublisher(there, theirs, "") as other,
        StreamSubscriber(here, many, received["here"].extend),
        StreamSubscriber(there, many, received["there"].extend),
    ):

        def all_receive(payload: bytes) -> bool:
            mine.put(payload)
            other.put(payload)
            expected = {(ours, payload), (theirs, payload)}
            return all(
                expected <= {(arrival.key, arrival.payload) for arrival in one} for one in received.values()
            )

        with StreamSubscriber(here, many, gone.extend):
            until(lambda: all_receive(b"while both are there"))  # discovery may take a moment
            until(lambda: {arrival.key for arrival in gone} == {ours, theirs})
        until(lambda: all_receive(b"afterwards"))
    assert {arrival.payload for arrival in gone} == {b"while both are there"}


def test_attachment_arrives_with_its_sample(sessions):
    got: list[SerializedSample] = []
    with (
        KeyPublisher(sessions[0], KEY, "") as publisher,
        StreamSubscriber(sessions[1], KEY, got.extend),
    ):
        until(lambda: publisher.has_readers)
        publisher.put(b"payload", b"attached")
        until(lambda: got)
    assert (got[0].payload, got[0].attachment) == (b"payload", b"attached")


def test_has_readers_follows_the_subscribers(sessions):
    with KeyPublisher(sessions[0], KEY, ENCODING) as publisher:
        assert not publisher.has_readers
        with StreamSubscriber(sessions[1], KEY, lambda samples: None):
            until(lambda: publisher.has_readers)
        until(lambda: not publisher.has_readers)


def test_8192_samples_wait_for_a_reader_of_several_keys_and_1024_for_that_of_one():
    assert capacity_for(("zstate/*/joint_states",)) == 8192
    assert capacity_for(("zstate/r1/joint_states", "zstate/r2/joint_states")) == 8192
    assert capacity_for(("zstate/r1/joint_states",)) == 1024


@pytest.mark.parametrize("key", ["zstate/r1/cloud/front", "zstate/*/cloud/*"])
def test_8_samples_of_bulk_data_wait_for_a_reader(key: str):
    assert capacity_for((key,), is_bulk=True) == 8


@pytest.mark.parametrize(("is_bulk", "received", "size"), [(False, 1, 16_785_409), (True, 5_000_000, 0)])
def test_samples_above_1_mb_are_received_as_bulk_data_only(sessions, is_bulk: bool, received: int, size: int):
    got: list[SerializedSample] = []
    with (
        KeyPublisher(sessions[0], KEY, ENCODING, is_bulk=True) as publisher,
        StreamSubscriber(sessions[1], KEY, got.extend, is_bulk=is_bulk),
    ):
        until(lambda: publisher.has_readers)
        with repeated(lambda: publisher.put(bytes(5_000_000)), every_s=0.05):  # congestion drops some
            until(lambda: got)
    assert (len(got[0].payload), got[0].size) == (received, size)


def test_slow_reader_receives_the_newest_samples_and_full_batches_are_counted(sessions):
    batches: list[list[int]] = []
    seen: list[SerializedSample] = []
    busy, go_on = threading.Event(), threading.Event()

    def slow(samples: list[SerializedSample]) -> None:
        batches.append([int(sample.payload) for sample in samples])
        busy.set()
        assert go_on.wait(10)

    with (
        KeyPublisher(sessions[0], KEY, ENCODING) as publisher,
        StreamSubscriber(sessions[1], KEY, slow, capacity=8) as subscriber,
        StreamSubscriber(sessions[1], KEY, seen.extend),
    ):
        until(lambda: publisher.has_readers)
        publisher.put(b"0")
        assert busy.wait(10)
        for number in range(1, 101):
            publisher.put(str(number).encode())
        until(lambda: len(seen) == 101)  # the other reader of the session is not delayed
        assert subscriber.full_batches == 0
        go_on.set()
        until(lambda: len(batches) == 2)
        assert batches == [[0], list(range(93, 101))]
        assert subscriber.full_batches == 1


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_failing_callback_is_counted_reported_once_and_called_again(
    sessions, monkeypatch: pytest.MonkeyPatch
):
    reported: list[object] = []
    monkeypatch.setattr(threading, "excepthook", lambda arguments: reported.append(arguments.exc_value))

    def raises(samples: list[SerializedSample]) -> None:
        raise RuntimeError(str(samples[0].payload))

    with (
        KeyPublisher(sessions[0], KEY, ENCODING) as publisher,
        StreamSubscriber(sessions[1], KEY, raises) as subscriber,
    ):
        until(lambda: publisher.has_readers)
        for failures in (1, 2, 3):
            publisher.put(b"x")
            until(lambda count=failures: subscriber.failures == count)
    assert [str(error) for error in reported] == ["b'x'"]


def test_a_subscriber_may_be_closed_twice_and_from_its_own_thread(sessions):
    closed = threading.Event()
    got: list[SerializedSample] = []

    def close_myself(samples: list[SerializedSample]) -> None:
        got.extend(samples)
        subscriber.close()
        closed.set()

    with KeyPublisher(sessions[0], KEY, ENCODING) as publisher:
        subscriber = StreamSubscriber(sessions[1], KEY, close_myself)
        until(lambda: publisher.has_readers)
        publisher.put(b"1")
        assert closed.wait(10)
        until(lambda: not publisher.has_readers)
        subscriber.close()
    assert len(got) == 1


def test_close_does_not_wait_for_a_reader_that_is_busy(sessions):
    busy, go_on = threading.Event(), threading.Event()
    went_on: list[bool] = []

    def hold(samples: list[SerializedSample]) -> None:
        busy.set()
        went_on.append(go_on.wait(DEADLINE_S))

    with KeyPublisher(sessions[0], KEY, ENCODING) as publisher:
        subscriber = StreamSubscriber(sessions[1], KEY, hold)
        until(lambda: publisher.has_readers)
        publisher.put(b"1")
        assert busy.wait(DEADLINE_S)
        subscriber.close()
        go_on.set()
        until(lambda: went_on)
        assert went_on == [True], "it was closed before the reader gave up waiting"


@pytest.mark.parametrize("keys", [KEY, (KEY, "zstate/q/joint_states")], ids=["a ring", "several keys"])
def test_a_subscriber_that_finishes_delivers_what_has_arrived(sessions, keys: str | tuple[str, ...]):
    busy, go_on = threading.Event(), threading.Event()
    got: list[bytes] = []

    def hold(samples: list[SerializedSample]) -> None:
        got.extend(sample.payload for sample in samples)
        busy.set()
        go_on.wait(DEADLINE_S)

    with (
        KeyPublisher(sessions[0], KEY, ENCODING) as publisher,
        StreamSubscriber(sessions[0], keys, hold) as slow,
    ):
        until(lambda: publisher.has_readers)
        publisher.put(b"1")
        assert busy.wait(DEADLINE_S)
        for payload in (b"2", b"3"):  # of this session, so they have arrived
            publisher.put(payload)
        finishing = threading.Thread(target=slow.finish, args=(DEADLINE_S,))
        finishing.start()
        until(lambda: not publisher.has_readers)
        go_on.set()
        finishing.join(DEADLINE_S)
        assert got == [b"1", b"2", b"3"]


def test_a_closed_session_ends_the_threads_of_its_subscribers():
    session = connect()
    subscriber = StreamSubscriber(session, KEY, lambda samples: None)
    session.close()
    began = time.monotonic()
    subscriber.finish(DEADLINE_S)
    assert time.monotonic() - began < DEADLINE_S, "nothing is delivered any more, and nothing waited for"
    until(lambda: "zstate receiver" not in [thread.name for thread in threading.enumerate()])
    subscriber.close()


def test_put_after_close_raises_closed(sessions):
    publisher = KeyPublisher(sessions[0], KEY, ENCODING)
    publisher.close()
    publisher.close()
    with pytest.raises(Closed, match=KEY):
        publisher.put(b"")
    other = KeyPublisher(sessions[0], KEY, ENCODING)
    sessions[0].close()
    with pytest.raises(Closed, match="session is closed"):
        other.put(b"")
    other.close()


def test_an_inbox_keeps_the_newest_samples_with_their_arrivals_and_reports_each_that_is_lost(sessions):
    lost: list[None] = []
    with (
        StreamInbox(sessions[0], "test/inbox", 3, lambda: lost.append(None)) as inbox,
        KeyPublisher(sessions[1], "test/inbox", "text/plain") as publisher,
    ):
        until(lambda: publisher.has_readers)
        assert inbox.drain() == []
        before = time.monotonic_ns()
        for number in range(5):
            publisher.put(str(number).encode(), b"attached")
        until(lambda: len(lost) == 2)
        drained = inbox.drain()
        assert [sample.payload for _, sample in drained] == [b"2", b"3", b"4"]
        assert {(one.key, one.encoding, one.attachment) for _, one in drained} == {
            ("test/inbox", "text/plain", b"attached")
        }
        arrivals = [before, *(arrived for arrived, _ in drained), time.monotonic_ns()]
        assert arrivals == sorted(arrivals)
        assert inbox.drain() == []
