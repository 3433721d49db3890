import json
import re
from hashlib import sha256

import pytest
from helpers.manual_cdr import STORE, rosbags_joint_state, rosbags_tf_message
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from zstate.wire.ros2.types import (
    CAMERA_INFO,
    CLOCK,
    COMPRESSED_IMAGE,
    DIAGNOSTIC_ARRAY,
    FLOAT64_MULTI_ARRAY,
    FLUID_PRESSURE,
    IMAGE,
    IMU,
    JOINT_STATE,
    JOINT_TRAJECTORY,
    LASER_SCAN,
    MAGNETIC_FIELD,
    NAV_SAT_FIX,
    OCCUPANCY_GRID,
    ODOMETRY,
    POINT_CLOUD2,
    POSE_WITH_COVARIANCE,
    STRING,
    TF_MESSAGE,
    TWIST_WITH_COVARIANCE,
    RosType,
)

TYPES = (
    JOINT_STATE,
    TF_MESSAGE,
    STRING,
    CLOCK,
    POSE_WITH_COVARIANCE,
    LASER_SCAN,
    OCCUPANCY_GRID,
    FLOAT64_MULTI_ARRAY,
    JOINT_TRAJECTORY,
    DIAGNOSTIC_ARRAY,
    IMU,
    TWIST_WITH_COVARIANCE,
    NAV_SAT_FIX,
    FLUID_PRESSURE,
    MAGNETIC_FIELD,
    ODOMETRY,
    POINT_CLOUD2,
    COMPRESSED_IMAGE,
    IMAGE,
    CAMERA_INFO,
)
EACH = pytest.mark.parametrize("kind", TYPES, ids=[kind.name for kind in TYPES])


def test_a_type_has_the_name_people_use_and_the_one_of_the_keys():
    assert (JOINT_STATE.name, JOINT_STATE.dds) == (
        "sensor_msgs/msg/JointState",
        "sensor_msgs::msg::dds_::JointState_",
    )
    assert (TF_MESSAGE.name, TF_MESSAGE.dds) == ("tf2_msgs/msg/TFMessage", "tf2_msgs::msg::dds_::TFMessage_")
    assert (STRING.name, STRING.dds) == ("std_msgs/msg/String", "std_msgs::msg::dds_::String_")
    assert (CLOCK.name, CLOCK.dds) == ("rosgraph_msgs/msg/Clock", "rosgraph_msgs::msg::dds_::Clock_")


@pytest.mark.parametrize(
    ("kind", "known"),
    [
        (JOINT_STATE, "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"),
        (TF_MESSAGE, "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
        (STRING, "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        (CLOCK, "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564"),
        # in LaserScan.json and OccupancyGrid.json of the wheels of ROS 2 Kilted, 5.5.1
        (LASER_SCAN, "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"),
        (OCCUPANCY_GRID, "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"),
    ],
)
def test_the_hash_is_the_one_in_the_keys_of_genuine_ros_2(kind: RosType, known: str):
    assert kind.hash == f"RIHS01_{known}"


def test_the_hash_of_a_string_message_follows_from_the_rule_by_hand():
    # REP-2016: the SHA-256 of this text; type 17 is a string of any length
    text = (
        '{"type_description": {"type_name": "std_msgs/msg/String", "fields": [{"name": "data", "type": '
        '{"type_id": 17, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}}]}, '
        '"referenced_type_descriptions": []}'
    )
    assert json.loads(text)
    assert f"RIHS01_{sha256(text.encode()).hexdigest()}" == STRING.hash


@EACH
@pytest.mark.parametrize("distribution", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED])
def test_rosbags_computes_the_same_hash_from_its_own_fields(kind: RosType, distribution: Stores):
    assert get_typestore(distribution).hash_rihs01(kind.name) == kind.hash


@EACH
def test_rosbags_reads_its_own_fields_out_of_the_definition(kind: RosType):
    parsed = get_types_from_msg(kind.definition, kind.name)
    assert kind.name in parsed
    for name, (_, fields) in parsed.items():
        assert fields == STORE.fielddefs[name][1]


@EACH
def test_rosbags_writes_the_definition_in_the_same_way_but_for_constants(kind: RosType):
    definition = re.sub(
        r"^\w+ \w+=-?\d+\n", "", STORE.generate_msgdef(kind.name, ros_version=2)[0], flags=re.M
    )
    assert definition.strip() == kind.definition.strip()


def test_mcap_ros2_support_decodes_by_the_definitions():
    pose = [0.0, 0.25, 0.5, 0.0, 0.0, 0.0, 1.0]
    tf = generate_dynamic(TF_MESSAGE.name, TF_MESSAGE.definition)[TF_MESSAGE.name]
    (transform,) = tf(rosbags_tf_message([7], [("a", "b")], [pose])).transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("a", "b")
    assert transform.transform.translation.z == 0.5
    joints = generate_dynamic(JOINT_STATE.name, JOINT_STATE.definition)[JOINT_STATE.name]
    state = joints(rosbags_joint_state(7, "w", ["j"], [1.5], [], [2.5]))
    assert (state.name, state.position, state.velocity, state.effort) == (["j"], [1.5], [], [2.5])


@EACH
def test_parts_follow_a_line_of_80_equals_signs_and_their_name(kind: RosType):
    _, *parts = kind.definition.split("=" * 80 + "\n")
    assert all(part.startswith("MSG: ") for part in parts)
    assert len({part.split("\n")[0] for part in parts}) == len(parts)
