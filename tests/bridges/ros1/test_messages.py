"""Names, stamps and numbers on their way to ROS and back; no ROS is needed for these."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.cli_runner import failure, missing_library
from helpers.ros1_processes import JOINTS, RRBOT
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from zstate import load_model
from zstate.bridges.ros1.messages import (
    JointStateWriter,
    Ros1FrameNames,
    Ros1JointReader,
    get_stamp,
    partial_joint_state,
    read_transforms,
    set_stamp,
)
from zstate.bridges.ros1.node import RospyModules
from zstate.errors import MessageError
from zstate.wire.joint_order import JointNumbers
from zstate.wire.messages import from_block, to_block

MODEL = load_model(RRBOT)
BARE = st.text("abc_/", min_size=1, max_size=8).filter(lambda name: not name.startswith("/"))


def header(secs: int = 0, nsecs: int = 0) -> Any:
    return SimpleNamespace(stamp=SimpleNamespace(secs=secs, nsecs=nsecs))


def joint_state(names: Any, position: Any = (), velocity: Any = (), effort: Any = ()) -> Any:
    return SimpleNamespace(name=list(names), position=position, velocity=velocity, effort=effort)


# A message of ROS, without ROS: the fields that its class has.
ROS = RospyModules(None, lambda name: SimpleNamespace(header=header(), name=name), None, None)


@given(st.integers(1, 2**32 * 10**9 - 1))
def test_stamp_round_trips_through_ros_to_the_nanosecond(stamp: int):
    there = header()
    set_stamp(there, stamp)
    assert there.stamp.nsecs < 10**9
    assert there.stamp.secs < 2**32
    assert get_stamp(there) == stamp


@pytest.mark.parametrize("stamp", [0, -1, 2**32 * 10**9])
def test_a_stamp_outside_the_range_of_ros_is_refused(stamp: int):
    with pytest.raises(MessageError, match=f"stamp {stamp} is not a time of ROS 1"):
        set_stamp(header(), stamp)


def test_a_zero_stamp_of_ros_is_none():
    with pytest.raises(MessageError, match=r"header\.stamp") as caught:
        get_stamp(header())
    assert caught.value.reason == "zero stamp"


@given(BARE, st.sampled_from(["", "left_", "tf/"]))
def test_frame_name_round_trips_through_ros(bare: str, prefix: str):
    names = Ros1FrameNames("rrbot", prefix)
    for frame in (bare, f"rrbot/{bare}"):
        if frame == bare and "/" in bare:
            assert names.in_ros(frame) == frame  # it is another robot's, in full
        else:
            assert names.in_ros(frame) == prefix + bare
            assert names.bare(names.in_ros(frame)) == bare


def test_old_programs_put_a_slash_before_a_frame_name():
    assert Ros1FrameNames("rrbot", "left_").in_zstate("/left_tool", frozenset()) == "tool"


def test_link_with_a_slash_in_its_name_belongs_to_the_robot():
    names = Ros1FrameNames("rrbot")
    assert names.in_zstate("camera/lens", frozenset({"camera/lens"})) == "rrbot/camera/lens"
    assert names.in_zstate("fleet/map", frozenset({"camera/lens"})) == "fleet/map"


def test_joints_are_found_by_name_in_any_order():
    reader = Ros1JointReader(MODEL)
    message = joint_state(("wheel", "elbow", "shoulder"), (9.0, 0.2, 0.1), (), (0.0, 4.0, 3.0))
    numbers = reader.read(message)
    assert numbers is not None
    assert np.array_equal(numbers.positions, [0.1, 0.2])
    assert numbers.velocities is None
    assert numbers.efforts is not None
    assert np.array_equal(numbers.efforts, [3.0, 4.0])
    assert reader.unknown(message) == ("wheel",)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (joint_state(["shoulder", "elbow", "elbow"], [0.0, 1.0, 2.0]), "names"),
        (joint_state(JOINTS), "sizes"),
        (joint_state(JOINTS, [0.0]), "sizes"),
        (joint_state(JOINTS, [0.0, 0.0], [0.0]), "sizes"),
    ],
)
def test_a_joint_state_that_cannot_be_read_is_refused(message: Any, reason: str):
    with pytest.raises(MessageError) as caught:
        Ros1JointReader(MODEL).read(message)
    assert caught.value.reason == reason


def test_part_of_a_robot_is_read_as_a_state_of_the_joints_it_names():
    message = joint_state(("wheel", "elbow"), (9.0, 0.2), (), (0.0, 4.0))
    assert Ros1JointReader(MODEL).read(message) is None
    state = partial_joint_state(message, 5, "/gripper")
    assert (state.stamp, state.names, state.velocities) == (5, ("wheel", "elbow"), None)
    assert state.efforts is not None
    assert (from_block(state.positions).tolist(), from_block(state.efforts).tolist()) == (
        [9.0, 0.2],
        [0.0, 4.0],
    )
    for wrong in (joint_state(("elbow",)), joint_state(("elbow",), (0.0, 1.0))):
        with pytest.raises(MessageError) as caught:
            partial_joint_state(wrong, 5, "/gripper")
        assert caught.value.reason == "sizes"


def test_each_number_of_a_floating_joint_has_a_name_in_ros():
    model = load_model("""
        <robot name="drone">
          <link name="map"/> <link name="body"/> <link name="rotor"/>
          <joint name="flight" type="floating"><parent link="map"/> <child link="body"/></joint>
          <joint name="spin" type="continuous"><parent link="body"/> <child link="rotor"/></joint>
        </robot>
    """)
    positions, velocities = np.array([1, 2, 3, 0, 0, 0, 1, 9.0]), np.arange(7.0)
    message = JointStateWriter(ROS, model).message(1, JointNumbers(positions, velocities, None))
    assert message.name == [*(f"flight.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")), "spin"]
    read = Ros1JointReader(model).read(message)
    assert read is not None
    assert np.array_equal(read.positions, positions)
    assert read.velocities is not None
    assert np.array_equal(read.velocities, velocities)
    assert read.efforts is None


def test_without_rospy_the_error_names_the_packages_to_install():
    with missing_library("rospy"):
        message = failure("ros1", "rrbot", "--to-ros")
    assert "apt-get install python3-rospy" in message
    assert "--system-site-packages" in message
    assert "Traceback" not in message


def test_a_direction_must_be_chosen():
    assert "--to-ros, --from-ros, or both" in failure("ros1", "rrbot", code=2)


NOETIC = get_typestore(Stores.ROS1_NOETIC)


def tf_message(*transforms: tuple[int, str, str, list[float]]) -> bytes:
    """A TFMessage of ROS 1: its count, and transforms that rosbags has serialized."""
    kinds = NOETIC.types
    quaternion, vector = kinds["geometry_msgs/msg/Quaternion"], kinds["geometry_msgs/msg/Vector3"]
    stamped = [
        kinds["geometry_msgs/msg/TransformStamped"](
            header=kinds["std_msgs/msg/Header"](
                seq=7,
                stamp=kinds["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)),
                frame_id=parent,
            ),
            child_frame_id=child,
            transform=kinds["geometry_msgs/msg/Transform"](
                translation=vector(*pose[:3]), rotation=quaternion(*pose[3:])
            ),
        )
        for stamp, parent, child, pose in transforms
    ]
    written = [bytes(NOETIC.serialize_ros1(one, "geometry_msgs/msg/TransformStamped")) for one in stamped]
    return len(written).to_bytes(4, "little") + b"".join(written)


def test_transforms_are_read_with_their_stamps_names_and_numbers():
    pose = [1.0, -2.0, 0.5, 0.0, 0.6, 0.0, 0.8]
    sent = [(1_700_000_000_123_456_789, "odom", "base", pose), (2 * 10**9, "map", "\u00f6dom", pose[::-1])]
    read = read_transforms(tf_message(*sent))
    assert [tuple(one) for one in read] == [(*head, to_block(numbers)) for *head, numbers in sent]
    assert read_transforms(tf_message()) == []


def test_transforms_that_are_cut_off_are_refused():
    whole = tf_message((1, "odom", "base", [0.0] * 6 + [1.0]))
    for length in range(len(whole)):
        with pytest.raises(MessageError):
            read_transforms(whole[:length])
