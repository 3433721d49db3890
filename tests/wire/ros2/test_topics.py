import pytest

from zstate.errors import InvalidInput
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.streams import ros_type, topic_stream
from zstate.wire.ros2.topics import SHARED, DdsKeys, RmwKeys
from zstate.wire.ros2.types import LASER_SCAN, OCCUPANCY_GRID, TF_MESSAGE

STREAMS = ("joint_states", "robot_description", "tf", "tf_static", "clock")
# `ros2 topic info -v` of a genuine ROS 2 names these hashes.
JOINT_STATE = (
    "sensor_msgs::msg::dds_::JointState_/"
    "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
)
TF = "tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
STRING = (
    "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
)
CLOCK = (
    "rosgraph_msgs::msg::dds_::Clock_/RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564"
)


def test_in_the_root_namespace_the_topics_are_those_of_a_robot_state_publisher():
    keys = RmwKeys(Ros2Options())
    assert {stream: keys.key("panda", stream) for stream in STREAMS} == {
        "joint_states": f"0/joint_states/{JOINT_STATE}",
        "robot_description": f"0/robot_description/{STRING}",
        "tf": f"0/tf/{TF}",
        "tf_static": f"0/tf_static/{TF}",
        "clock": f"0/clock/{CLOCK}",
    }


def test_namespace_prefixes_robot_topics_but_not_tf_and_clock():
    keys = RmwKeys(Ros2Options(domain=5, namespace="/fleet/r1"))
    assert keys.key("panda", "joint_states") == f"5/fleet/r1/joint_states/{JOINT_STATE}"
    assert keys.key("panda", "robot_description") == f"5/fleet/r1/robot_description/{STRING}"
    assert keys.key("panda", "tf_static") == f"5/tf_static/{TF}"
    assert keys.key("panda", "clock") == f"5/clock/{CLOCK}"


def test_tf_can_be_in_the_namespace_but_the_clock_is_global():
    keys = RmwKeys(Ros2Options(namespace="*", tf="namespace"))
    assert keys.topic("r1", "tf") == "/r1/tf"
    assert keys.topic("r1", "tf_static") == "/r1/tf_static"
    assert keys.topic("r1", "clock") == "/clock"


def test_humble_keys_have_no_hash_and_readers_match_both():
    iron, humble = (RmwKeys(Ros2Options(hash=style)) for style in ("iron", "humble"))
    assert humble.key("r1", "tf") == "0/tf/tf2_msgs::msg::dds_::TFMessage_/TypeHashNotSupported"
    assert iron.expression("r1", "tf") == humble.expression("r1", "tf")
    assert humble.expression("r1", "tf") == "0/tf/tf2_msgs::msg::dds_::TFMessage_/*"


SCAN = (
    "sensor_msgs::msg::dds_::LaserScan_/"
    "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"
)
MAP = (
    "nav_msgs::msg::dds_::OccupancyGrid_/"
    "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
)


def test_scans_and_maps_are_topics_named_by_their_writers():
    root, robots = RmwKeys(Ros2Options()), RmwKeys(Ros2Options(namespace="*"))
    assert root.key("panda", "scan") == root.key("panda", "scan", "scan") == f"0/scan/{SCAN}"
    assert root.key("panda", "scan", "front") == f"0/front/{SCAN}"
    assert robots.key("panda", "scan", "front") == f"0/panda/front/{SCAN}"
    assert robots.key("hall", "map", "map") == f"0/hall/map/{MAP}"
    assert robots.key("panda", "joint_states", "front") == robots.key("panda", "joint_states")


def test_scans_and_maps_are_found_by_their_type():
    root, robots = RmwKeys(Ros2Options()), RmwKeys(Ros2Options(namespace="*"))
    assert root.expression("panda", "scan") == "0/*/sensor_msgs::msg::dds_::LaserScan_/*"
    assert robots.expression("panda", "map") == "0/panda/*/nav_msgs::msg::dds_::OccupancyGrid_/*"
    assert robots.expression("*", "scan") == "0/*/*/sensor_msgs::msg::dds_::LaserScan_/*"
    assert topic_stream("/r1/front", LASER_SCAN.dds) == topic_stream("scan", LASER_SCAN.dds) == "scan"
    assert topic_stream("/r1/floor_2", OCCUPANCY_GRID.dds) == "map"
    assert topic_stream("/r1/tf", TF_MESSAGE.dds) == "tf"
    assert topic_stream("/r1/tf", LASER_SCAN.dds) == "scan"
    assert topic_stream("/r1/other", TF_MESSAGE.dds) is topic_stream("/r1/scan", "std_msgs") is None


def test_the_name_of_a_sensor_or_a_map_is_the_last_of_its_topic():
    keys = RmwKeys(Ros2Options(namespace="*"))
    for stream in ("scan", "map"):
        assert keys.writer_name(keys.key("panda", stream, "front")) == "front"
    assert keys.writer_name(keys.key("panda", "tf")) is None
    with pytest.raises(InvalidInput, match="'<domain>/<topic>/<type>/<hash>'"):
        keys.writer_name("0/scan")


@pytest.mark.parametrize("layout", [RmwKeys, DdsKeys])
def test_a_sensor_name_that_is_invalid_in_ros_is_refused(layout):
    with pytest.raises(InvalidInput, match=r"scan name 'front\.left', which becomes .* 'front_left'"):
        layout(Ros2Options()).key("panda", "scan", "front.left")


def test_keys_of_a_bridge_have_no_type_so_only_scan_and_map_are_read():
    keys = DdsKeys(Ros2Options(namespace="*"))
    assert keys.key("panda", "scan", "front") == "panda/front"
    assert keys.expression("panda", "scan") == "panda/scan"
    assert keys.expression("*", "map") == "*/map"
    assert (keys.writer_name("panda/scan"), keys.writer_name("tf")) == ("scan", None)


def test_expression_of_all_robots_matches_the_namespace():
    end = "joint_states/sensor_msgs::msg::dds_::JointState_/*"
    assert RmwKeys(Ros2Options(namespace="*")).expression("*", "joint_states") == f"0/*/{end}"
    assert RmwKeys(Ros2Options(namespace="*")).expression("r1", "joint_states") == f"0/r1/{end}"
    assert RmwKeys(Ros2Options(namespace="fleet/r1")).expression("*", "joint_states") == f"0/fleet/r1/{end}"
    assert RmwKeys(Ros2Options()).expression("*", "joint_states") == f"0/{end}"


def test_bridge_keys_are_namespace_and_topic_only():
    keys = DdsKeys(Ros2Options(domain=5, namespace="fleet/r1", hash="humble"))
    for stream in STREAMS:
        assert keys.key("panda", stream) == f"fleet/r1/{stream}"
        assert keys.topic("panda", stream) == f"/fleet/r1/{stream}"
        assert DdsKeys(Ros2Options()).key("panda", stream) == stream
    assert DdsKeys(Ros2Options(namespace="*")).expression("*", "tf") == "*/tf"
    assert DdsKeys(Ros2Options(namespace="*")).expression("r1", "tf") == "r1/tf"


@pytest.mark.parametrize("layout", [RmwKeys, DdsKeys])
@pytest.mark.parametrize(
    ("namespace", "robot"), [("", SHARED), ("*", "panda"), ("r1", "r1"), ("fleet/r1", "r1")]
)
def test_the_robot_of_a_key_is_the_end_of_its_namespace(layout, namespace: str, robot: str):
    keys = layout(Ros2Options(namespace=namespace, tf="namespace"))
    for stream in STREAMS[:-1]:
        assert keys.robot_from_key(keys.key("panda", stream)) == robot


def test_global_topics_belong_to_the_shared_robot():
    keys = RmwKeys(Ros2Options(namespace="*"))
    for stream in ("tf", "tf_static", "clock"):
        assert keys.robot_from_key(keys.key("panda", stream)) == SHARED


@pytest.mark.parametrize("stranger", ["", "0", "0/tf", "0/tf/tf2_msgs::msg::dds_::TFMessage_"])
def test_a_key_of_another_layout_has_no_robot(stranger: str):
    with pytest.raises(InvalidInput, match="'<domain>/<topic>/<type>/<hash>'"):
        RmwKeys(Ros2Options()).robot_from_key(stranger)


@pytest.mark.parametrize("layout", [RmwKeys, DdsKeys])
def test_ros_has_no_topic_for_joint_commands(layout):
    keys = layout(Ros2Options())
    for use in (keys.key, keys.topic, keys.expression):
        with pytest.raises(
            InvalidInput, match="'joint_commands' is not carried by ROS 2; carried are 'joint"
        ):
            use("panda", "joint_commands")
    with pytest.raises(InvalidInput):
        ros_type("joint_commands")


@pytest.mark.parametrize("layout", [RmwKeys, DdsKeys])
def test_robot_name_that_is_invalid_in_ros_is_refused_only_as_a_namespace(layout):
    assert layout(Ros2Options(namespace="r1")).topic("arm-2", "joint_states") == "/r1/joint_states"
    with pytest.raises(InvalidInput, match="'arm_2'"):
        layout(Ros2Options(namespace="*")).key("arm-2", "joint_states")
