"""Samples inserted in one call of the extension: the same buffer, counts and events as by the long way.

Messages are handed to two listeners without a network. One gets each message as its subscriber would hand it
over, first alone and then, if that inserts nothing, in a list; the other gets lists only.
"""

from __future__ import annotations

import random
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import astuple

import numpy as np
import pytest
from helpers.processes import until
from helpers.robots import RRBOT, SECOND, UPRIGHT, wait_for_reader, wait_for_stream_readers

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.clock import SIMULATED, ManualClock
from zstate.extension import kernel
from zstate.ingest.base import StreamIngest
from zstate.model.load import load_model
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.transform import Transform
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    Sample,
    TransformSample,
    WriterTransforms,
    order_digest,
    to_block,
)
from zstate.wire.native import encode, encoding_of
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire
from zstate.wire.ros2.encoder import JointStateEncoder
from zstate.wire.ros2.graph import pack_attachment

pytestmark = pytest.mark.skipif(kernel == "reference", reason="only the extension has a fast path")

OTHER = load_model(RRBOT.urdf.replace('name="shoulder"', 'name="first"'))
LONGER = load_model(RRBOT.urdf.replace('xyz="0 0 0.6"', 'xyz="0 0 0.9"'))
MILLISECOND = 1_000_000
MESSAGES = 80
SEEDS = range(20)


def description(model=RRBOT, session: int = 1) -> RobotDescription:
    edges = tuple((joint.parent, joint.child) for joint in model.joints if joint.type != "fixed")
    return RobotDescription(session, model.urdf, model.digest, model.joint_names, edges)


class Receiver:
    """A listener without a network, and how many samples it inserted in one call."""

    def __init__(self, session: Session, robot: str, follow: str, wire: str, *, is_fast: bool) -> None:
        buffer, options = TransformBuffer(history_s=2.0), {"follow": follow, "history_on_join": False}
        self.listener = TransformListener(
            session, robot, buffer, wire, on_event=lambda event: None, **options
        )
        self.is_fast = is_fast
        self.inserted_at_once = 0

    def receive(self, stream: str, arrivals: list[SerializedSample]) -> None:
        samples = self.listener._reader.ingests.streams[stream]
        if self.is_fast:
            arrivals = [one for one in arrivals if not self._insert_next(samples, one)]
        if arrivals:
            self.listener._reader._on_samples(samples, arrivals)

    def _insert_next(self, samples, arrival: SerializedSample) -> bool:
        envelope = self.listener._wire.usual_envelope(samples.stream)
        attached = arrival.attachment or b""
        is_usual = (arrival.encoding, len(attached)) == envelope
        message = arrival.payload + attached if is_usual else None
        inserted = self.listener._reader._insert_next(samples, arrival.key, message)
        self.inserted_at_once += inserted
        return inserted

    def followed(self, session: int) -> StreamIngest:
        """The ingest of the followed samples of "r1"."""
        ingests = self.listener._reader.ingests
        return ingests.find(ingests.followed, "r1", session)

    def ingests(self) -> Iterator[StreamIngest]:
        for samples in self.listener._reader.ingests.streams.values():
            yield from samples.all()

    def state(self) -> dict[str, object]:
        """Everything a user can see, and what decides on later samples."""
        buffer = self.listener.buffer
        tracks = [
            (repr(track), track.writer, track.history.view.kept_stamps().tolist(), rows_of(track))
            for track in buffer._tree.moving()
        ]
        ingests = list[object]()
        for ingest in self.ingests():
            with ingest._lock:  # takes over what the fast path has advanced
                late = None if ingest._last_late is None else ingest._last_late.seq
                newest = getattr(ingest, "_newest_by_order", ingest._newest)
                missing = list(ingest._numbers.missing._ranges)
                ingests.append((ingest.robot, ingest.session, ingest._numbers.next, newest, late, missing))
        events = [(event.kind, event.robot, event.stream, event.text) for event in self.listener.events()]
        stats = astuple(self.listener.stats)
        return {
            "stats": stats,
            "refusals": self.listener.refusals,
            "ignored": buffer.ignored,
            "tracks": tracks,
            "ingests": ingests,
            "events": events,
            "frames": [(frame.name, frame.parent, frame.kind, frame.count) for frame in buffer.frames()],
        }


def rows_of(track) -> list[list[str]]:
    # As text: NaN equals itself, and the numbers are compared bit by bit.
    return [[number.hex() for number in row] for row in track.history.view.kept_rows().tolist()]


@contextmanager
def pair(
    session: Session, robot: str, follow: str, wire: str = "native"
) -> Iterator[tuple[Receiver, Receiver]]:
    fast, slow = (Receiver(session, robot, follow, wire, is_fast=is_fast) for is_fast in (True, False))
    with fast.listener, slow.listener:
        yield fast, slow


class Writer:
    """One writer's messages: mostly the usual next one, at times anything else."""

    def __init__(self, seed: int, key: str, kind: type[Sample], session: int) -> None:
        self.random = random.Random(seed)
        self.key, self.kind, self.session = key, kind, session
        self.seq = self.random.choice((0, 0, 5, 100, 2**16 - 9, 2**32 - 9, 2**63 - 20))
        self.stamp = time.time_ns() - SECOND // 2
        self.sent: list[SerializedSample] = []
        self.layout = 0

    def arrivals(self) -> list[SerializedSample]:
        """The next messages, mostly one."""
        actions = (self.reordered, self.repeated, self.after_a_gap, self.at_another_time, self.other_layout)
        actions += (self.restarted, self.hostile, self.hostile, self.hostile)
        return [self.good()] if self.random.random() < 0.8 else self.random.choice(actions)()

    def reordered(self) -> list[SerializedSample]:
        return [self.good(), self.good()][::-1]

    def repeated(self) -> list[SerializedSample]:
        return self.sent[-self.random.randrange(1, 4) :][:1]

    def after_a_gap(self) -> list[SerializedSample]:
        self.seq += self.random.choice((1, 3))
        return [self.good()]

    def at_another_time(self) -> list[SerializedSample]:
        before = self.stamp
        self.stamp += self.random.choice((-2000, -1100, -150, 70, 700, 90_000)) * MILLISECOND
        several = [self.good() for _ in range(self.random.randrange(1, 4))]
        self.stamp = self.random.choice((before, before, self.stamp))
        return several

    def other_layout(self) -> list[SerializedSample]:
        self.layout = self.random.randrange(4)
        return [self.good()]

    def restarted(self) -> list[SerializedSample]:
        self.session += self.random.choice((1, 1, 1, -1))
        return [self.good()]

    def good(self) -> SerializedSample:
        return self.after(self.random.choice((0, 1, 10, 10, 10, 10)) * MILLISECOND)

    def after(self, period_ns: int) -> SerializedSample:
        """The next sample, stamped so long after the last one."""
        self.seq += 1
        self.stamp += period_ns
        arrival = self.serialized(self.sample())
        self.sent.append(arrival)
        return arrival

    def serialized(self, sample: Sample) -> SerializedSample:
        return SerializedSample(self.key, encode(sample), encoding_of(self.kind))

    def not_finite(self, payload: bytes) -> bytes:
        numbers = to_block([self.random.choice((np.nan, np.inf)), 1.0])
        return payload.replace(payload[-19:-3], numbers)

    def sample(self) -> Sample:
        numbers = np.random.default_rng(self.seq % 1000)
        head = self.stamp, self.seq, self.session
        if self.kind is JointState:
            order = RRBOT.joint_names if self.layout < 3 else RRBOT.joint_names[::-1]
            rates = to_block(numbers.normal(size=2)) if self.layout in (1, 2) else None
            efforts = to_block(numbers.normal(size=2)) if self.layout == 2 else None
            names = order if self.layout == 3 else None
            return JointState(
                *head, order_digest(order), to_block(numbers.normal(size=2)), rates, efforts, names
            )
        edges = ((("odom", "cart"),), (("odom", "cart"), ("cart", "lamp")), (("lamp", "tool"),))[
            self.layout % 3
        ]
        if self.kind is TransformSample and self.layout == 2:
            edges = description().moving_edges
        poses = numbers.normal(size=(len(edges), 7))
        poses[:, 3:] = UPRIGHT
        poses[:, 6] += 1e-4
        named = None if self.kind is TransformSample and self.layout == 2 else edges
        if self.kind is WriterTransforms and self.layout == 3:
            covariances = to_block(np.ones(21 * len(edges)))
            return WriterTransforms(*head, order_digest(edges), to_block(poses), named, covariances)
        return self.kind(*head, order_digest(edges), to_block(poses), named)

    def hostile(self) -> list[SerializedSample]:
        arrival = self.good()
        key, payload, encoding, choose = arrival.key, arrival.payload, arrival.encoding, self.random
        at = choose.randrange(len(payload))
        flipped = bytes([payload[at] ^ 1 << choose.randrange(8)])
        damaged = (
            payload[:at],
            payload + b"\xc0",
            self.not_finite(payload),
            payload[:at] + flipped + payload[at + 1 :],
            payload[:at] + flipped + payload[at + 1 :],
        )
        foreign = SerializedSample(key, payload, "zstate/JointState;v=2")
        attached = SerializedSample(key, payload, encoding, b"attached")
        others = [SerializedSample(key, one, encoding) for one in damaged]
        return [choose.choice((foreign, attached, *others))]


class RosWriter(Writer):
    """A ROS node that writes /joint_states: CDR, and an attachment that may be damaged, too."""

    def __init__(self, seed: int, key: str, session: int) -> None:
        super().__init__(seed, key, JointState, session)
        self.seq %= 2**62  # it has 64 bits with sign

    def serialized(self, sample: Sample) -> SerializedSample:
        assert isinstance(sample, JointState)
        encoder = JointStateEncoder(sample.names or RRBOT.joint_names, frame_id="base")
        payload = encoder.encode(sample.stamp, sample.positions, sample.velocities, sample.efforts)
        gid = sample.session.to_bytes(8, "little") + bytes(8)
        return SerializedSample(
            self.key, payload, "", pack_attachment(sample.seq, self.random.randrange(2**60), gid)
        )

    def not_finite(self, payload: bytes) -> bytes:
        return payload[:-8] + struct.pack("<d", self.random.choice((np.nan, np.inf)))

    def hostile(self) -> list[SerializedSample]:
        (arrival,) = super().hostile()
        attached, at = self.good().attachment or b"", self.random.randrange(33)
        flipped = attached[:at] + bytes([attached[at] ^ 1 << self.random.randrange(8)]) + attached[at + 1 :]
        moved = SerializedSample(self.key, arrival.payload[:-1], "", arrival.payload[-1:] + attached)
        others = (b"", attached[:-1], attached + b"\0", flipped, flipped)
        damaged = [SerializedSample(self.key, arrival.payload, "", one) for one in others]
        return [self.random.choice((arrival, moved, *damaged))]


def interrupt(receiver: Receiver, action: int, writer: Writer, stream: str) -> None:
    """What other threads do between two samples."""
    buffer, session = receiver.listener.buffer, writer.session
    for ingest in list(receiver.ingests()):
        if action == 0:
            ingest.describe(description(LONGER, session))
        elif action <= 2:
            ingest.describe(description(session=session))
        elif action == 3:
            ingest.name_writer(session, f"writer of {session}")
        elif action == 4:
            ingest.writer_left(session)
            ingest.name_writer(session, "the same writer, which is back")
        elif action == 5:
            decoded = [receiver.listener._reader._decode(stream, one, "r1") for one in writer.sent[-5:]]
            samples = [one for messages in decoded for one in messages if one.session == ingest.session]
            if samples:
                ingest.insert_history(samples)
    if action == 6:
        buffer.clear()
    elif action == 7:
        buffer.insert_static(Transform("r1/tool", f"r1/hook{writer.seq % 2}", (0, 0, 0), UPRIGHT))
    elif action == 8 and "r1/cart" in buffer._tree.frames:
        # Splits the track of several edges.
        buffer.insert(Transform("r1/odom", "r1/cart", (1, 2, 3), UPRIGHT, writer.stamp - 30 * MILLISECOND))


@pytest.mark.parametrize("robot", ["r1", "*"])
@pytest.mark.parametrize(
    ("follow", "stream", "kind"),
    [
        ("joint_states", "joint_states", JointState),
        ("tf", "tf", TransformSample),
        ("joint_states", "transforms", WriterTransforms),
    ],
)
@pytest.mark.long
def test_any_messages_give_the_same_buffer_counts_and_events(sessions, robot, follow, stream, kind):
    """Writers reorder, repeat, lose and forge messages; clocks jump; other threads change the buffer."""
    key = "zstate/r1/transforms/odometry" if stream == "transforms" else f"zstate/r1/{stream}"
    assert_same_result(
        lambda: pair(sessions[1], robot, follow), lambda seed: Writer(seed, key, kind, session=7), stream
    )


@pytest.mark.long
def test_any_joint_states_of_ros_give_the_same_buffer_counts_and_events(sessions, monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    key = get_wire("ros2").expression("r1", "joint_states")
    assert_same_result(
        lambda: pair(sessions[1], "r1", "joint_states", "ros2"),
        lambda seed: RosWriter(seed, key, session=7),
        "joint_states",
    )


def assert_same_result(
    make_pair: Callable[[], AbstractContextManager[tuple[Receiver, Receiver]]],
    make_writer: Callable[[int], Writer],
    stream: str,
) -> None:
    at_once = 0
    for seed in SEEDS:
        choose = random.Random(seed)
        writer = make_writer(seed)
        with make_pair() as receivers:
            for receiver in receivers:
                receiver.followed(1).describe(description())
            for _ in range(MESSAGES):
                batch = [arrival for _ in range(choose.choice((1, 1, 1, 3))) for arrival in writer.arrivals()]
                for receiver in receivers:
                    receiver.receive(stream, batch)
                if choose.random() < 0.08:
                    action = choose.randrange(9)
                    for receiver in receivers:
                        interrupt(receiver, action, writer, stream)
                if choose.random() < 0.2:
                    assert receivers[0].state() == receivers[1].state(), seed
            fast, slow = receivers
            assert fast.state() == slow.state(), seed
            at_once += fast.inserted_at_once
    assert at_once > len(SEEDS) * MESSAGES // 8  # else little was compared


def at_once(listener: TransformListener) -> int:
    """How many samples the extension inserted and counted by itself."""
    return listener._counters.for_robot("r1").fast_counts.get("received", 0)


@pytest.mark.parametrize("robot", ["r1", "*"])
def test_nearly_all_samples_of_a_publisher_take_one_call(sessions, robot):
    writer, reader = sessions
    seen, batches = list[int | None](), list[int]()
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, robot, history_on_join=False) as listener,
    ):
        listener.buffer.watch("r1/base", "r1/tool", lambda transform: seen.append(transform.stamp))
        listener.add_observer(lambda: batches.append(listener.stats.received))
        wait_for_stream_readers(writer, "r1")
        until(lambda: feed_of(listener.buffer).domain.domain_of("r1") == "system")
        stamps = list[int]()
        for number in range(50):
            stamps.append(time.time_ns())
            publisher.publish([0.01 * number, 0.0], stamp=stamps[-1])
            until(lambda: seen and seen[-1] == stamps[-1])
        assert at_once(listener) >= 45
        assert (listener.stats.received, listener.stats.missed, listener.stats.refused) == (50, 0, {})
    assert seen[-50:] == stamps
    assert 50 in batches


def test_samples_with_velocities_take_one_call(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1", history_on_join=False) as listener,
    ):
        wait_for_stream_readers(writer, "r1")
        until(lambda: feed_of(listener.buffer).domain.domain_of("r1") == "system")
        for number in range(20):
            publisher.publish([0.0, 0.0], [0.5 * number, -1.0])
            until(lambda number=number: listener.stats.received == number + 1)
        assert at_once(listener) >= 15
        velocities = listener.buffer.joint_states("r1").velocities
    assert velocities is not None
    assert velocities.tolist() == [[0.5 * number, -1.0] for number in range(20)]


def test_joint_states_of_ros_take_one_call(sessions, monkeypatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    writer, reader = sessions
    # Without tf: a listener also receives, and counts, /tf until it has all tokens of a state publisher.
    streams = ("robot_description", "joint_states")
    with (
        StatePublisher(writer, RRBOT, "r1", "ros2", streams=streams) as publisher,
        TransformListener(reader, "r1", wire="ros2") as listener,
    ):
        wait_for_reader(writer, get_wire("ros2").expression("r1", "joint_states"))
        for number in range(20):
            publisher.publish([0.01 * number, 0.0], [0.5, -1.0 * number])
            until(lambda number=number: listener.stats.received == number + 1)
        assert at_once(listener) >= 15
        states = listener.buffer.joint_states("r1")
    assert states.positions.tolist() == [[0.01 * number, 0.0] for number in range(20)]
    assert states.velocities is not None
    assert states.velocities.tolist() == [[0.5, -1.0 * number] for number in range(20)]


def test_listener_with_another_clock_takes_the_long_way(sessions):
    writer, reader = sessions
    clock = ManualClock(time.time_ns(), SIMULATED)
    with (
        StatePublisher(writer, RRBOT, "r1", clock=clock) as publisher,
        TransformListener(reader, "r1", clock=clock, history_on_join=False) as listener,
    ):
        wait_for_stream_readers(writer, "r1")
        for number in range(20):
            clock.advance(0.01)
            publisher.publish([0.0, 0.0])
            until(lambda number=number: listener.stats.received == number + 1)
        assert at_once(listener) == 0


class CountingBuffer(TransformBuffer):
    """A buffer that overrides an insert, as one that measures each sample does."""

    counted = 0

    def insert_joints(self, *arguments) -> bool:
        self.counted += 1
        return super().insert_joints(*arguments)


def test_buffer_with_an_insert_of_its_own_gets_every_sample(sessions):
    writer, reader = sessions
    buffer = CountingBuffer()
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1", buffer, history_on_join=False) as listener,
    ):
        wait_for_stream_readers(writer, "r1")
        until(lambda: feed_of(buffer).domain.domain_of("r1") == "system")
        for number in range(20):
            publisher.publish([0.0, 0.0])
            until(lambda number=number: listener.stats.received == number + 1)
    assert buffer.counted == 20


def test_removed_robot_is_refused_as_by_the_long_way(sessions):
    writer = Writer(0, "zstate/r1/joint_states", JointState, session=7)
    with pair(sessions[1], "r1", "joint_states") as receivers:
        for receiver in receivers:
            receiver.followed(7).describe(description())
        for number in range(6):
            message = writer.after(MILLISECOND)
            for receiver in receivers:
                receiver.receive("joint_states", [message])
                if number == 3:
                    (ingest,) = receiver.ingests()
                    receiver.listener.buffer.remove_robot(ingest._track)
        assert receivers[0].inserted_at_once == 3
        for receiver in receivers:
            stats = receiver.listener.stats
            assert (stats.received, stats.refused) == (4, {"removed robot": 2})


def test_clock_that_is_set_back_starts_a_new_epoch_as_by_the_long_way(sessions):
    writer = Writer(0, "zstate/r1/joint_states", JointState, session=7)
    with pair(sessions[1], "r1", "joint_states") as receivers:
        for receiver in receivers:
            receiver.followed(7).describe(description())
        stamps = list[int]()
        for period_ms in (1, 1, 1, -500, 1, 1):
            message = writer.after(period_ms * MILLISECOND)
            stamps.append(writer.stamp)
            for receiver in receivers:
                receiver.receive("joint_states", [message])
        # Two samples show that the clock was set back; the second one is the first of the new epoch.
        for receiver in receivers:
            assert receiver.listener.buffer.joint_states("r1").stamps.tolist() == stamps[-2:]
            assert [event.kind for event in receiver.listener.events()] == ["set back"]


@pytest.mark.parametrize("round_number", range(8))
def test_no_sample_is_lost_to_other_threads(sessions, round_number):
    """History arrives, the writer is announced, and its track is split, while samples are inserted."""
    writer = Writer(0, "zstate/r1/transforms/odometry", WriterTransforms, session=7)
    writer.layout, writer.seq = 1, 100
    messages = [writer.after(MILLISECOND // 10) for _ in range(2000)]
    past, live = messages[:5], messages[5:]
    receiver = Receiver(sessions[1], "r1", "joint_states", "native", is_fast=True)
    with receiver.listener as listener:
        receiver.receive("transforms", live[:1])
        (ingest,) = receiver.ingests()
        samples = [message for one in past for message in listener._reader._decode("transforms", one, "r1")]
        is_done = threading.Event()

        def disturb() -> None:
            while listener.stats.received < 100 * round_number:
                pass
            listener.buffer.insert(Transform("r1/odom", "r1/cart", (0, 0, 0), UPRIGHT, samples[0].stamp - 1))
            while not is_done.is_set():
                ingest.insert_history(samples)
                ingest.name_writer(7, "a writer")

        thread = threading.Thread(target=disturb)
        thread.start()
        for message in live[1:]:
            receiver.receive("transforms", [message])
        until(lambda: listener.stats.recalled == len(past))
        is_done.set()
        thread.join()
        stats = listener.stats
        assert (stats.received, stats.recalled, stats.missed, stats.refused) == (len(live), len(past), 0, {})
        counts = {frame.name: frame.count for frame in listener.buffer.frames() if frame.parent}
    assert counts == {"r1/cart": len(messages) + 1, "r1/lamp": len(messages)}
