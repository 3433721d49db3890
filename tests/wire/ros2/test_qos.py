import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Qos as RosbagQos
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.metadata import dump_qos_v8, parse_qos

from zstate.errors import InvalidInput, MessageError
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.streams import ros_streams

STREAM_QOS = {stream: one.qos for stream, one in ros_streams().items()}

DEPTHS = st.integers(1, 2**31 - 1)
KEPT = st.one_of(
    st.tuples(st.just("keep_last"), DEPTHS),
    st.just(("keep_all", 0)),
)
QOS = st.builds(
    lambda reliability, durability, kept: Qos(reliability, durability, *kept),
    st.sampled_from(["reliable", "best_effort"]),
    st.sampled_from(["volatile", "transient_local"]),
    KEPT,
)


@pytest.mark.parametrize(
    ("qos", "rmw", "dds"),
    [
        (Qos(depth=10), "::,10:,:,:,,", ":1:0:0,10"),
        (Qos(depth=42), "::,:,:,:,,", ":1:0:0,42"),
        (Qos(depth=100), "::,100:,:,:,,", ":1:0:0,100"),
        (Qos(durability="transient_local", depth=1), ":1:,1:,:,:,,", ":1:1:0,1"),
        (Qos("best_effort", depth=5), "2::,5:,:,:,,", ":0:0:0,5"),
        (Qos(history="keep_all", depth=0), "::2,:,:,:,,", ":1:0:1,-1"),
    ],
)
def test_a_qos_is_written_as_each_side_writes_it(qos: Qos, rmw: str, dds: str):
    assert qos.encode_rmw() == rmw
    assert Qos.parse_rmw(rmw) == qos
    assert qos.encode_dds() == dds
    assert Qos.parse_dds(dds) == qos


@given(qos=QOS)
def test_written_qos_is_parsed_back(qos: Qos):
    assert Qos.parse_rmw(qos.encode_rmw()) == qos
    assert Qos.parse_dds(qos.encode_dds()) == qos


def test_deadline_lifespan_and_lease_are_ignored():
    assert Qos.parse_rmw("2:1:,7:1,0:2,500:3,4,5") == Qos("best_effort", "transient_local", depth=7)


def test_type_hash_after_the_qos_of_a_bridge_is_ignored():
    assert Qos.parse_dds(":1:0:0,10:typehash=RIHS01_00;") == Qos(depth=10)
    assert Qos.parse_dds("K:::") == Qos(depth=1)  # the defaults of DDS


@pytest.mark.parametrize(
    "text", ["", ":", "::", "::10:,:,:,,", "::,x:,:,:,,", "3::,1:", ":0:,1", "::,-1", "::,0", "::1,2,3"]
)
def test_malformed_qos_is_refused(text: str):
    with pytest.raises(MessageError, match="'::,10:,:,:,,'") as caught:
        Qos.parse_rmw(text)
    assert caught.value.reason == "malformed"


@pytest.mark.parametrize("parse", [Qos.parse_rmw, Qos.parse_dds])
@given(text=st.text("0123,:-x", max_size=20) | st.text())
def test_any_text_parses_or_raises_message_error(parse: Callable[[str], Qos], text: str):
    try:
        assert isinstance(parse(text), Qos)
    except MessageError as error:
        assert error.reason == "malformed"


@pytest.mark.parametrize(("history", "depth"), [("keep_last", 0), ("keep_last", -1), ("keep_all", 1)])
def test_a_depth_that_contradicts_the_history_is_refused(history: str, depth: int):
    with pytest.raises(InvalidInput, match="'keep_last' has a depth from 1 on"):
        Qos(history=history, depth=depth)


@given(qos=QOS)
@pytest.mark.long
def test_a_recording_names_the_same_qos_to_rosbags(qos: Qos):
    forever = QosTime(9223372036, 854775807)
    theirs = RosbagQos(
        history=QosHistory[qos.history.upper()],
        depth=qos.depth,
        reliability=QosReliability[qos.reliability.upper()],
        durability=QosDurability[qos.durability.upper()],
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )
    assert parse_qos(qos.to_rosbag_yaml()) == [theirs]
    assert parse_qos(dump_qos_v8([theirs])) == [theirs]


def test_only_latched_streams_are_transient_local():
    latched = {stream for stream, qos in STREAM_QOS.items() if qos.durability == "transient_local"}
    assert latched == {"tf_static", "robot_description", "map", "camera_info"}


def test_only_scans_clouds_and_pictures_are_best_effort_as_sensor_data_is():
    # rmw_qos_profile_sensor_data
    best_effort = {stream: qos for stream, qos in STREAM_QOS.items() if qos.reliability == "best_effort"}
    assert best_effort == dict.fromkeys(
        ("scan", "cloud", "image"), Qos("best_effort", "volatile", "keep_last", 5)
    )


def test_streams_have_the_qos_that_the_wire_specification_lists():
    page = (Path(__file__).parents[3] / "docs" / "wire.md").read_text().partition("\n## ROS 2 wire\n")[2]
    rows = re.findall(r"^\| (`.+?) \| .* \| ([a-z ]+), ([a-z ]+), depth (\d+) \|$", page, re.MULTILINE)
    listed = {
        stream: Qos(reliability.replace(" ", "_"), durability.replace(" ", "_"), "keep_last", int(depth))  # type: ignore[arg-type]
        for streams, reliability, durability, depth in rows
        for stream in re.findall(r"`(\w+)`", streams)
    }
    assert {stream: qos for stream, qos in listed.items() if stream in STREAM_QOS} == STREAM_QOS
    assert listed["partial_joint_states"] == STREAM_QOS["joint_states"]
    assert listed["transforms"] == STREAM_QOS["tf"]
