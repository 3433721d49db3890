"""Robot messages are recorded as a ROS 2 node would have published them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recording_files import STORE, S
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.recording.encode import (
    CHANNEL_BURST,
    MAX_LATCHED,
    MAX_PENDING,
    MAX_PENDING_BYTES,
    PendingSamples,
    RecordingEncoder,
)
from zstate.recording.mcap.writer import RecordingWriter
from zstate.recording.reader import RecordingReader
from zstate.recording.storage import Record
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import (
    ClockMessage,
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    order_digest,
    to_block,
)

NOW = 1_790_000_000 * S
URDF = """<robot name="cart">
  <link name="world"/><link name="base"/><link name="arm"/>
  <joint name="free" type="floating"><parent link="world"/><child link="base"/></joint>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""
CART: RobotModel = parse_urdf(URDF, "cart")
MOVING = (("world", "base"), ("base", "arm"))
POSITIONS = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.5]
VELOCITIES = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
POSES = [[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 0.0, 0.0, 0.6, 0.8]]


def description(session: int = 1, urdf: str = URDF, names: tuple[str, ...] = CART.joint_names):
    return RobotDescription(session, urdf, "", names, MOVING)


def joints(stamp: int = NOW, seq: int = 0, session: int = 1) -> JointState:
    order = order_digest(CART.joint_names)
    return JointState(stamp, seq, session, order, to_block(POSITIONS), to_block(VELOCITIES))


def transforms(stamp: int = NOW, seq: int = 0, session: int = 1) -> TransformSample:
    return TransformSample(stamp, seq, session, order_digest(MOVING), to_block(POSES))


def statics(*edges: tuple[str, str], session: int = 1) -> StaticTransforms:
    return StaticTransforms(session, edges, to_block([POSES[1]] * len(edges)))


class EncoderCase:
    """A recording at hand, and who writes it."""

    def __init__(self, path: Path, **options: Any) -> None:
        self.path = path
        self.refused: Counter[str] = Counter()
        self.writer = RecordingWriter(path, max_seconds=100.0)
        self.encoder = RecordingEncoder(
            self.writer, lambda reason, _: self.refused.update([reason]), **options
        )

    def records(self) -> list[Record]:
        """All of it, once it is finished."""
        self.writer.close()
        with RecordingReader(self.path) as reader:
            return list(reader.records())

    def read(self, topic: str) -> list[Any]:
        """The messages of one topic, as rosbags reads them."""
        return [
            STORE.deserialize_cdr(record.payload, record.type_name)
            for record in self.records()
            if record.topic == topic
        ]


@pytest.fixture
def case(tmp_path: Path) -> Iterator[EncoderCase]:
    made = EncoderCase(tmp_path / "run.mcap", alone="cart", programs={1: "driver@host pid 7"})
    yield made
    made.writer.close()


def test_numbers_of_a_joint_state_have_the_names_of_their_coordinates(case: EncoderCase):
    case.encoder.write_message("cart", description(), NOW)
    case.encoder.write_message("cart", joints(NOW - 5), NOW)
    (message,) = case.read("/joint_states")
    free = [f"free.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    assert message.name == [*free, "turn"]
    assert message.position.tolist() == POSITIONS
    # A floating joint has six velocities: none under its seventh coordinate.
    assert np.array_equal(message.velocity, [*VELOCITIES[:6], math.nan, VELOCITIES[6]], equal_nan=True)
    assert message.header.stamp.sec * S + message.header.stamp.nanosec == NOW - 5
    assert message.effort.size == 0


def test_moving_and_fixed_edges_are_written_under_their_names(case: EncoderCase):
    case.encoder.write_message("cart", description(), NOW)
    case.encoder.write_message("cart", transforms(), NOW)
    case.encoder.write_message("cart", statics(("arm", "tool"), ("fleet/map", "world")), NOW, MODEL_WRITER)
    (moving,), (fixed,) = case.read("/tf"), case.read("/tf_static")
    assert [(t.header.frame_id, t.child_frame_id) for t in moving.transforms] == list(MOVING)
    first = moving.transforms[0].transform
    assert [first.translation.x, first.translation.y, first.translation.z] == POSES[0][:3]
    assert [first.rotation.x, first.rotation.y, first.rotation.z, first.rotation.w] == POSES[0][3:]
    assert [(t.header.frame_id, t.child_frame_id) for t in fixed.transforms] == [
        ("arm", "tool"),
        ("fleet/map", "world"),
    ]


def test_channel_metadata_has_robot_writer_and_program(case: EncoderCase):
    case.encoder.write_message("cart", description(), NOW)
    case.encoder.write_message("cart", joints(seq=2**32 + 7), NOW)
    case.encoder.write_message("cart", statics(("arm", "tool"), session=2), NOW, "mount")
    records = {record.topic: record for record in case.records()}
    facts = records["/joint_states"].metadata
    assert facts["zstate.robot"] == "cart"
    assert facts["zstate.frame_prefix"] == ""
    assert facts["zstate.session"] == "1"
    assert facts["zstate.program"] == "driver@host pid 7"
    assert "zstate.writer" not in facts
    assert "reliability: 1" in facts["offered_qos_profiles"]
    assert records["/joint_states"].sequence == 7
    assert records["/tf_static"].metadata["zstate.writer"] == "mount"
    assert "zstate.program" not in records["/tf_static"].metadata
    assert records["/robot_description"].publish_time == records["/robot_description"].log_time == NOW


def test_samples_before_the_description_are_written_after_it(case: EncoderCase):
    for number in range(3):
        case.encoder.write_message("cart", joints(NOW + number, number), NOW + number)
        case.encoder.write_message("cart", transforms(NOW + number, number), NOW + number)
    assert (case.encoder.messages, case.encoder.unwritten) == ({}, 6)
    case.encoder.write_message("cart", description(), NOW + 10)
    assert case.encoder.unwritten == 0
    assert case.encoder.messages["cart", "joint_states"] == case.encoder.messages["cart", "tf"] == 3
    log_times = [record.log_time for record in case.records() if record.topic == "/joint_states"]
    assert log_times == [NOW, NOW + 1, NOW + 2]


def test_newest_samples_without_a_description_are_kept_and_all_counted(case: EncoderCase):
    for number in range(MAX_PENDING + 5):
        case.encoder.write_message("cart", joints(NOW + number, number), NOW + number)
    assert case.encoder.unwritten == MAX_PENDING + 5
    case.encoder.write_message("cart", description(), NOW + S)
    assert case.encoder.unwritten == 5
    assert min(r.log_time for r in case.records() if r.topic == "/joint_states") == NOW + 5


def test_samples_of_another_model_wait_for_its_description(case: EncoderCase):
    case.encoder.write_message(
        "cart", description(urdf=URDF.replace("turn", "spin"), names=("free", "spin")), NOW
    )
    case.encoder.write_message("cart", joints(session=2), NOW)
    assert case.encoder.unwritten == 1
    case.encoder.write_message("cart", description(session=2), NOW)
    (message,) = case.read("/joint_states")
    assert message.name[-1] == "turn"


def test_writer_that_names_its_numbers_needs_no_description(case: EncoderCase):
    names = ("b", "a")
    state = JointState(NOW, 0, 1, order_digest(names), to_block([1.0, 2.0]), None, None, names)
    edges = (("map", "odom"),)
    sample = TransformSample(NOW, 0, 1, order_digest(edges), to_block(POSES[:1]), edges)
    case.encoder.write_message("cart", state, NOW)
    case.encoder.write_message("cart", sample, NOW)
    assert case.read("/joint_states")[0].name == ["b", "a"]
    assert case.read("/tf")[0].transforms[0].child_frame_id == "odom"


def test_unusable_model_is_recorded_and_reported_and_its_transforms_are_written(case: EncoderCase):
    case.encoder.write_message("cart", description(urdf="<robot name='cart'/>"), NOW)
    case.encoder.write_message("cart", joints(), NOW)
    case.encoder.write_message("cart", transforms(), NOW)
    assert case.refused == {"unusable model": 1}
    assert case.encoder.unwritten == 1
    assert case.read("/robot_description")[0].data == "<robot name='cart'/>"
    assert len(case.read("/tf")) == 1


def test_messages_that_cdr_cannot_represent_are_counted_by_reason(case: EncoderCase):
    case.encoder.write_message("cart", description(), NOW)
    for stamp in (0, 2**31 * S, -(2**31) * S - 1, 2**31 * S - 1, -(2**31) * S):
        case.encoder.write_message("cart", joints(stamp), NOW)
        case.encoder.write_message("cart", transforms(stamp), NOW)
    short = JointState(NOW, 0, 1, order_digest(CART.joint_names), to_block([1.0]))
    case.encoder.write_message("cart", short, NOW)
    case.encoder.write_message("cart", statics(("arm", "to\0ol")), NOW, "mount")
    case.encoder.write_message("a b", statics(("arm", "tool")), NOW, "mount")
    assert case.refused == {"no stamp": 2, "stamp outside 1901 to 2038": 4, "not representable": 3}
    assert [message.header.stamp.sec for message in case.read("/joint_states")] == [2**31 - 1, -(2**31)]
    published = [record.publish_time for record in case.records() if record.topic == "/tf"]
    assert published == [2**31 * S - 1, 0]


def test_robots_outside_the_root_have_a_valid_ros_namespace_and_a_prefix(tmp_path: Path):
    case = EncoderCase(tmp_path / "run.mcap", alone="cart")
    for robot in ("cart", "arm-1", "arm.1", "2nd"):
        case.encoder.write_message(robot, description(), NOW)
        case.encoder.write_message(robot, joints(), NOW)
        case.encoder.write_message(robot, transforms(), NOW)
    topics = {
        record.metadata["zstate.robot"]: record.topic for record in case.records() if "joint" in record.topic
    }
    assert topics == {
        "cart": "/joint_states",
        "arm-1": "/arm_1/joint_states",
        "arm.1": "/arm_1_/joint_states",
        "2nd": "/_2nd/joint_states",
    }
    frames = [message.transforms[0].child_frame_id for message in case.read("/tf")]
    assert frames == ["base", "arm-1/base", "arm.1/base", "2nd/base"]
    assert {record.metadata["zstate.frame_prefix"] for record in case.records()} == {
        "", "arm-1/", "arm.1/", "2nd/",
    }  # fmt: skip


def test_restarted_writer_has_its_own_channel(case: EncoderCase):
    for session in (1, 2):
        case.encoder.write_message("cart", description(session), NOW + session)
        case.encoder.write_message("cart", joints(session=session), NOW + session)
    sessions = [r.metadata["zstate.session"] for r in case.records() if r.topic == "/joint_states"]
    assert sessions == ["1", "2"]
    with RecordingReader(case.path) as reader:
        assert sum(channel.topic == "/joint_states" for channel in reader.channels()) == 2


def repeated(case: EncoderCase) -> list[tuple[str, str, list[str]]]:
    """What holds at the beginning of a next file: topic, session, and the children of its edges."""
    case.encoder.write_message("cart", ClockMessage(1, 0, 9), NOW + 200 * S)
    case.writer.close()
    with RecordingReader(case.path.with_name("run_1.mcap")) as reader:
        return [
            (
                record.topic,
                record.metadata["zstate.session"],
                [
                    edge.child_frame_id
                    for edge in getattr(
                        STORE.deserialize_cdr(record.payload, record.type_name), "transforms", ()
                    )
                ],
            )
            for record in reader.records()
            if record.topic != "/clock"
        ]


def test_latched_values_in_effect_are_repeated_in_the_next_file(case: EncoderCase):
    case.encoder.write_message("cart", description(1), NOW)
    case.encoder.write_message("cart", description(2), NOW)
    case.encoder.write_message("cart", statics(("arm", "old"), session=1), NOW, "mount")
    case.encoder.write_message("cart", statics(("arm", "new"), session=2), NOW, "mount")
    case.encoder.write_message("cart", statics(("arm", "other"), session=3), NOW, "another")
    assert repeated(case) == [
        ("/robot_description", "2", []),
        ("/tf_static", "2", ["new"]),
        ("/tf_static", "3", ["other"]),
    ]


def test_withdrawn_statics_end_with_an_empty_message(case: EncoderCase):
    case.encoder.write_message("cart", statics(("arm", "tool")), NOW, "mount")
    case.encoder.withdraw("cart", "tf_static", "mount", NOW + 1)
    case.encoder.withdraw("cart", "tf_static", "mount", NOW + 2)
    case.encoder.withdraw("cart", "tf_static", "unknown", NOW + 2)
    assert repeated(case) == []
    assert [len(message.transforms) for message in case.read("/tf_static")] == [1, 0]


def test_static_writer_that_returns_is_latched_again(case: EncoderCase):
    case.encoder.write_message("cart", statics(("arm", "tool")), NOW, "mount")
    case.encoder.withdraw("cart", "tf_static", "mount", NOW + 1)
    case.encoder.write_message("cart", statics(("arm", "tool")), NOW + 2, "mount")
    assert repeated(case) == [("/tf_static", "1", ["tool"])]


def test_statics_without_a_writer_name_accumulate_as_in_ros(case: EncoderCase):
    case.encoder.write_message("cart", statics(("arm", "a")), NOW)
    case.encoder.write_message("cart", statics(("arm", "b"), ("arm", "c")), NOW)
    case.encoder.write_message("cart", statics(("base", "a")), NOW)
    case.encoder.write_message("cart", statics(("arm", "d"), session=2), NOW)
    edges_written = [
        [(edge.header.frame_id, edge.child_frame_id) for edge in message.transforms]
        for message in case.read("/tf_static")
    ]
    assert edges_written == [
        [("arm", "a")],
        [("arm", "a"), ("arm", "b"), ("arm", "c")],
        [("base", "a"), ("arm", "b"), ("arm", "c")],
        [("arm", "d")],
    ]
    writers = {record.metadata["zstate.writer"] for record in case.records()}
    assert writers == {"ros-1", "ros-2"}


def test_simulated_time_is_recorded_from_zero(case: EncoderCase):
    for number in range(3):
        case.encoder.write_message("ros", ClockMessage(number * S, number, 5), NOW + number)
    assert [message.clock.sec for message in case.read("/clock")] == [0, 1, 2]
    assert {record.publish_time for record in case.records()} == {0, S, 2 * S}
    assert "zstate.robot" not in case.records()[0].metadata


def test_endlessly_restarting_writer_takes_no_channels_from_another_robot(case: EncoderCase):
    case.encoder.write_message("cart", description(), NOW)
    case.encoder.write_message("flapping", description(), NOW)
    for number in range(3 * CHANNEL_BURST):
        assert case.encoder.write_message("cart", joints(NOW + number, number), NOW + number)
        is_known = case.encoder.write_message(
            "flapping", joints(NOW + number, 0, session=number + 9), NOW + number
        )
        assert is_known == (number < CHANNEL_BURST - 1)
    assert case.refused == {"too many writers": 2 * CHANNEL_BURST + 1}
    later = NOW + S
    assert (
        sum(
            case.encoder.write_message("flapping", joints(later, 0, session=n), later)
            for n in range(10**6, 10**6 + 100)
        )
        == 10
    )
    assert case.encoder.messages["cart", "joint_states"] == 3 * CHANNEL_BURST
    counts = Counter(record.metadata["zstate.robot"] for record in case.records())
    assert counts == {"cart": 3 * CHANNEL_BURST + 1, "flapping": CHANNEL_BURST + 10}


def test_channels_of_departed_writers_are_released_unless_latched(
    case: EncoderCase, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("zstate.recording.encode.MAX_OPEN_CHANNELS", 10)
    case.encoder.write_message("cart", description(), NOW)
    for session in range(2, 40):
        case.encoder.write_message("cart", joints(session=session), NOW)
    case.encoder.write_message("cart", joints(session=2, seq=1), NOW)
    assert repeated(case) == [("/robot_description", "1", [])]
    with RecordingReader(case.path.with_name("run_1.mcap")) as reader:
        assert len(reader.channels()) <= 11
    sessions = [r.metadata["zstate.session"] for r in case.records() if r.topic == "/joint_states"]
    assert sessions == [*map(str, range(2, 40)), "2"]


def scan(seq: int = 0) -> LaserScan:
    geometry = (-2.0, 0.5, 1000, 4000, 0.125, 8.0)
    return LaserScan(NOW - 5, seq, 1, "laser", *geometry, to_float32_block([1.0, math.inf, 0.5, math.nan]))


def grid(session: int = 1, cells: bytes = b"\xff\x00\x64") -> OccupancyGrid:
    return OccupancyGrid(session, NOW - 7, "map", 0.5, 3, 1, to_block([1, 2, 3, 0, 0, 0, 1]), cells)


def by_rosbags(path: Path) -> dict[str, Any]:
    with AnyReader([path]) as reader:
        return {one.topic: reader.deserialize(data, one.msgtype) for one, _, data in reader.messages()}


def by_mcap_ros2(path: Path) -> dict[str, Any]:
    with path.open("rb") as stream:
        decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        return {channel.topic: message for _, channel, _, message in decoded}


@pytest.mark.parametrize("read", [by_rosbags, by_mcap_ros2])
def test_other_readers_read_scans_and_maps(case: EncoderCase, read: Callable[[Path], dict[str, Any]]):
    case.encoder.write_message("cart", scan(), NOW, "front-laser")
    case.encoder.write_message("hall", grid(), NOW, "map")
    case.writer.close()
    messages = read(case.path)
    assert messages.keys() == {"/front_laser", "/hall/map"}
    ours, theirs = messages["/front_laser"], messages["/hall/map"]
    assert (ours.header.frame_id, ours.angle_min, ours.angle_max, ours.range_max) == (
        "laser",
        -2.0,
        -0.5,
        8.0,
    )
    assert np.array_equal(ours.ranges, [1.0, math.inf, 0.5, math.nan], equal_nan=True)
    assert ours.header.stamp.sec * S + ours.header.stamp.nanosec == NOW - 5
    assert (theirs.header.frame_id, theirs.info.width, theirs.info.resolution) == ("hall/map", 3, 0.5)
    assert (theirs.info.origin.position.y, list(theirs.data)) == (2.0, [-1, 0, 100])


def test_a_map_is_written_again_only_if_it_changes_or_another_writer_publishes_it(case: EncoderCase):
    maps = [grid(), grid(), grid(cells=b"\0\0\0"), grid(cells=b"\0\0\0", session=2)]
    for second, message in enumerate(maps):
        case.encoder.write_message("cart", message, NOW + second * S, "floor")
    case.encoder.write_message("cart", scan(), NOW, "front")
    assert [(topic, session) for topic, session, _ in repeated(case)] == [("/floor", "2")]
    first_file, next_file = [[-1, 0, 100], [0, 0, 0], [0, 0, 0]], [[0, 0, 0]]
    assert [list(message.data) for message in case.read("/floor")] == first_file + next_file
    assert case.encoder.messages == {("cart", "map"): 3, ("cart", "scan"): 1, ("cart", "clock"): 1}


def test_a_withdrawn_map_ends_with_a_grid_without_cells_and_keeps_edges_of_its_name(case: EncoderCase):
    case.encoder.write_message("cart", statics(("arm", "tool")), NOW, "floor")
    case.encoder.write_message("cart", grid(), NOW, "floor")
    for n in (1, 2):
        case.encoder.withdraw("cart", "map", "floor", NOW + n)
    assert [(topic, session) for topic, session, _ in repeated(case)] == [("/tf_static", "1")]
    assert [len(message.data) for message in case.read("/floor")] == [3, 0]
    assert len(case.read("/tf_static")) == 2


@pytest.mark.long
def test_maps_beyond_128_mib_are_in_one_file_only_and_counted(case: EncoderCase):
    side = 4096
    floor = OccupancyGrid(1, NOW, "map", 0.5, side, side, to_block([0, 0, 0, 0, 0, 0, 1]), bytes(side * side))
    for number in range(8):  # of 16 MiB and a header each
        case.encoder.write_message("hall", floor, NOW, f"floor_{number}")
    assert case.refused == {"map not repeated": 1}
    case.encoder.withdraw("hall", "map", "floor_0", NOW)
    case.encoder.write_message("hall", floor, NOW, "floor_8")
    assert case.refused == {"map not repeated": 1}
    assert case.encoder.messages["hall", "map"] == 8 + 1 + 1
    assert {topic for topic, *_ in repeated(case)} == {f"/hall/floor_{n}" for n in (1, 2, 3, 4, 5, 6, 8)}
    assert [len(message.data) for message in case.read("/hall/floor_7")] == [side * side]


def test_a_scan_without_a_stamp_is_refused(case: EncoderCase):
    case.encoder.write_message(
        "cart", LaserScan(0, 0, 1, "laser", 0.0, 0.1, 0, 0, 0.0, 1.0, b""), NOW, "front"
    )
    assert case.refused == {"no stamp": 1}


def test_endless_static_writers_are_refused_and_counted(case: EncoderCase):
    for number in range(MAX_LATCHED + 3):
        case.encoder.write_message("cart", statics(("arm", "tool")), NOW, f"writer_{number}")
    assert case.refused == {"too many writers": 3}
    assert case.encoder.write_message("cart", statics(("arm", "other")), NOW, "writer_0")
    case.encoder.withdraw("cart", "tf_static", "writer_0", NOW)
    assert case.encoder.write_message("cart", statics(("arm", "other")), NOW, "another")


def test_fewer_large_samples_are_kept_without_a_description():
    early = PendingSamples()
    large = JointState(NOW, 0, 1, order_digest(CART.joint_names), bytes(MAX_PENDING_BYTES // 24 * 8))
    for number in range(5):
        early.append("cart", large, NOW + number)
    assert (early.waiting, early.dropped) == (3, 2)
    assert [log_time for _, log_time in early.pop("cart")] == [NOW + 2, NOW + 3, NOW + 4]
    assert early.waiting == 0
