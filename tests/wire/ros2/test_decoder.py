"""What ROS nodes write, as messages that listeners know."""

import numpy as np
import pytest
from helpers.manual_cdr import (
    rosbags_cdr,
    rosbags_joint_state,
    rosbags_numbers,
    rosbags_tf_message,
    rosbags_time,
    rosbags_trajectory,
)

from zstate.driving.messages import JointTrajectory
from zstate.driving.ros2 import decode_numbers, decode_trajectory
from zstate.errors import MessageError
from zstate.wire.messages import (
    ClockMessage,
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    order_digest,
    poses_from_block,
    to_block,
)
from zstate.wire.ros2.decoder import RosDecoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import FrameNames

STAMP = 1_700_000_000_123_456_789
EDGES = (("map", "odom"), ("odom", "base"), ("base", "tool"))
POSES = np.random.default_rng(2).normal(size=(3, 7))
PLAIN = FrameNames(Ros2Options(), "r1")
PREFIXED = FrameNames(Ros2Options(frame_prefix="r1/"), "r1")


def decoded(stream, payload: bytes, names: FrameNames = PLAIN):
    return RosDecoder().messages(stream, payload, 77, 5, names)


def test_a_joint_state_keeps_its_stamp_names_and_numbers_and_is_signed_by_its_writer():
    payload = rosbags_joint_state(STAMP, "base", ("a", "b"), [1.0, 2.0], [3.0, 4.0], [])
    numbers = to_block([1.0, 2.0]), to_block([3.0, 4.0])
    order = order_digest(("a", "b"))
    assert decoded("joint_states", payload) == (JointState(STAMP, 5, 77, order, *numbers, None, ("a", "b")),)


def test_transforms_of_one_instant_are_one_sample_that_names_its_edges():
    (sample,) = decoded("tf", rosbags_tf_message([STAMP] * 3, EDGES, POSES))
    assert sample == TransformSample(STAMP, 5, 77, order_digest(EDGES), to_block(POSES), EDGES)


def test_transforms_of_several_instants_are_several_samples_the_oldest_first():
    samples = decoded("tf", rosbags_tf_message([STAMP + 9, STAMP, STAMP + 9], EDGES, POSES))
    assert [(sample.stamp, sample.edges) for sample in samples] == [
        (STAMP, EDGES[1:2]),
        (STAMP + 9, (EDGES[0], EDGES[2])),
    ]
    assert poses_from_block(samples[0].poses).tolist() == POSES[1:2].tolist()
    assert poses_from_block(samples[1].poses).tolist() == POSES[[0, 2]].tolist()
    assert {(sample.seq, sample.session) for sample in samples} == {(5, 77)}


def test_no_transforms_are_no_sample():
    assert decoded("tf", rosbags_tf_message([], [], [])) == ()


@pytest.mark.parametrize("stamps", [[0] * 3, [STAMP, 0, STAMP]])
def test_a_moving_transform_without_a_stamp_is_refused(stamps):
    with pytest.raises(MessageError, match=r"stamp is zero.*header\.stamp") as caught:
        decoded("tf", rosbags_tf_message(stamps, EDGES, POSES))
    assert caught.value.reason == "no stamp"


def test_a_joint_state_without_a_stamp_is_refused():
    with pytest.raises(MessageError) as caught:
        decoded("joint_states", rosbags_joint_state(0, "", ("a",), [1.0], [], []))
    assert caught.value.reason == "no stamp"


@pytest.mark.parametrize("stamps", [[0, 0, 0], [STAMP, 0, STAMP + 1]])
def test_static_transforms_ignore_stamps(stamps):
    (statics,) = decoded("tf_static", rosbags_tf_message(stamps, EDGES, POSES))
    assert statics == StaticTransforms(77, EDGES, to_block(POSES))


def test_frames_are_called_as_in_zstate():
    edges = (("map", "r1/odom"), ("r1/odom", "r1/base"))
    expected = (("ros/map", "odom"), ("odom", "base"))
    for stream in ("tf", "tf_static"):
        (message,) = decoded(stream, rosbags_tf_message([STAMP] * 2, edges, POSES[:2]), PREFIXED)
        assert message.edges == expected


def test_a_description_is_known_by_its_text():
    one, same, other = (decoded("robot_description", rosbags_cdr("std_msgs/msg/String", t))[0] for t in "xxy")
    assert one == same == RobotDescription(77, "x", one.digest, (), (), clock="")
    assert other.digest != one.digest


def test_clock_may_be_zero():
    assert decoded("clock", rosbags_cdr("rosgraph_msgs/msg/Clock", rosbags_time(0))) == (
        ClockMessage(0, 5, 77),
    )


@pytest.mark.parametrize("stream", ["joint_states", "tf", "tf_static", "robot_description", "clock"])
def test_truncated_payload_is_refused(stream):
    with pytest.raises(MessageError) as caught:
        decoded(stream, b"\x00\x01\x00\x00\x01")
    assert caught.value.reason == "truncated"


@pytest.mark.parametrize("labels", [(), ("joints",), ("rows", "columns of any width")])
@pytest.mark.parametrize("little_endian", [True, False])
def test_a_multi_array_is_its_numbers_whatever_its_layout_is(labels, little_endian: bool):
    for numbers in ([], [0.5], [1.0, -2.0, 3.25]):
        payload = rosbags_numbers(numbers, labels, little_endian=little_endian)
        assert decode_numbers(payload).tolist() == numbers
        if little_endian:
            for length in range(len(payload)):
                with pytest.raises(MessageError) as caught:
                    decode_numbers(payload[:length])
                assert caught.value.reason == "truncated"


def test_a_multi_array_of_more_dimensions_than_bytes_is_refused():
    with pytest.raises(MessageError) as caught:
        decode_numbers(rosbags_numbers([0.5]).replace(bytes(4), b"\xff" * 4, 1))
    assert caught.value.reason == "malformed"


NAMES = ("shoulder", "elbow")
PATH = ((0.5, ([1.0, -2.0], [0.5, 0.25])), (1.25, ([3.0, 4.0], [0.0, 0.0])))


@pytest.mark.parametrize("little_endian", [True, False])
def test_a_trajectory_is_a_motion_from_its_stamp_or_its_arrival(little_endian: bool):
    for stamp, start in ((STAMP, STAMP), (0, None)):
        payload = rosbags_trajectory(stamp, NAMES, *PATH, little_endian=little_endian)
        blocks = to_block([0.5, 1.25]), to_block([1.0, -2.0, 3.0, 4.0]), to_block([0.5, 0.25, 0.0, 0.0])
        assert decode_trajectory(payload, 77, 5) == JointTrajectory(stamp, 5, 77, NAMES, *blocks, start=start)
        for length in range(4, len(payload), 5):
            with pytest.raises(MessageError) as caught:
                decode_trajectory(payload[:length], 77, 5)
            assert caught.value.reason == "truncated"


def test_a_trajectory_without_points_is_no_motion():
    assert decode_trajectory(rosbags_trajectory(STAMP, NAMES), 77, 5) is None


@pytest.mark.parametrize(
    ("point", "reason"),
    [
        ((0.5, ([1.0],)), "malformed"),
        ((0.5, ([],)), "malformed"),
        ((0.5, ([1.0, 2.0], [1.0])), "malformed"),
        ((0.5, ([1.0, 2.0], [1.0, 2.0])), "malformed"),
        ((0.5, ([1.0, 2.0], [], [], [1.0, 2.0])), "mode"),
    ],
)
def test_points_with_other_numbers_than_those_of_the_joints_are_refused(point, reason: str):
    payload = rosbags_trajectory(STAMP, NAMES, point, (1.25, ([3.0, 4.0],)))
    with pytest.raises(MessageError) as caught:
        decode_trajectory(payload, 77, 5)
    assert caught.value.reason == reason
