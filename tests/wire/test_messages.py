from hashlib import blake2b

import numpy as np
import pytest

from zstate.errors import InvalidInput
from zstate.wire.messages import (
    JointState,
    StaticTransforms,
    TransformSample,
    from_block,
    order_digest,
    poses_from_block,
    to_block,
)

EDGES = (("base", "arm"), ("arm", "hand"))


def test_block_is_little_endian_float64_for_any_array():
    # 1.0 is sign 0, exponent 1023, fraction 0: 3f f0 00 .. read from the high end
    assert to_block([1, -2]) == bytes.fromhex("000000000000f03f 00000000000000c0")
    big_endian = np.array([1.0, -2.0], dtype=">f8")
    every_other = np.array([1.0, 9.0, -2.0], dtype="f4")[::2]
    assert to_block(big_endian) == to_block(every_other) == to_block([1, -2])


def test_numbers_read_from_a_block_share_its_memory_and_cannot_be_written():
    block = to_block([0.1, np.nan, -np.inf])
    numbers = from_block(block)
    assert numbers.dtype == np.float64
    np.testing.assert_array_equal(numbers, [0.1, np.nan, -np.inf])
    with pytest.raises(ValueError, match="read-only"):
        numbers[0] = 1.0


def test_poses_are_rows_of_seven_even_without_poses():
    poses = np.arange(14.0).reshape(2, 7)
    np.testing.assert_array_equal(poses_from_block(to_block(poses)), poses)
    assert poses_from_block(b"").shape == (0, 7)


def test_the_order_digest_is_blake2b_of_the_names_as_a_messagepack_array():
    # MessagePack: fixarray of 2 = 92; fixstr of 1 byte = a1
    assert order_digest(["a", "b"]) == blake2b(b"\x92\xa1a\xa1b", digest_size=8).digest()
    assert order_digest([("a", "b")]) == blake2b(b"\x91\x92\xa1a\xa1b", digest_size=8).digest()


def test_orders_that_look_alike_have_different_digests():
    orders = [["a", "b"], ["b", "a"], ["ab"], ["a", "b", ""], [], ["a\0b"], [("a", "b")]]
    assert len({order_digest(order) for order in orders}) == len(orders)


def test_a_sequence_type_does_not_change_the_digest():
    assert order_digest(["a", "b"]) == order_digest(("a", "b"))
    assert order_digest(list(EDGES)) == order_digest(EDGES)


def test_a_message_cannot_be_made_with_a_block_of_the_wrong_length():
    order = order_digest(EDGES)
    with pytest.raises(InvalidInput, match="multiple of 8 bytes, not 7"):
        JointState(0, 0, 1, order, b"1234567")
    with pytest.raises(InvalidInput, match="multiple of 56 bytes, not 8"):
        TransformSample(0, 0, 1, order, to_block([1.0]))
    with pytest.raises(InvalidInput, match="2 edges need as many poses, not 1"):
        StaticTransforms(1, EDGES, to_block(np.zeros(7)))


def test_names_and_edges_sent_along_must_fit_their_digest_and_their_numbers():
    with pytest.raises(InvalidInput, match="not that of the order"):
        JointState(0, 0, 1, order_digest(["b"]), to_block([1.0]), names=("a",))
    with pytest.raises(InvalidInput, match="not that of the order"):
        TransformSample(0, 0, 1, order_digest(["b"]), to_block(np.zeros((2, 7))), EDGES)
    with pytest.raises(InvalidInput, match="1 names need as many numbers, not 2"):
        JointState(0, 0, 1, order_digest(["a"]), to_block([1.0, 2.0]), names=("a",))


def test_messages_are_frozen():
    state = JointState(0, 0, 1, order_digest([]), b"")
    with pytest.raises(AttributeError):
        state.stamp = 1  # type: ignore[misc]
