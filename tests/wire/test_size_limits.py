"""Size limits: a payload too large for its stream is refused before decoding; queues are bounded in bytes."""

from __future__ import annotations

from functools import partial

import pytest
from helpers.processes import DEADLINE_S, repeated, until
from helpers.robots import RRBOT, wait_for_stream_readers

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import MessageError
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_states import JointStateIngest
from zstate.net.latched import LatchedPublisher
from zstate.net.session import connect
from zstate.net.streams import KeyPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.stream_registry import stream_named
from zstate.wire.messages import JointState, StaticTransforms, Status, order_digest
from zstate.wire.native import NativeWire, decode, encode, encoding_of
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire

ORDER = order_digest(("a",))


def statics(count: int) -> StaticTransforms:
    pose = bytes(8 * 7)
    return StaticTransforms(1, tuple(("", str(number)) for number in range(count)), pose * count)


@pytest.mark.parametrize("wire", ["native", "ros2"])
@pytest.mark.parametrize("stream", ["joint_states", "tf", "tf_static", "robot_description"])
def test_each_stream_has_a_largest_payload(wire, stream):
    size = 4 * stream_named(stream).max_bytes + 1
    for arrival in (
        SerializedSample("key", bytes(size), "any"),
        SerializedSample("key", b"\0", "any", None, size),
    ):
        with pytest.raises(MessageError) as caught:
            get_wire(wire).decode(stream, arrival, "r1")
        assert caught.value.reason == "too large"


def test_more_than_ten_thousand_static_edges_are_too_many():
    def arrival(count: int) -> SerializedSample:
        return SerializedSample(
            "zstate/r1/tf_static/w", encode(statics(count)), encoding_of(StaticTransforms)
        )

    assert NativeWire().decode("tf_static", arrival(10_000), "r1")
    with pytest.raises(MessageError, match="10001 static edges"):
        NativeWire().decode("tf_static", arrival(10_001), "r1")


def test_messages_without_a_stream_have_a_limit_too():
    with pytest.raises(MessageError) as caught:
        decode(bytes(64_001), encoding_of(Status), Status)
    assert caught.value.reason == "too large"


@pytest.mark.parametrize(("size", "kept"), [(0, 1024), (200_000, 2**22 // 200_000)], ids=["1024", "4 MiB"])
def test_of_samples_that_wait_for_a_description_the_newest_1024_or_4_mib_are_kept(size: int, kept: int):
    counters = Counters()
    ingest = JointStateIngest("r1", FrameOwnership(TransformBuffer(), counters))
    for seq in range(kept + 1):
        assert counters.stats().refused == {}
        ingest.insert_sample(JointState(seq, seq, 1, ORDER, bytes(size)), overflowed=False)
    assert counters.stats().refused == {"no description": 1}


def test_too_large_messages_are_counted_and_later_ones_are_inserted(sessions):
    writer, reader = sessions
    with (
        # A session of its own: Zenoh's caches, as those of the publisher, do not reply while a link is full.
        connect() as strange,
        KeyPublisher(strange, "zstate/r2/joint_states", encoding_of(JointState)) as stranger,
        LatchedPublisher(
            strange, "zstate/r1/tf_static/mount", encoding_of(StaticTransforms), is_large=True
        ) as mount,
        TransformListener(reader) as listener,
        StatePublisher(writer, RRBOT, "r1") as publisher,
    ):
        until(lambda: stranger.has_readers)
        one = StaticTransforms(1, (("tool", "camera"),), bytes(8 * 6) + b"\0\0\0\0\0\0\xf0\x3f")
        mount.set(encode(one))
        until(lambda: "r1/camera" in [frame.name for frame in listener.buffer.frames()])

        def refused() -> int:
            return listener.stats.refused.get("too large", 0)

        for size in (300_000, 5_000_000):
            # Zenoh drops samples of a stream rather than wait for a busy link.
            before = refused()
            with repeated(partial(stranger.put, bytes(size)), every_s=0.1):
                until(lambda: refused() > before)  # noqa: B023
        before = refused()
        mount.set(bytes(1_100_000))
        mount.set(bytes(17_000_000))
        until(lambda: refused() >= before + 2)
        assert set(listener.stats.refused) == {"too large"}
        wait_for_stream_readers(writer, "r1")
        publisher.publish([0.5, 0.5])
        # What was latched before still holds: the value was not withdrawn.
        listener.buffer.wait("r1/world", "r1/camera", timeout_s=DEADLINE_S)
