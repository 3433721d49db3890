import pytest
from hypothesis import given
from hypothesis import strategies as st
from xxhash import xxh3_128_intdigest

from zstate.wire.ros2.graph import (
    DDS_GRAPH_EXPRESSION,
    DdsToken,
    EndpointToken,
    NodeToken,
    gid,
    graph_expression,
    parse_dds_token,
    parse_token,
)
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.streams import ros_stream, ros_streams

ZID = "aac3178e146ba6f1fc6e6a4085e77f21"
JOINT_STATE_HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
NODE = NodeToken(0, ZID, 0, "/", "/", "zstate")
PUBLISHER = EndpointToken(
    NodeToken(5, ZID, 0, "/", "/fleet/r1", "zstate"),
    eid=10,
    kind="MP",
    topic="/fleet/r1/joint_states",
    dds_type="sensor_msgs::msg::dds_::JointState_",
    hash=JOINT_STATE_HASH,
    qos=ros_stream("joint_states").qos,
)
PUBLISHER_KEY = (
    f"@ros2_lv/5/{ZID}/0/10/MP/%/%fleet%r1/zstate/%fleet%r1%joint_states/"
    f"sensor_msgs::msg::dds_::JointState_/{JOINT_STATE_HASH}/::,10:,:,:,,"
)

WORDS = st.text("abcXYZ_019", min_size=1, max_size=10)
PATHS = st.lists(WORDS, max_size=3).map(lambda tokens: "/" + "/".join(tokens))
NUMBERS = st.integers(0, 10**9)
OFFERED = [one.qos for one in ros_streams().values()]
QOS = st.sampled_from([*OFFERED, Qos("best_effort", depth=5), Qos(history="keep_all", depth=0)])
NODES = st.builds(NodeToken, NUMBERS, WORDS, NUMBERS, PATHS, PATHS, WORDS)
ENDPOINTS = st.builds(
    EndpointToken, NODES, NUMBERS, st.sampled_from(["MP", "MS", "SS", "SC"]), PATHS, WORDS, WORDS, QOS
)


def test_node_token_has_percent_signs_for_slashes():
    assert NODE.key == f"@ros2_lv/0/{ZID}/0/0/NN/%/%/zstate"


def test_endpoint_token_has_thirteen_chunks():
    assert PUBLISHER.key == PUBLISHER_KEY
    assert PUBLISHER.key.count("/") == 12


@given(token=NODES | ENDPOINTS)
def test_tokens_are_parsed_from_their_own_keys(token: NodeToken | EndpointToken):
    assert parse_token(token.key) == token


def test_appended_chunks_of_a_later_version_are_ignored():
    assert parse_token(f"{PUBLISHER_KEY}/backends:cpu") == PUBLISHER


@pytest.mark.parametrize(
    "stranger",
    [
        "",
        "0/joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_00",
        NODE.key.replace("@ros2_lv", "@other"),
        NODE.key.replace("/NN/", "/XX/"),
        NODE.key.removesuffix("/zstate"),
        NODE.key.replace("/0/0/", "/0/x/"),
        NODE.key.replace("/0/0/", "//0/"),
        NODE.key.replace("/0/0/", "/0/²/"),
        PUBLISHER_KEY.replace("/MP/", "/AS/"),
        PUBLISHER_KEY.removesuffix("/::,10:,:,:,,"),
        PUBLISHER_KEY.replace("::,10:,:,:,,", "7::,10:,:,:,,"),
        f"@/{ZID}/@ros2_lv/MP/joint_states/sensor_msgs§msg§JointState/:1:0:0,10",
    ],
)
def test_foreign_keys_are_not_parsed(stranger: str):
    assert parse_token(stranger) is None


@given(
    chunks=st.lists(st.sampled_from(["@ros2_lv", "0", "12", "MP", "NN", "%", "::,1:", "@", ""]) | st.text())
)
def test_no_key_raises(chunks: list[str]):
    for key in ("/".join(chunks), "@ros2_lv/0/a/1/2/" + "/".join(chunks)):
        parse_token(key)
        parse_dds_token(key)


def test_a_gid_is_the_hash_of_the_token_low_half_first():
    number = xxh3_128_intdigest(PUBLISHER_KEY.encode())
    low, high = number % 2**64, number // 2**64
    assert gid(PUBLISHER_KEY) == low.to_bytes(8, "little") + high.to_bytes(8, "little")
    assert gid(PUBLISHER_KEY) != gid(NODE.key)


def test_one_expression_matches_the_graph_of_a_domain():
    assert graph_expression(5) == "@ros2_lv/5/**"
    assert DDS_GRAPH_EXPRESSION == "@/*/@ros2_lv/**"


def test_bridge_token_has_topic_type_and_qos():
    token = DdsToken(
        ZID, "MP", "r1/tf_static", "tf2_msgs/msg/TFMessage", ros_stream("tf_static").qos, "RIHS01_e3"
    )
    start = f"@/{ZID}/@ros2_lv/MP/r1§tf_static/tf2_msgs§msg§TFMessage/:1:1:0,1"
    assert token.key == f"{start}:typehash=RIHS01_e3;"
    assert parse_dds_token(token.key) == token
    assert parse_dds_token(start) == DdsToken(
        ZID, "MP", "r1/tf_static", "tf2_msgs/msg/TFMessage", ros_stream("tf_static").qos
    )


@given(
    token=st.builds(
        DdsToken, WORDS, st.sampled_from(["MP", "MS"]), WORDS, WORDS, QOS, st.sampled_from(["", "RIHS01_00"])
    )
)
def test_bridge_tokens_are_parsed_from_their_own_keys(token: DdsToken):
    assert parse_dds_token(token.key) == token


@pytest.mark.parametrize(
    "stranger",
    [
        "",
        PUBLISHER_KEY,
        f"@/{ZID}/@ros2_lv",
        f"@/{ZID}/@ros2_lv/SS/add/example§srv§Add",
        f"@/{ZID}/@ros2_lv/MP/tf/tf2_msgs§msg§TFMessage/x",
    ],
)
def test_foreign_keys_are_no_bridge_tokens(stranger: str):
    assert parse_dds_token(stranger) is None
