import itertools
import random
import struct
import tracemalloc

import numpy as np
import pytest
from helpers.manual_cdr import STORE, Edges, cdr, rosbags_tf_message, tf_message
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import InvalidInput, MessageError
from zstate.wire.messages import to_block
from zstate.wire.ros2.decoder import RosTransforms, TfMessageDecoder
from zstate.wire.ros2.encoder import TfMessageEncoder

STAMP = 1_700_000_000_123_456_789
STAMPS = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
POSE = [1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8]


def edges_of(count: int, longer: int = 0) -> tuple[tuple[str, str], ...]:
    """Edges whose names' lengths go through all pairs of remainders of 8."""
    names = [f"link{number}".ljust(6 + (number * (1 + longer)) % 8, "x") for number in range(count + 1)]
    return tuple(itertools.pairwise(names))


def poses_of(count: int) -> np.ndarray:
    return np.arange(7.0 * count).reshape(count, 7) - 3.5


# One edge by the specification; the offsets count from the fifth byte.
GOLDEN = b"\x00\x01\x00\x00" + struct.pack(
    "<I iI I4s I2s 6x 7d",
    1,
    *(1_700_000_000, 123_456_789),
    *(4, b"map\0"),  # from 12 to 20
    *(2, b"b\0"),  # from 20 to 26: six to skip, up to 32
    *POSE,
)


def test_a_small_message_has_the_bytes_of_the_specification():
    assert TfMessageEncoder((("map", "b"),)).encode(STAMP, to_block(POSE)) == GOLDEN
    assert TfMessageDecoder().decode(GOLDEN) == RosTransforms(
        STAMP, (STAMP,), (("map", "b"),), to_block(POSE)
    )


@pytest.mark.parametrize("count", [*range(9), 40])
def test_the_bytes_are_those_of_rosbags(count: int):
    for longer in range(8):
        edges, poses = edges_of(count, longer), poses_of(count)
        theirs = rosbags_tf_message([STAMP] * count, edges, poses.tolist())
        assert TfMessageEncoder(edges).encode(STAMP, to_block(poses)) == theirs
        decoder = TfMessageDecoder()
        expected = (STAMP if count else None, (STAMP,) * count, edges, to_block(poses))
        for _ in range(2):  # value by value, then at once
            assert decoder.decode(theirs) == expected


@given(STAMPS, st.lists(st.tuples(TEXTS, TEXTS), max_size=5), st.randoms(use_true_random=False))
def test_transforms_round_trip_and_equal_the_reading_of_rosbags(
    stamp: int, edges: list[tuple[str, str]], dice: random.Random
):
    poses = [[dice.uniform(-1e3, 1e3) for _ in range(7)] for _ in edges]
    payload = TfMessageEncoder(tuple(edges)).encode(stamp, to_block(poses))
    found = TfMessageDecoder().decode(payload)
    assert found == (stamp if edges else None, (stamp,) * len(edges), tuple(edges), to_block(poses))
    theirs = STORE.deserialize_cdr(payload, "tf2_msgs/msg/TFMessage").transforms
    assert [(one.header.frame_id, one.child_frame_id) for one in theirs] == edges
    assert {(one.header.stamp.sec, one.header.stamp.nanosec) for one in theirs} <= {divmod(stamp, 10**9)}
    for one, pose in zip(theirs, poses, strict=True):
        parts = one.transform.translation, one.transform.rotation
        assert [getattr(part, axis) for part in parts for axis in "xyzw" if hasattr(part, axis)] == pose


@given(st.lists(STAMPS, min_size=1, max_size=6))
def test_each_transform_keeps_its_own_stamp(stamps: list[int]):
    edges, poses = edges_of(len(stamps)), poses_of(len(stamps))
    theirs = rosbags_tf_message(stamps, edges, poses.tolist())
    shared = stamps[0] if stamps.count(stamps[0]) == len(stamps) else None
    decoder = TfMessageDecoder()
    for _ in range(2):
        assert decoder.decode(theirs) == (shared, tuple(stamps), edges, to_block(poses))


def test_big_endian_messages_are_read_alike():
    edges, poses = edges_of(7), poses_of(7)
    theirs = rosbags_tf_message([-1] * 7, edges, poses.tolist(), little_endian=False)
    assert theirs == cdr(tf_message([-1] * 7, edges, poses.tolist()), ">")
    decoder = TfMessageDecoder()
    for _ in range(2):
        assert decoder.decode(theirs) == (-1, (-1,) * 7, edges, to_block(poses))


def test_padding_and_trailing_bytes_change_neither_result_nor_template():
    dice = random.Random(1)
    decoder = TfMessageDecoder()
    first = None
    for stamp in range(40):
        poses = poses_of(9) + stamp
        values = tf_message([stamp] * 9, edges_of(9), poses.tolist())
        found = decoder.decode(cdr(values, fill=dice.randbytes) + dice.randbytes(5))
        assert found == (stamp, (stamp,) * 9, edges_of(9), to_block(poses))
        first = first or found
        assert found.edges is first.edges


def test_templates_of_many_alternating_writers_are_cached():
    decoder = TfMessageDecoder()
    fleet: list[Edges] = [(("map", f"robot{number:02}/base"),) for number in range(60)]
    encoders = [TfMessageEncoder(tuple(edges)) for edges in fleet]
    rounds = [
        [decoder.decode(encoder.encode(stamp, to_block(POSE))).edges for encoder in encoders]
        for stamp in range(3)
    ]
    assert all(now is before for one in rounds[1:] for now, before in zip(one, rounds[0], strict=True))


def test_payloads_of_equal_length_with_other_frame_lengths_differ():
    decoder = TfMessageDecoder()
    for _ in range(3):
        for parent in range(1, 60):
            edges = (("p" * parent, "c" * (60 - parent)),)
            payload = TfMessageEncoder(edges).encode(5, to_block(POSE))
            assert decoder.decode(payload) == (5, (5,), edges, to_block(POSE))


@pytest.mark.long
def test_changing_frames_do_not_fill_the_memory():
    decoder = TfMessageDecoder()
    of_each_length = [
        cdr(tf_message([0], [("map", f"person0000{'x' * length}")], [POSE])) for length in range(9)
    ]
    tracemalloc.start()
    try:
        for number in range(5000):
            named = of_each_length[number % 9].replace(b"person0000", f"person{number:04}".encode())
            assert decoder.decode(named).edges[0][1].startswith(f"person{number:04}")
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < 8 * 2**20


def test_message_larger_than_the_cache_is_decoded_every_time():
    edges = tuple((f"frame{number}", "c" * 400) for number in range(2500))
    poses = to_block(np.ones((2500, 7)))
    payload = TfMessageEncoder(edges).encode(1, poses)
    assert len(payload) > 2**20
    decoder = TfMessageDecoder()
    answers = [decoder.decode(payload) for _ in range(2)]
    assert answers == [(1, (1,) * 2500, edges, poses)] * 2
    assert answers[0].edges is not answers[1].edges


@pytest.mark.parametrize("change", ["nanoseconds", "NUL"])
def test_message_of_a_cached_template_is_still_checked(change: str):
    decoder = TfMessageDecoder()
    decoder.decode(GOLDEN)
    broken = bytearray(GOLDEN)
    at, value = {"nanoseconds": (4 + 8, struct.pack("<I", 10**9)), "NUL": (4 + 19, b"x")}[change]
    broken[at : at + len(value)] = value
    for one in (decoder, TfMessageDecoder()):
        with pytest.raises(MessageError) as caught:
            one.decode(bytes(broken))
        assert caught.value.reason == "malformed"


@pytest.mark.parametrize("fresh", [True, False])
def test_a_message_cut_off_anywhere_is_truncated(fresh: bool):
    decoder = TfMessageDecoder()
    decoder.decode(GOLDEN)
    for length in range(len(GOLDEN)):
        with pytest.raises(MessageError) as caught:
            (TfMessageDecoder() if fresh else decoder).decode(GOLDEN[:length])
        assert caught.value.reason == "truncated"


@pytest.mark.parametrize("count", [2, 2**31, 2**32 - 1])
def test_more_transforms_than_there_are_bytes_is_truncated(count: int):
    broken = bytearray(GOLDEN)
    struct.pack_into("<I", broken, 4, count)
    with pytest.raises(MessageError) as caught:
        TfMessageDecoder().decode(bytes(broken))
    assert caught.value.reason == "truncated"


@pytest.mark.parametrize("size", [0, 55, 57, 112])
def test_block_without_one_pose_per_edge_is_refused(size: int):
    with pytest.raises(InvalidInput, match=f"1 edges need a block of 56 bytes.*not {size}"):
        TfMessageEncoder((("a", "b"),)).encode(0, bytes(size))


def test_names_and_stamps_that_ros_2_cannot_represent_are_refused():
    with pytest.raises(InvalidInput, match="NUL"):
        TfMessageEncoder((("a", "b\0"),))
    with pytest.raises(InvalidInput, match=f"{2**62}"):
        TfMessageEncoder((("a", "b"),)).encode(2**62, bytes(56))
