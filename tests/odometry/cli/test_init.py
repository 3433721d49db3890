"""zstate odometry --init: the first settings file of a robot, by what it publishes."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cli_runner import Spawn, failure, run_cli, run_until, start_rover
from helpers.recording_builder import MS, START, RecordingBuilder

from zstate import Transform, TransformBuffer, load_model
from zstate.model.joint_history import JointHistory
from zstate.odometry import DiffDrive, FixNoise, PoseNoise, VelocityNoise
from zstate.odometry.cli.heard import Heard, motion_text, white_density
from zstate.odometry.cli.initial_file import initial_file
from zstate.odometry.cli.settings_file import MEMS_NOISE, OdometrySettings, read_settings
from zstate.odometry.cli.wheel_geometry import proposed_wheels
from zstate.odometry.messages import Fix, Imu, MagneticField, Pose, Pressure, Velocity
from zstate.odometry.sensors import KINDS
from zstate.wire.messages import to_block

DIFFBOT = load_model("diffbot")
WHEELS = DiffDrive("left_wheel_joint", "right_wheel_joint", radius=0.08, track=0.32)
GYRO, ACCEL = 3e-4, 4e-3
"""Densities of noise; samples are 10 ms apart."""


@pytest.mark.processes
@pytest.mark.long
def test_first_file_of_a_rover_at_rest_has_its_wheels_and_noise_and_runs(spawn: Spawn, tmp_path: Path):
    start_rover(spawn)
    file = tmp_path / "rover.toml"
    ended = run_cli("odometry", "rover", "--init", str(file), "--seconds", "3")
    run = f"zstate odometry rover --file {file}"
    assert ended.stdout == f"wrote {file}: look it through, then run `{run}`\n", ended.stderr
    settings = read_settings(str(file))
    assert settings.diff_drive == WHEELS
    assert (settings.imu, settings.base, settings.odom) == ("imu", "base_footprint", "odom")
    # Those of models/rover.toml: the largest of three axes and sizes is 1.10, sigma 0.06, of 600 samples.
    assert 0.8 < settings.imu_noise.gyro / 2e-4 < 1.4
    assert 0.8 < settings.imu_noise.accel / 2e-2 < 1.4
    publishing = "from its IMU 'imu', its wheels"
    run_until(lambda: True, *run.split()[1:], after=publishing)
    assert f"{str(file)!r} exists; choose another name, or pass --overwrite" in failure(
        "odometry", "rover", "--init", str(file)
    )
    assert run_cli("odometry", "rover", "--init", str(file), "--overwrite", "--seconds", "0.5").code == 0
    assert read_settings(str(file)).imu_noise == MEMS_NOISE  # that is too short
    assert "rover" in failure("odometry", "rovr", "--init", str(tmp_path / "other.toml"))


def readings(seconds: float = 4.0, *, seed: int = 0, orientation: bytes | None = None) -> list[Imu]:
    """An IMU at rest."""
    random, found = np.random.default_rng(seed), list[Imu]()
    for n in range(round(100 * seconds)):
        gyro = random.normal(0.001, GYRO * 10.0, 3)
        accel = random.normal((0.0, 0.0, 9.81), ACCEL * 10.0)
        stamp = START + n * 10 * MS
        found.append(Imu(stamp, n, 1, "r1/imu_link", to_block(gyro), to_block(accel), orientation))
    return found


def still_joints(model: Any = DIFFBOT) -> JointHistory:
    stamps = START + 20 * MS * np.arange(100)
    names = model.joint_names
    return JointHistory(names, names, (), stamps, np.zeros((100, len(names))))


def mounts() -> TransformBuffer:
    buffer = TransformBuffer()
    for link in ("imu_link", "antenna"):
        mount = Transform("r1/base_footprint", f"r1/{link}", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0))
        buffer.insert_static(mount)
    return buffer


def heard(**messages: dict[str, list[Any]]) -> Heard:
    found = Heard("r1", "the network", 4.0, mounts(), DIFFBOT, joints=still_joints())
    found.messages["imu"]["imu"] = readings()
    found.messages.update(messages)  # pyright: ignore[reportArgumentType] - names of streams
    return found


def upper(*variances: float) -> bytes:
    return to_block(np.diag(variances)[np.triu_indices(len(variances))])


LEVEL = (0.0, 0.0, 0.0, 1.0)
VELOCITY = Velocity(START, 0, 2, "r1/base_footprint", to_block([0.0] * 3))
POSE = Pose(START, 0, 3, "r1/odom", "", to_block([0.0, 0.0, 0.0, *LEVEL]))
FIX = Fix(START, 0, 4, "r1/antenna", 48.1, 11.5)


def written(tmp_path: Path, found: Heard, settings: OdometrySettings | None = None) -> tuple[str, Any]:
    """The text, and the settings that are read of it."""
    file = tmp_path / "r1.toml"
    file.write_text(initial_file(found, str(file), settings or OdometrySettings()).text)
    return file.read_text(), read_settings(str(file))


def test_velocity_that_is_published_is_the_source_and_the_wheels_are_off(tmp_path: Path):
    text, settings = written(tmp_path, heard(velocity={"wheels": [VELOCITY]}))
    assert settings.velocity == {"wheels": VelocityNoise(sigma=0.05)}
    assert settings.diff_drive is None
    assert "# Off, as a velocity is a source: most are of the same wheels.\n# [diff_drive]\n" in text
    assert re.search(r"^sigma = 0.05 .*; messages have none: state it$", text, re.MULTILINE)
    assert re.search(r"^\[velocity.wheels\] +# velocity/wheels, in base_footprint$", text, re.MULTILINE)


def test_noise_that_messages_state_is_a_comment(tmp_path: Path):
    velocity = Velocity(START, 0, 2, "r1/base_footprint", VELOCITY.linear, None, upper(0.01, 0.01, 0.04))
    pose = Pose(START, 0, 3, "r1/odom", "", POSE.pose, upper(*[1e-4] * 3, *[math.radians(2.0) ** 2] * 3))
    fix = Fix(START, 0, 4, "r1/antenna", 48.1, 11.5, 0.0, 0, 0, upper(4.0, 4.0, 9.0), 2)
    found = heard(velocity={"flow": [velocity]}, pose={"mocap": [pose]}, fix={"gps": [fix]})
    text, settings = written(tmp_path, found)
    assert (settings.velocity, settings.pose) == ({"flow": VelocityNoise()}, {"mocap": PoseNoise()})
    assert settings.fix == {"gps": FixNoise()}
    for line in ("sigma = [0.1, 0.1, 0.2]", "sigma = 0.01", "sigma_deg = 2.0", "sigma = [2.0, 3.0]"):
        assert re.search(rf"^# {re.escape(line)} .*; messages state this$", text, re.MULTILINE), line


def test_poses_of_another_frame_and_compasses_and_what_is_silent_are_off(tmp_path: Path):
    lidar = Pose(START, 0, 3, "site/map", "", POSE.pose)
    found = heard(pose={"lidar": [lidar], "mocap": []}, imu={"imu": readings(orientation=to_block(LEVEL))})
    text, settings = written(tmp_path, found)
    assert (settings.pose, settings.heading) == ({}, {})
    assert "# Off: its poses are in site/map, not in r1/odom; see [relative].\n# [pose.lidar]" in text
    assert "# Off: for another odometry, of which only the motion counts" in text
    assert '# [relative."pose/lidar"]' in text
    assert '# [relative."pose/mocap"]' not in text
    assert "# Off: it is announced, and silent.\n# [pose.mocap]" in text
    assert "# Off: motors and floors turn a compass; see the guide.\n# [heading.imu]" in text
    assert settings.diff_drive == WHEELS


def test_every_key_that_is_off_is_a_key_once_it_is_not(tmp_path: Path):
    """Of all kinds of sensors, with names that TOML has to quote, and with the root of another robot."""
    imu = readings(orientation=to_block(LEVEL))
    found = heard(
        velocity={"flow.1": [VELOCITY]},
        pose={"mocap": [POSE], "lidar": [Pose(START, 0, 3, "site/map", "", POSE.pose)]},
        fix={"gps": [FIX]},
        imu={"imu": imu},
        magnetic_field={"mag": [MagneticField(START, 0, 4, "r1/base_link", to_block([2e-5, 0.0, -4e-5]))]},
        pressure={"bmp": [Pressure(START, 0, 5, "r1/base_link", 101325.0)]},
    )
    text, _ = written(tmp_path, found)
    used = re.sub(r"^# (\[[a-z]|[a-z_]+ = )", r"\1", text, flags=re.MULTILINE)
    assert not re.search(r"^# \S+ = ", used, re.MULTILINE)
    file = tmp_path / "used.toml"
    file.write_text(used)
    settings = read_settings(str(file))
    assert {one.kind for one in settings.sensors} == set(KINDS)
    assert [*settings.velocity] == ["flow.1"]
    assert settings.diff_drive == replace(WHEELS, frame="base_footprint")
    lines = [line for line in text.splitlines() if " = " in line and not line.startswith("#  ")]
    assert all(" # " in line for line in lines)


def test_robot_without_a_model_or_motion_is_told_so(tmp_path: Path):
    found = Heard("r1", "the network", 4.0, TransformBuffer())
    notes = initial_file(found, "r1.toml", OdometrySettings()).notes
    assert len(notes) == 3
    for note, part in zip(
        notes, ("publishes no model", "has no IMU", "nothing measures its motion"), strict=True
    ):
        assert part in note
    _, settings = written(tmp_path, found)
    assert settings == OdometrySettings()


def test_sensor_without_a_mount_is_told_so(tmp_path: Path):
    text, _ = written(tmp_path, heard(velocity={"flow": [replace_frame(VELOCITY, "r1/flow_link")]}))
    assert "velocity/flow, in flow_link, which is not on the robot: publish its mount" in text


def replace_frame(message: Velocity, frame: str) -> Velocity:
    return Velocity(message.stamp, 0, 2, frame, message.linear)


def test_noise_is_measured_at_rest_alone(tmp_path: Path):
    text, settings = written(tmp_path, heard())
    assert "measured in 4.0 s at rest" in text
    assert 0.9 < settings.imu_noise.gyro / GYRO < 1.4
    assert 0.9 < settings.imu_noise.accel / ACCEL < 1.4
    moving = heard()
    assert moving.joints is not None
    moving.joints.positions[50:, 1] = 0.1
    text, settings = written(tmp_path, moving)
    assert (
        "[imu_noise]                    # gyro and accel: a default, as its joint 'right_wheel_joint' moves"
        in text
    )
    assert settings.imu_noise == MEMS_NOISE


def moved(numbers: Any) -> list[Imu]:
    """An IMU at rest, to whose gyro and accelerometer ``numbers`` are added in the second half."""
    found = readings()
    for place in range(200, 400):
        one = found[place]
        gyro, accel = (np.frombuffer(block) for block in (one.gyro, one.accel))
        found[place] = Imu(
            one.stamp, place, 1, one.frame, to_block(gyro + numbers[0]), to_block(accel + numbers[1])
        )
    return found


@pytest.mark.parametrize(
    ("imu", "velocity", "reason"),
    [
        (readings(), None, ""),
        (readings(1.0), None, "100 readings in 1.0 s are too few"),
        ([], None, "it sends nothing"),
        (moved((0.1, 0.0)), None, "its gyro reads"),
        (moved((0.0, 0.5)), None, "its accelerometer is"),
        (readings(), [0.1, 0.0, 0.0], "its velocity 'flow' is not zero"),
    ],
)
def test_robot_that_moves_is_told_by_its_sensors(imu: list[Imu], velocity: Any, reason: str):
    found = heard()
    if velocity is not None:
        found.messages["velocity"]["flow"] = [Velocity(START, 0, 2, "r1/base_link", to_block(velocity))]
    text = motion_text(found, imu)
    assert text.startswith(reason)
    assert bool(text) == bool(reason)


@pytest.mark.parametrize("size", [1, 4])
def test_density_is_that_of_the_noise_also_behind_a_filter(size: int):
    """A mean over 4 samples makes neighbours alike: by them alone the noise would be 4 times too small."""
    noise = np.random.default_rng(1).normal(0.0, 2.0, (4000, 3))
    sums = np.cumsum(noise, axis=0)
    filtered = (sums[size:] - sums[:-size]) / size
    assert white_density(filtered, 0.01) == pytest.approx(2.0 * math.sqrt(0.01), rel=0.2)


AXLE = """<link name="{0}"/><joint name="{0}_joint" type="continuous"><parent link="base"/><child link="{0}"/>
  <origin xyz="{1} {2} {3}"/><axis xyz="0 {4} 0"/></joint>"""


def robot(
    *wheels: tuple[str, float, float], axis: int = 1, root: str = "base_footprint", extra: str = ""
) -> Any:
    text = "".join(AXLE.format(name, x, y, 0.05, axis) for name, x, y in wheels)
    lift = f'<parent link="{root}"/><child link="base"/><origin xyz="0 0 0.1"/>'
    links = f'<link name="{root}"/><link name="base"/><joint name="lift" type="fixed">{lift}</joint>'
    return load_model(f'<robot name="r">{links}{text}{extra}</robot>')


PAIR = ("l", 0.0, 0.2), ("r", 0.0, -0.2)


def test_wheels_without_a_shape_have_the_height_of_their_axle_above_the_footprint():
    wheels = proposed_wheels(robot(*PAIR), "base_footprint")
    assert wheels is not None
    assert (wheels.left, wheels.right) == (("l_joint",), ("r_joint",))
    assert (wheels.radius, wheels.track) == pytest.approx((0.15, 0.4))
    assert wheels.radius_from == "the height of the axle above base_footprint"
    unknown = proposed_wheels(robot(*PAIR, root="root"), "root")
    assert unknown is not None
    assert unknown.radius is None


def test_track_of_skid_steering_is_wider_by_the_square_of_its_length(tmp_path: Path):
    """1.805 times for a Husky: its length is 0.512 m and its track 0.5708 m."""
    places = [
        (f"{side}{end}", x * 0.256, y * 0.2854)
        for side, y in (("l", 1), ("r", -1))
        for end, x in ((1, -1), (2, 1))
    ]
    model = robot(*places)
    wheels = proposed_wheels(model, "base_footprint")
    assert wheels is not None
    assert (wheels.left, wheels.right) == (("l1_joint", "l2_joint"), ("r1_joint", "r2_joint"))
    assert wheels.turning_track / wheels.track == pytest.approx(1.805, abs=1e-3)
    found = replace(heard(), model=model, joints=still_joints(model))
    text, settings = written(tmp_path, found)
    assert settings.diff_drive.track == pytest.approx(1.805 * 0.5708, rel=1e-3)
    assert "0.571 between the wheels; calibrate it by a turn" in text


def test_wheels_that_turn_backwards_casters_and_an_axle_behind_the_base_are_remarks():
    swivel = """<link name="fork"/><joint name="swivel" type="continuous">
      <parent link="base"/><child link="fork"/><axis xyz="0 0 1"/></joint>
      <link name="caster"/><joint name="roll" type="continuous">
      <parent link="fork"/><child link="caster"/><axis xyz="0 1 0"/></joint>"""
    behind = [(name, x - 0.3, y) for name, x, y in PAIR]
    wheels = proposed_wheels(robot(*behind, axis=-1, extra=swivel), "base_footprint")
    assert wheels is not None
    backwards, also, middle, steered = wheels.remarks
    assert backwards == "l_joint turns about an axis to the right: its positions count backwards"
    assert also.startswith("r_joint turns")
    assert middle.startswith("their middle is -0.300 m ahead and 0.000 m to the left of base_footprint")
    assert "casters" in steered
    axle = """<link name="axle"/><joint name="a" type="fixed"><parent link="base"/><child link="axle"/>
      <origin xyz="-0.3 0 0"/></joint>"""
    named = proposed_wheels(robot(*behind, extra=axle), "base_footprint")
    assert named is not None
    assert (named.frame, named.remarks) == ("axle", ())


def test_robot_without_wheels_that_mirror_each_other_has_none():
    assert proposed_wheels(load_model("rrbot"), load_model("rrbot").root) is None
    assert proposed_wheels(robot(PAIR[0]), "base_footprint") is None
    assert proposed_wheels(robot(PAIR[0], ("r", 0.2, -0.2)), "base_footprint") is None


def test_first_file_of_a_recording_is_that_of_its_robot(tmp_path: Path):
    recording, file = tmp_path / "run.mcap", tmp_path / "r1.toml"
    with RecordingBuilder(recording) as builder:
        builder.describe("r1", DIFFBOT)
        for n, one in enumerate(readings()):
            bare = Imu(one.stamp, n, 1, "imu_link", one.gyro, one.accel)
            builder.encoder.write_message("r1", bare, one.stamp, "imu")
            if not n % 2:
                builder.joints("r1", one.stamp, [0.0, 0.0], model=DIFFBOT)
    ended = run_cli("odometry", "r1", "--init", str(file), "--replay", str(recording))
    assert ended.code == 0, ended.stderr
    settings = read_settings(str(file))
    assert settings.diff_drive == WHEELS
    assert 0.9 < settings.imu_noise.gyro / GYRO < 1.4
    replayed = run_cli("odometry", "r1", "--file", str(file), "--replay", str(recording))
    assert "base_footprint ends at x" in replayed.stdout, replayed.stderr


def test_options_that_a_first_file_has_no_use_for_are_refused(tmp_path: Path):
    for arguments, error in (
        (("--init", "r1.toml", "--rate", "10"), "--init writes a file; --rate is not for it"),
        (("--init", "r1.toml", "--file", __file__), "--init writes a file; --file is not for it"),
        (("--velocity", "a", "--overwrite"), "--overwrite needs --init FILE.toml"),
    ):
        assert error in failure("odometry", "r1", *arguments, code=2)
