"""Public value types: copies, pickles, equality, and the tables that notebooks show of them."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
import re
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.recording_builder import START, RecordingBuilder

from zstate import JointReading, Kinematics, Recording, Transform, TransformBuffer, Twist
from zstate.cameras import Camera, Picture, RosImage, StampedPicture, Surface
from zstate.clouds import Cloud, PlacedCloud
from zstate.driving import DriverReport, Limits, Outcome, Setpoint
from zstate.driving.driver_state import Spread
from zstate.ingest.counters import ListenerStats
from zstate.model.load import load_model
from zstate.net.discovery import RobotInfo
from zstate.nodes.publisher_status import PublisherStats, StreamStats
from zstate.odometry import (
    Ackermann,
    BarometerNoise,
    BaseCovariance,
    BaseState,
    BaseTwist,
    Datum,
    DiffDrive,
    FixNoise,
    ForceThresholds,
    HeadingNoise,
    ImuNoise,
    LegNoise,
    MagnetometerNoise,
    MapState,
    Mecanum,
    PoseNoise,
    RelativeNoise,
    SourceHealth,
    SpeedThresholds,
    VelocityNoise,
    WheelNoise,
    WheelVelocity,
)
from zstate.rate import RateReport
from zstate.recording.recorder import RecorderStats
from zstate.scans import Grid, PlacedScan, Scan
from zstate.sources import WheelPair
from zstate.wire.identity import WriterId

PUBLIC = (
    "zstate",
    *(
        "zstate.sources",
        "zstate.scans",
        "zstate.clouds",
        "zstate.cameras",
        "zstate.driving",
        "zstate.odometry",
    ),
)
RRBOT = load_model("rrbot")
SCRIPT = "<script>alert('x')</script>"
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def filled_buffer() -> TransformBuffer:
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT)
    for stamp in (10, 20):
        buffer.insert_joints(track, stamp, [0.1 * stamp, 0.5], [0.0, 1.0])
    return buffer


def examples() -> list[Any]:
    """A value of each public type that is data."""
    buffer, vector = filled_buffer(), np.arange(3.0)
    pose = buffer.lookup("world", "tool", 15)
    scan = Scan(5, 0.0, 0.1, 10, [1.0, math.inf], 0.1, 10.0, intensities=[1.0, 2.0])
    cloud = Cloud(5, "lidar", np.zeros(3, [(name, "f4") for name in "xyzt"]))
    writer = WriterId("driver", "host", 7, 8, 9)
    twist, covariance = BaseTwist(vector, vector), BaseCovariance(np.eye(6), np.eye(6))
    spread = Spread(1.0, 2.0, 3.0, 4.0)
    return [
        pose,
        pose.with_covariance(np.eye(6)),
        buffer.twist("tool", "world", 15),
        RRBOT,
        *buffer.frames(),
        buffer.joint_states("rrbot"),
        JointReading(vector, None, vector, 5),
        RobotInfo("arm", (("tf", writer),)),
        ListenerStats(1, 2, 3, 4, {"foreign": 5}),
        PublisherStats(1, 2, "no", {("native", "tf"): StreamStats(1, 2, 3)}, None),
        RecorderStats({("arm", "tf"): 1}, 2, (Path("run.mcap"),), 3, 4, {}, 5),
        RateReport(100.0, 99.9, 10, 0, 1),
        scan,
        Grid([[0, 100], [-1, 5]], 0.5, (1.0, 2.0, 0.3)),
        PlacedScan(scan, "front", "odom", scan.points(), scan.valid),
        cloud,
        PlacedCloud(cloud, "front", "odom", cloud.xyz.copy(), cloud.valid),
        Camera(64, 48, (60.0, 60.0, 31.5, 23.5)),
        Picture("front", 5, "arm/lens", "jpeg", b"\xff", (64, 48), None),
        RosImage(5, "lens", np.zeros((2, 3), np.uint8)),
        StampedPicture(5, b"\xff"),
        Surface(np.zeros((1, 4, 3), np.float32), np.zeros((1, 3), np.uint8)),
        DriverReport(None, spread, spread, spread, 1, 0, {}),
        Limits.of(RRBOT, velocity=1.0, acceleration=2.0),
        Outcome("reached"),
        Setpoint(5, vector, vector),
        WheelPair(0.1, 0.5),
        DiffDrive("a", "b", 0.1, 0.5),
        Ackermann("a", "b", "c", 0.1, 0.5, 0.6),
        Mecanum("a", "b", "c", "d", 0.1, 0.5, 0.6),
        BaseState(5, pose, twist, covariance, vector, vector, False),
        twist,
        covariance,
        WheelVelocity(vector, vector, np.eye(6)),
        SourceHealth("imu", 100.0, 0.1, math.nan, (0.0, 1.0), 0, 1, 2, 3, 4, ""),
        ImuNoise(gyro=1e-3, accel=1e-2, gyro_bias=1e-5, accel_bias=1e-4),
        LegNoise(),
        WheelNoise(),
        VelocityNoise(),
        PoseNoise(),
        RelativeNoise(covariance="dependent"),
        HeadingNoise(),
        MagnetometerNoise(bias=(1e-6, 0.0, 0.0)),
        BarometerNoise(sigma=0.5),
        FixNoise(),
        Datum(48.1, 11.5, 560.0),
        MapState(5, pose, pose, np.eye(6)),
        ForceThresholds(20.0, 10.0),
        SpeedThresholds(0.1, 0.2),
    ]


EXAMPLES = examples()


def parts(value: Any) -> Any:
    """Everything that a value holds, in types that compare: of an array also whether it is read-only."""
    if isinstance(value, np.ndarray):
        return value.dtype, value.shape, value.tobytes(), value.flags.writeable
    if isinstance(value, Transform):
        names = ("target", "source", "stamp", "kind", "predicted_s", "pose7", "covariance")
        return [parts(getattr(value, name)) for name in names]
    if isinstance(value, Twist):
        return [parts(getattr(value, name)) for name in Twist.__slots__]
    if dataclasses.is_dataclass(value):
        return [(field.name, parts(getattr(value, field.name))) for field in dataclasses.fields(value)]
    return [*map(parts, value)] if isinstance(value, tuple) else repr(value)


def test_each_public_type_of_data_has_an_example() -> None:
    public = [getattr(module, name) for module in map(import_module, PUBLIC) for name in module.__all__]
    data = {one for one in public if dataclasses.is_dataclass(one) or hasattr(one, "_fields")}
    assert data - {type(value) for value in EXAMPLES} == set()


@pytest.mark.parametrize("value", EXAMPLES, ids=lambda value: type(value).__name__)
def test_copies_and_pickles_hold_the_same_and_stay_read_only(value: Any) -> None:
    protocols = range(pickle.HIGHEST_PROTOCOL + 1)
    copies = [pickle.loads(pickle.dumps(value, protocol)) for protocol in protocols]
    for again in (*copies, copy.copy(value), copy.deepcopy(value)):
        assert type(again) is type(value)
        assert parts(again) == parts(value)
        assert not isinstance(value, Transform | type(RRBOT)) or again == value


def test_values_with_arrays_compare_by_identity_and_have_a_hash() -> None:
    with_arrays = [
        value
        for value in EXAMPLES
        if dataclasses.is_dataclass(value)
        and any(isinstance(getattr(value, field.name), np.ndarray) for field in dataclasses.fields(value))
    ]
    assert {JointReading, Scan, Grid, Setpoint, Limits} <= {type(value) for value in with_arrays}
    for value in with_arrays:
        assert value != copy.deepcopy(value)
        assert len({value, copy.deepcopy(value)}) == 2


def test_kinematics_of_a_copy_are_those_of_the_model() -> None:
    again = pickle.loads(pickle.dumps(Kinematics(RRBOT)))
    np.testing.assert_array_equal(again.link_poses([0.1, 0.2]), Kinematics(RRBOT).link_poses([0.1, 0.2]))


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_buffers_and_what_is_open_refuse_to_be_copied(copied: Any, sessions) -> None:
    with pytest.raises(TypeError, match=r"not copied or pickled.*Recording in each process.*lookup_many"):
        copied(filled_buffer())
    with pytest.raises(TypeError, match=r"a Session is not copied or pickled: .*open one in each"):
        copied(sessions[0])


def test_a_copy_of_a_recording_reads_the_same_file(tmp_path: Path) -> None:
    with RecordingBuilder(tmp_path / "run.mcap", "arm") as builder:
        builder.describe("arm")
        builder.joints("arm", START, [0.1, 0.2])
    with Recording(tmp_path / "run.mcap", "arm") as recording:
        sent = pickle.dumps(recording)
    with pickle.loads(sent) as again:
        assert again.robot == "arm"
        assert again.joint_states().positions.tolist() == [[0.1, 0.2]]


SHOWN = [value for value in EXAMPLES if hasattr(value, "_repr_html_")]


def test_poses_models_frames_and_counts_are_shown_as_tables() -> None:
    names = {type(value).__name__ for value in SHOWN}
    assert names == {
        "Transform",
        "PoseWithCovariance",
        "RobotModel",
        "FrameInfo",
        "ListenerStats",
        "PublisherStats",
        "RecorderStats",
    }
    pose = EXAMPLES[0]._repr_html_()
    for text in ("pose of tool in world", "roll pitch yaw [deg]", ">15<", ">interpolated<"):
        assert text in pose
    assert "standard deviations [m, rad]" in EXAMPLES[1]._repr_html_()
    model = RRBOT._repr_html_()
    assert "2 driven joints" in model
    assert all(f">{name}<" in model for name in RRBOT.joint_names)


@pytest.mark.parametrize("value", SHOWN, ids=lambda value: type(value).__name__)
def test_a_table_is_small_well_formed_and_has_the_colours_of_the_page(value: Any) -> None:
    html = value._repr_html_()
    assert len(html) < 4096
    assert ElementTree.fromstring(html).find("table") is not None
    assert not re.search(r"color|background|src=|href=|url\(|https?:", html)


def test_names_from_the_network_are_escaped() -> None:
    link = f"{SCRIPT}-link"
    joint = dataclasses.replace(RRBOT.driven_joints[0], name=SCRIPT, parent=SCRIPT, child=link)
    model = dataclasses.replace(RRBOT, name=SCRIPT, joints=(joint,))
    frame = dataclasses.replace(filled_buffer().frames()[0], name=SCRIPT, writer=SCRIPT)
    stats = ListenerStats(1, 2, 3, 4, {SCRIPT: 5})
    for value in (Transform(SCRIPT, link, (0, 0, 0), UPRIGHT), model, frame, stats):
        html = value._repr_html_()
        assert "<script" not in html
        assert SCRIPT in "".join(ElementTree.fromstring(html).itertext())


def test_a_model_with_many_joints_is_shown_up_to_forty_of_them() -> None:
    joints = tuple(dataclasses.replace(RRBOT.driven_joints[0], name=f"j{n}") for n in range(60))
    html = dataclasses.replace(RRBOT, joints=joints)._repr_html_()
    assert ">j39<" in html
    assert ">j40<" not in html
    assert ">and 20 more<" in html
