"""Payloads of RosStreamEncoder, decoded by rosbags."""

import math
import struct

import numpy as np
import pytest
from helpers.manual_cdr import (
    STORE,
    rosbags_cdr,
    rosbags_joint_state,
    rosbags_tf_message,
    rosbags_time,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.driving.messages import JointCommand
from zstate.errors import InvalidInput
from zstate.extension import kernel
from zstate.wire.joint_order import SampleLayout
from zstate.wire.messages import (
    ClockMessage,
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    order_digest,
    to_block,
)
from zstate.wire.ros2.encoder import RosStreamEncoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import FrameNames

STAMP = 1_700_000_000_123_456_789
DIGEST = b"8 bytes."
EDGES = (("base", "arm"), ("arm", "fleet/tool"))
POSES = np.random.default_rng(3).normal(size=(2, 7))
# A floating joint "body" before a hinge: seven and one positions, six and one velocities.
BODY = tuple(f"body.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw"))
DRONE = SampleLayout((*BODY, "hinge"), (0, 1, 2, 3, 4, 5, 7), EDGES)
ARM = SampleLayout(("a", "b"), (0, 1), EDGES)
GID = bytes(range(16))


def encoder(sample_names: SampleLayout = ARM, gid: bytes | None = GID, prefix: str = "") -> RosStreamEncoder:
    names = FrameNames(Ros2Options(frame_prefix=prefix), "r1")
    return RosStreamEncoder(names, sample_names, "key", "token", gid)


def state(*blocks, names=None, stamp: int = STAMP) -> JointState:
    decoded = [None if block is None else to_block(block) for block in blocks]
    order = DIGEST if names is None else order_digest(names)
    return JointState(stamp, 0, 1, order, *decoded, **({} if names is None else {"names": names}))


@pytest.mark.parametrize("blocks", [([1.0, 2.0],), ([1.0, 2.0], [3.0, 4.0]), ([1.0, 2.0], None, [5.0, 6.0])])
def test_joint_states_are_named_by_the_layout(blocks):
    filled = [block or [] for block in (*blocks, None, None)][:3]
    assert encoder().encode(state(*blocks)) == rosbags_joint_state(STAMP, "", ("a", "b"), *filled)


def test_joint_states_with_names_keep_them():
    one = encoder()
    for names in (("x",), ("y", "z", "w"), ("x",)):
        numbers = [float(n) for n in range(len(names))]
        expected = rosbags_joint_state(STAMP, "", names, numbers, numbers, [])
        assert one.encode(state(numbers, numbers, names=names)) == expected


def test_a_robot_that_floats_has_no_velocity_for_the_last_number_of_its_quaternion():
    positions, rates = [0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.5], [10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0]
    payload = encoder(DRONE).encode(state(positions, rates, rates))
    decoded = STORE.deserialize_cdr(payload, "sensor_msgs/msg/JointState")
    assert tuple(decoded.name) == DRONE.coordinates
    assert decoded.position.tolist() == positions
    for block in (decoded.velocity, decoded.effort):
        by_name = dict(zip(decoded.name, block.tolist(), strict=True))
        assert math.isnan(by_name.pop("body.qw"))
        assert list(by_name.values()) == rates


def test_moving_edges_are_those_of_the_layout_or_of_the_message():
    one = encoder(prefix="r1/")
    expected = (("r1/base", "r1/arm"), ("r1/arm", "fleet/tool"))
    sample = TransformSample(STAMP, 0, 1, DIGEST, to_block(POSES))
    assert one.encode(sample) == rosbags_tf_message([STAMP] * 2, expected, POSES)
    named = TransformSample(STAMP, 0, 1, order_digest(EDGES[:1]), to_block(POSES[:1]), EDGES[:1])
    assert one.encode(named) == rosbags_tf_message([STAMP], expected[:1], POSES[:1])
    assert one.encode(sample) == rosbags_tf_message([STAMP] * 2, expected, POSES)


def test_static_edges_have_the_stamp_zero():
    for count in (2, 0):
        statics = StaticTransforms(1, EDGES[:count], to_block(POSES[:count]))
        expected = rosbags_tf_message([0] * count, EDGES[:count], POSES[:count])
        assert encoder().encode(statics) == expected


def test_a_description_is_its_text_and_a_clock_its_time():
    description = RobotDescription(1, "<robot name='ä'/>", "", (), ())
    assert encoder().encode(description) == rosbags_cdr("std_msgs/msg/String", "<robot name='ä'/>")
    for stamp in (0, STAMP):
        expected = rosbags_cdr("rosgraph_msgs/msg/Clock", rosbags_time(stamp))
        assert encoder().encode(ClockMessage(stamp, 0, 1)) == expected


@pytest.mark.parametrize("stamp", [0, 2**31 * 10**9, -(2**31) * 10**9 - 1])
def test_stamp_out_of_the_range_of_ros_is_refused(stamp: int):
    for message in (
        state([1.0, 2.0], stamp=stamp),
        TransformSample(stamp, 0, 1, DIGEST, to_block(POSES)),
    ):
        with pytest.raises(InvalidInput, match="stamp"):
            encoder().encode(message)


def test_messages_without_a_topic_and_numbers_without_names_are_refused():
    with pytest.raises(InvalidInput, match="no topic for a JointCommand"):
        encoder().encode(JointCommand(STAMP, 0, 1, DIGEST))
    with pytest.raises(InvalidInput, match="2 names need"):
        encoder().encode(state([1.0, 2.0, 3.0]))
    with pytest.raises(InvalidInput, match="2 edges need"):
        encoder().encode(TransformSample(STAMP, 0, 1, DIGEST, to_block(POSES[:1])))
    with pytest.raises(InvalidInput, match="2 names need"):
        encoder().encode(state([1.0, 2.0], [1.0]))


def test_attachments_are_numbered_from_one_on_and_a_refused_message_takes_no_number():
    one = encoder()
    assert one.attachment(5) == struct.pack("<qqB", 1, 5, 16) + GID
    with pytest.raises(InvalidInput):
        one.encode(state([1.0, 2.0], stamp=0))
    assert one.attachment(6) == struct.pack("<qqB", 2, 6, 16) + GID
    assert encoder(gid=None).attachment(5) is None


@pytest.mark.skipif(kernel != "c", reason=f"runs on the reference: {kernel.reason}")
@pytest.mark.parametrize("layout", [ARM, DRONE, SampleLayout()])
@pytest.mark.parametrize("sent", [(False, False), (True, False), (False, True), (True, True)])
@settings(deadline=None)
@given(
    dice=st.integers(0, 2**32),
    stamp=st.integers(-(2**63), 2**63 - 1)
    | st.integers(-(2**31) * 10**9 - 5, -(2**31) * 10**9 + 5)
    | st.integers(2**31 * 10**9 - 5, 2**31 * 10**9 + 5)
    | st.integers(-(10**10), 10**10),
)
def test_the_extension_encodes_the_bytes_of_the_reference(layout, sent, dice, stamp):
    reference, compiled = encoder(layout), encoder(layout).compile_joint_states()
    random = np.random.default_rng(dice)
    positions = random.integers(0, 2**62, len(layout.coordinates)).view(np.float64)
    rates = [random.normal(size=len(layout.velocity_slots)) if one else None for one in sent]
    payload = compiled.encode(positions, *rates, stamp)
    try:
        assert payload == reference.encode(state(positions, *rates, stamp=stamp))
    except InvalidInput:
        assert payload is None


@pytest.mark.skipif(kernel != "c", reason=f"runs on the reference: {kernel.reason}")
def test_attachments_of_the_extension_and_the_reference_are_numbered_together():
    one, expected = encoder(), encoder()
    compiled = one.compile_joint_states()
    found = [one.attachment(5), compiled.attachment(-6), one.attachment(2**62)]
    assert found == [expected.attachment(now) for now in (5, -6, 2**62)]
    assert encoder(gid=None).compile_joint_states().attachment(5) is None


def test_duplicate_names_are_left_to_the_reference():
    one = encoder(SampleLayout(("a", "a"), (0, 1)))
    assert one.compile_joint_states() is None
    with pytest.raises(InvalidInput, match="'a'"):
        one.encode(state([1.0, 2.0]))


def test_latched_values_are_not_withdrawn_and_encoding_is_empty():
    assert (encoder().can_withdraw, encoder().encoding) == (False, "")
    assert (encoder().key, encoder().token) == ("key", "token")
