"""ROS 2 wire formats without a network: tokens, keys, decoded samples."""

import struct

import pytest
from helpers.manual_cdr import rosbags_joint_state, rosbags_numbers, rosbags_trajectory
from helpers.raw_ros_nodes import (
    COMMANDS,
    DESCRIPTION,
    HUMBLE,
    JOINT_STATES,
    TF,
    TF_STATIC,
    TOPICS,
    TRAJECTORY,
    attachment,
    gid_of,
    key_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.driving.ros2 import Ros2Controller
from zstate.errors import InvalidInput, MessageError
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.protocol import GraphNode, SerializedSample, StreamEncoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.types import LASER_SCAN, OCCUPANCY_GRID
from zstate.wire.ros2.wire import Ros2DdsWire, Ros2Wire

STAMP = 1_700_000_000_123_456_789
GOOD = rosbags_joint_state(STAMP, "", ("a",), [1.0], [], [])
GID = bytes(range(16))
ZID = "aac3178e146ba6f1fc6e6a4085e77f21"
WRITER = WriterId("arm driver", "host", 4, 5, 6)
NODE = GraphNode("r1", WRITER, ZID, 3)
DDS_TOPICS = {
    "joint_states": "sensor_msgs§msg§JointState",
    "tf": "tf2_msgs§msg§TFMessage",
    "tf_static": "tf2_msgs§msg§TFMessage",
    "robot_description": "std_msgs§msg§String",
}


def wire(**options) -> Ros2Wire:
    return Ros2Wire(Ros2Options(**options))


def endpoint(topic, name: str, *, kind: str = "MP", namespace: str = "", hash_: str = "") -> str:
    around = f"%{namespace}" if namespace else "%"
    path = f"{around.rstrip('%')}%{topic[0]}"
    return f"@ros2_lv/0/{ZID}/3/9/{kind}/%/{around}/{name}/{path}/{topic[1]}/{hash_ or topic[2]}/{topic[3]}"


def arrival(
    payload: bytes = GOOD, attached: bytes | None = attachment(7, GID), key: str = ""
) -> SerializedSample:
    return SerializedSample(key or key_of(JOINT_STATES), payload, "zenoh/bytes", attached)


def encoder_of(wire: Ros2Wire, stream: StreamName, number: int) -> StreamEncoder:
    return wire.stream_encoder(NODE, stream, number)


def test_a_writer_is_a_node_with_an_endpoint_for_each_stream():
    there = wire(namespace="fleet/r1", domain=5)
    assert there.node_token(NODE) == f"@ros2_lv/5/{ZID}/3/3/NN/%/%fleet%r1/arm_driver"
    encoder = encoder_of(there, "joint_states", 9)
    assert encoder.key == key_of(JOINT_STATES, "fleet/r1", 5)
    around = f"@ros2_lv/5/{ZID}/3/9/MP/%/%fleet%r1/arm_driver/%fleet%r1%joint_states"
    assert encoder.token == "/".join([around, *JOINT_STATES[1:]])
    assert encoder.attachment(8) == struct.pack("<qqB", 1, 8, 16) + gid_of(encoder.token)
    tf = encoder_of(there, "tf", 10)
    assert tf.key == key_of(TF, "", 5)
    assert tf.token.split("/")[9:] == ["%tf", *TF[1:]]


def test_bridge_wire_has_plain_keys_own_tokens_and_no_attachment():
    bridged = Ros2DdsWire(Ros2Options(namespace="r1"))
    assert bridged.node_token(NODE) is None
    encoder = encoder_of(bridged, "tf_static", 9)
    assert (encoder.key, encoder.attachment(8)) == ("r1/tf_static", None)
    key = f"@/{ZID}/@ros2_lv/MP/r1§tf_static/tf2_msgs§msg§TFMessage"
    assert encoder.token == f"{key}/:1:1:0,1:typehash={TF_STATIC[2]};"


@pytest.mark.parametrize("topic", TOPICS)
@pytest.mark.parametrize("written", ["", HUMBLE])
def test_a_publisher_of_a_stream_is_announced_by_its_node_and_signed_as_its_messages(topic, written):
    token = endpoint(topic, "rsp", hash_=written)
    (decoded,) = wire().parse_token(token, "r1")
    assert (decoded.robot, decoded.stream, str(decoded.writer)) == ("r1", topic[0], "/rsp")
    assert decoded.writer.session == int.from_bytes(gid_of(token)[:8], "little")


@pytest.mark.parametrize(
    ("options", "namespace", "topic", "robot", "expected"),
    [
        ({}, "", JOINT_STATES, "*", "ros"),
        ({}, "r1", JOINT_STATES, "*", None),
        ({"namespace": "r1"}, "r1", JOINT_STATES, "*", "r1"),
        ({"namespace": "r1"}, "", TF, "*", "ros"),
        ({"namespace": "r1", "tf": "namespace"}, "r1", TF, "*", "r1"),
        ({"namespace": "r1", "tf": "namespace"}, "", TF, "*", None),
        ({"namespace": "*"}, "r7", DESCRIPTION, "*", "r7"),
        ({"namespace": "*"}, "", TF_STATIC, "*", "ros"),
        ({"namespace": "*"}, "r7", DESCRIPTION, "r7", "r7"),
        ({"namespace": "*"}, "r8", DESCRIPTION, "r7", None),
        ({"namespace": "fleet/r1"}, "", JOINT_STATES, "r1", None),
    ],
)
def test_a_publisher_is_that_of_the_robot_whose_topic_it_writes(options, namespace, topic, robot, expected):
    one = wire(**options)
    decoded = one.parse_token(endpoint(topic, "rsp", namespace=namespace), robot)
    assert [announced.robot for announced in decoded] == ([expected] if expected else [])
    if expected and robot == "*":
        assert one.robot_from_key(key_of(topic, namespace)) == expected


SCAN_TOPIC = ("front", LASER_SCAN.dds, LASER_SCAN.hash, "2::,5:,:,:,,")
MAP_TOPIC = ("map", OCCUPANCY_GRID.dds, OCCUPANCY_GRID.hash, ":1:,1:,:,:,,")


@pytest.mark.parametrize(("stream", "topic"), [("scan", SCAN_TOPIC), ("map", MAP_TOPIC)])
def test_a_publisher_of_scans_or_maps_is_announced_under_the_name_of_its_topic(stream, topic):
    there = wire(namespace="*")
    encoder = there.stream_encoder(NODE, stream, 9, topic[0])
    assert encoder.token == endpoint(topic, "arm_driver", namespace="r1")
    (announced,) = there.parse_token(encoder.token, "*")
    assert (announced.robot, announced.stream, announced.name) == ("r1", stream, topic[0])
    assert announced.writer.session == int.from_bytes(gid_of(encoder.token)[:8], "little")
    assert there.edge_writer_name(encoder.key) == topic[0]
    assert there.parse_token(endpoint(topic, "arm_driver", namespace="r1"), "r2") == ()


@pytest.mark.parametrize(
    "token",
    [
        endpoint(JOINT_STATES, "rviz", kind="MS"),
        f"@ros2_lv/0/{ZID}/3/3/NN/%/%/rsp",
        endpoint(("joint_states", *TF[1:]), "wrong_type"),
        endpoint(("cmd_vel", *TF[1:]), "other_topic"),
        "@ros2_lv/0",
        "zstate/r1/@writer/tf/x",
    ],
)
def test_other_tokens_announce_nothing(token: str):
    assert wire().parse_token(token, "r1") == ()
    assert wire().parse_token(token, "*") == ()


@pytest.mark.parametrize("stream", DDS_TOPICS)
def test_a_route_of_a_bridge_is_announced(stream):
    one = Ros2DdsWire()
    for tail in (":1:1:0,1", f":1:1:0,1:typehash={TF[2]};", ""):
        token = f"@/{ZID}/@ros2_lv/MP/{stream}/{DDS_TOPICS[stream]}/{tail or ':0:0:1,-1'}"
        (decoded,) = one.parse_token(token, "r1")
        assert (decoded.robot, decoded.stream, decoded.writer.session) == ("r1", stream, 0)
        assert str(decoded.writer) == f"ros2dds bridge {ZID[:8]}"
        assert one.parse_token(token.replace("/MP/", "/MS/"), "r1") == ()
        assert one.parse_token(token.replace("§msg§", "§"), "r1") == ()


def test_session_and_sequence_number_come_from_the_attachment():
    (state,) = wire().decode("joint_states", arrival(), "r1")
    assert (state.session, state.seq) == (int.from_bytes(GID[:8], "little"), 7)
    one = Ros2DdsWire()
    decoded = [one.decode("joint_states", arrival(attached=None), "r1")[0] for _ in range(3)]
    assert [(state.session, state.seq) for state in decoded] == [(0, 1), (0, 2), (0, 3)]


@pytest.mark.parametrize(
    ("attached", "reason"),
    [
        (None, "no attachment"),
        (b"", "foreign"),
        (attachment(1, GID)[:-1], "foreign"),
        (attachment(1, GID) + b"\x00", "foreign"),
        (b"\x0fsequence_number" + bytes(40), "foreign"),
    ],
)
def test_message_without_a_valid_attachment_is_refused(attached, reason: str):
    with pytest.raises(MessageError) as caught:
        wire().decode("joint_states", arrival(attached=attached), "r1")
    assert caught.value.reason == reason


def test_key_in_a_namespace_that_ros_does_not_allow_is_foreign():
    one = wire(namespace="*")
    key = key_of(JOINT_STATES, "two words")
    with pytest.raises(MessageError, match="two words") as caught:
        one.decode("joint_states", arrival(key=key), one.robot_from_key(key))
    assert caught.value.reason == "foreign"


STREAMS = st.sampled_from(
    [
        "joint_states",
        "tf",
        "tf_static",
        "robot_description",
        "scan",
        "map",
        "imu",
        "velocity",
        "pose",
        "fix",
        "magnetic_field",
        "odometry",
        "clock",
    ]
)
BESIDE = st.one_of(
    st.none(),
    st.binary(max_size=40),
    st.builds(
        lambda seq, at, gid: struct.pack("<qqB16s", seq, at, 16, gid),
        st.integers(-(2**63), 2**63 - 1),
        st.integers(-(2**63), 2**63 - 1),
        st.binary(min_size=16, max_size=16),
    ),
)
PAYLOADS = st.one_of(
    st.binary(max_size=80),
    st.binary(max_size=80).map(lambda data: b"\x00\x01\x00\x00" + data),
    st.integers(0, len(GOOD)).map(lambda end: GOOD[:end]),
    st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)).map(
        lambda change: GOOD[: change[0]] + bytes([change[1]]) + GOOD[change[0] + 1 :]
    ),
)
KEYS = st.text(st.characters(exclude_characters="*$?#/"), min_size=1).map(lambda ns: key_of(JOINT_STATES, ns))


@settings(max_examples=400, deadline=None)
@given(STREAMS, st.tuples(PAYLOADS, BESIDE, KEYS), st.sampled_from(["", "*"]), st.booleans())
def test_any_payload_is_decoded_or_refused_with_a_reason(stream, given_, namespace: str, behind_bridge: bool):
    one = (Ros2DdsWire if behind_bridge else Ros2Wire)(Ros2Options(namespace=namespace))
    come = arrival(*given_)
    try:
        decoded = one.decode(stream, come, one.robot_from_key(come.key))
    except MessageError as error:
        assert error.reason
    else:
        assert isinstance(decoded, tuple)


@settings(max_examples=400, deadline=None)
@given(
    st.lists(st.one_of(st.text(max_size=8), st.sampled_from(endpoint(TF, "n").split("/"))), max_size=15).map(
        "/".join
    ),
    st.sampled_from(["", "r1", "*"]),
    st.sampled_from(["r1", "*"]),
)
@pytest.mark.long
def test_any_token_is_parsed_or_ignored(token: str, namespace: str, robot: str):
    for one in (wire(namespace=namespace), Ros2DdsWire(Ros2Options(namespace=namespace))):
        one.parse_token(token, robot)
        one.parse_token(f"@/{ZID}/@ros2_lv/MP/{token}", robot)


# Controllers


def controller(**options) -> Ros2Controller:
    return Ros2Controller(Ros2Options(**options), "r1", "forward_position_controller")


def mangled(topic: tuple[str, ...]) -> tuple[str, ...]:
    return (topic[0].replace("/", "%"), *topic[1:])


@pytest.mark.parametrize("namespace", ["", "r1"])
def test_a_controller_is_a_node_that_subscribes_to_its_topics(namespace: str):
    one = controller(namespace=namespace)
    numbers = iter([3, 9, 9])
    node, *subscriptions = one.reader_tokens(ZID, lambda: next(numbers))
    name = "forward_position_controller"
    assert node == f"@ros2_lv/0/{ZID}/3/3/NN/%/%{namespace}/{name}"
    for topic, token, expression in zip(
        (COMMANDS, TRAJECTORY), subscriptions, (one.commands, one.trajectories), strict=True
    ):
        assert token == endpoint(mangled(topic), name, kind="MS", namespace=namespace)
        assert key_of(topic, namespace).startswith(expression.removesuffix("*"))


def test_publishers_of_commands_are_commanders_by_the_name_of_their_node():
    token = endpoint(mangled(COMMANDS), "teleop")
    session = int.from_bytes(gid_of(token)[:8], "little")
    writer = WriterId("/teleop", "", 0, 0, session)
    assert controller().parse_token(token, "r1") == (Announcement("r1", "joint_commands", writer),)
    others = (endpoint(JOINT_STATES, "teleop"), token.replace("/MP/", "/MS/"), "zstate/r1/@writer/x/y")
    assert [controller().parse_token(other, "r1") for other in others] == [()] * 3


def test_a_command_has_the_number_of_its_publisher_and_the_time_of_its_sending():
    sent = attachment(7, GID, 1_700_000_000_123_456_789)
    sample = arrival(rosbags_numbers([0.5, -1.0]), sent, key=key_of(COMMANDS))
    session, seq, stamp, positions = controller().decode_command(sample)
    assert (session, seq) == (int.from_bytes(GID[:8], "little"), 7)
    assert stamp == 1_700_000_000_123_456_789
    assert positions.tolist() == [0.5, -1.0]
    with pytest.raises(MessageError, match="no attachment"):
        controller().decode_command(arrival(rosbags_numbers([0.5]), None))


def test_a_motion_has_the_numbers_of_its_publisher_and_of_the_message():
    payload = rosbags_trajectory(0, ["elbow"], (0.5, ([1.0],)))
    session, sent, request = controller().decode_trajectory(arrival(payload, key=key_of(TRAJECTORY)))
    assert request is not None
    assert session == request.session == int.from_bytes(GID[:8], "little")
    assert sent == 1
    assert (request.seq, request.names) == (7, ("elbow",))


def test_a_controller_has_a_name_that_ros_allows():
    with pytest.raises(InvalidInput, match="controller '/fpc', which becomes a part of ROS topics"):
        Ros2Controller(Ros2Options(), "r1", "/fpc")
