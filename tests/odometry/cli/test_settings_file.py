from __future__ import annotations

import math
import re
import tomllib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from zstate import Transform, TransformBuffer
from zstate.errors import ConfigError, InvalidInput
from zstate.odometry import (
    Ackermann,
    BarometerNoise,
    DiffDrive,
    FixNoise,
    ForceThresholds,
    HeadingNoise,
    ImuNoise,
    LegNoise,
    MagnetometerNoise,
    PoseNoise,
    SpeedThresholds,
    VelocityNoise,
    WheelNoise,
)
from zstate.odometry.cli.settings_file import (
    LegSettings,
    OdometrySettings,
    parse_diff_drive,
    parse_feet,
    parse_sensor,
    read_settings,
    table_name,
)
from zstate.odometry.sensors import KINDS, Sensor
from zstate.odometry.source_noise import SourceNoise

ROVER = """
imu = "body"
history_s = 2.0
initial_pose = [2.0, 1, 90.0]

[imu_noise]
gyro = 2e-3
accel = 1e-2
gyro_bias = 1e-5
accel_bias = 1e-4

[diff_drive]
left = "l"
right = ["r1", "r2"]
radius = 0.1
track = 0.5
noise = { slip = 0.1 }

[velocity.flow]
[velocity.radar]
sigma = [0.1, 0.2, 0.3]
scale = 0.01

[pose.mocap]
sigma = 0.01
sigma_deg = 1
"""


def written(folder: Path, text: str) -> str:
    path = folder / "rover.toml"
    path.write_text(text)
    return str(path)


def test_file_has_the_settings_of_one_robot(tmp_path: Path):
    settings = read_settings(written(tmp_path, ROVER))
    assert settings == OdometrySettings(
        imu="body",
        velocity={"flow": VelocityNoise(), "radar": VelocityNoise(sigma=(0.1, 0.2, 0.3), scale=0.01)},
        pose={"mocap": PoseNoise(sigma=0.01, sigma_deg=1.0)},
        initial_pose=(2.0, 1.0, 90.0),
        history_s=2.0,
        imu_noise=ImuNoise(gyro=2e-3, accel=1e-2, gyro_bias=1e-5, accel_bias=1e-4),
        diff_drive=DiffDrive("l", ["r1", "r2"], 0.1, 0.5, noise=WheelNoise(slip=0.1)),
    )


def test_other_wheels_have_tables_of_their_own_names(tmp_path: Path):
    text = '[ackermann]\nleft="l"\nright="r"\nsteering="s"\nradius=0.3\ntrack=1.2\nwheelbase=2.5\n'
    assert read_settings(written(tmp_path, text)).wheels == Ackermann("l", "r", "s", 0.3, 1.2, 2.5)


LEGS = """
[legs]
feet = ["l_foot", "r_foot"]
noise = { slip = 0.02 }
force = { touchdown = 40.0, liftoff = 20.0 }
"""


def test_legs_have_feet_noise_and_the_thresholds_of_contacts(tmp_path: Path):
    assert read_settings(written(tmp_path, LEGS)).legs == LegSettings(
        feet=("l_foot", "r_foot"), noise=LegNoise(slip=0.02), force=ForceThresholds(40.0, 20.0)
    )
    by_speed = LEGS.replace(
        "force = { touchdown = 40.0, liftoff = 20.0 }", "speed = { touchdown = 0.2, liftoff = 0.3 }"
    )
    legs = read_settings(written(tmp_path, by_speed)).legs
    assert legs is not None
    assert legs.detection == SpeedThresholds(0.2, 0.3)


def test_contacts_are_detected_by_0_1_and_0_2_m_per_s_where_nothing_is_stated():
    assert LegSettings(feet=("foot",)).detection == SpeedThresholds(touchdown=0.1, liftoff=0.2)


@pytest.mark.parametrize(
    ("before", "after", "error"),
    [
        ("slip", "slop", r"rover.toml:4: legs.noise.slop: unknown key; did you mean 'slip'\?"),
        ("20.0", "50.0", "legs.force: forces of contacts are 0 < liftoff < touchdown"),
        ("[legs]", "[legs]\nspeed = { touchdown = 0.1, liftoff = 0.2 }", "by force or by speed; give one"),
    ],
)
def test_each_mistake_of_legs_has_its_reason(tmp_path: Path, before: str, after: str, error: str):
    with pytest.raises(ConfigError, match=error):
        read_settings(written(tmp_path, LEGS.replace(before, after, 1)))


def test_feet_of_a_command_line_are_links():
    assert parse_feet("a, b") == LegSettings(feet=("a", "b"))
    with pytest.raises(InvalidInput, match="names of links"):
        parse_feet("a,,b")


@pytest.mark.parametrize(
    ("before", "after", "error"),
    [
        ("radius", "radus", r"rover.toml:15: diff_drive.radus: unknown key; did you mean 'radius'\?"),
        ("radius = 0.1", "", "rover.toml:12: diff_drive: Object missing required field `radius`"),
        ("slip", "slop", r"unknown key; did you mean 'slip'\?"),
        ("0.5", "-0.5", "rover.toml:12: diff_drive: the track of wheels is a length"),
        ("history_s", "history", "rover.toml:3: history: unknown key"),
        (
            "gyro = 2e-3",
            "gyro = 0",
            "rover.toml:6: imu_noise: the noise 'gyro' of an IMU is a finite density",
        ),
        ('imu = "body"', "imu = 3", "rover.toml:2: imu: Expected `str`, got `int`"),
        ("[2.0, 1, 90.0]", "[2.0, 1]", "rover.toml:4: initial_pose: Expected `array` of length 3, got 2"),
        ("[0.1, 0.2, 0.3]", "true", r"rover.toml:21: velocity.radar.sigma: Expected `float \| array"),
        ("[0.1, 0.2, 0.3]", "-0.1", "rover.toml:20: velocity.radar: sigma is a standard deviation above"),
        ("scale = 0.01", "scal = 0.01", r"rover.toml:22: velocity.radar.scal: unknown key; did you mean"),
        ("sigma_deg = 1", "", r"rover.toml:24: pose.mocap: a pose has both, sigma \[m\] and sigma_deg"),
        ("[velocity.flow]", "[velocity]\nflow = 1", "rover.toml:20: velocity.flow: Expected `object`, got"),
    ],
)
def test_each_mistake_has_its_line(tmp_path: Path, before: str, after: str, error: str):
    with pytest.raises(ConfigError, match=error):
        read_settings(written(tmp_path, ROVER.replace(before, after, 1)))


def test_robot_has_wheels_of_one_kind(tmp_path: Path):
    text = ROVER + '[mecanum]\nfront_left="a"\nfront_right="b"\nrear_left="c"\nrear_right="d"\n'
    with pytest.raises(ConfigError, match="a robot has wheels of one kind, not of diff_drive and mecanum"):
        read_settings(written(tmp_path, text + "radius=0.1\ntrack=0.5\nwheelbase=0.5\n"))


def test_noise_of_a_source_is_stated_on_the_command_line():
    assert parse_sensor("velocity", "wheels") == ("wheels", VelocityNoise())
    assert parse_sensor("velocity", "wheels:sigma=0.05, scale=0") == (
        "wheels",
        VelocityNoise(sigma=0.05, scale=0.0),
    )
    assert parse_sensor("pose", "mocap:sigma=0.01,sigma_deg=1")[1].sigmas == pytest.approx(
        (0.01,) * 3 + (0.0174533,) * 3
    )
    assert parse_sensor("heading", "imu:sigma_deg=5") == ("imu", HeadingNoise(sigma_deg=5.0))
    assert parse_sensor("magnetometer", "mag") == ("mag", MagnetometerNoise(sigma_deg=5.0))
    assert parse_sensor("magnetometer", "mag:sigma_deg=8")[1] == MagnetometerNoise(sigma_deg=8.0)
    assert parse_sensor("fix", "gps") == ("gps", FixNoise())
    assert parse_sensor("fix", "gps:sigma=1.5,correlated_s=30")[1] == FixNoise(sigma=1.5, correlated_s=30.0)
    assert FixNoise(sigma=1.5).sigmas == (1.5, 15.0)
    assert parse_sensor("barometer", "bmp:sigma=0.3") == ("bmp", BarometerNoise(sigma=0.3))


def test_delay_gate_and_axes_are_those_of_any_source_in_a_file_and_on_a_command_line(tmp_path: Path):
    text = "[{}]\ndelay_s = 0.04\ngate = 0.99\n"
    tables = ("velocity.a", "pose.b", "heading.c", "fix.d")
    settings = read_settings(written(tmp_path, "".join(map(text.format, tables))))
    for table, sensor in zip(tables, settings.sensors, strict=True):
        kind, name = table.split(".")
        assert (sensor.name, sensor.noise.delay_ns, sensor.noise.gate) == (name, 40_000_000, 0.99)
        assert parse_sensor(kind, f"{name}:delay_s=0.04,gate=0.99") == (name, sensor.noise)
    text = '[pose.mocap]\naxes = ["yaw", "x", "y"]\n[velocity.radar]\naxes = ["x"]\n'
    settings = read_settings(written(tmp_path, text))
    assert parse_sensor("pose", "mocap:axes=yaw+x+y")[1] == settings.pose["mocap"]
    assert parse_sensor("velocity", "radar:axes=x")[1] == settings.velocity["radar"]
    with pytest.raises(
        ConfigError, match=r"pose.mocap: axes of a pose are x, .* not 'yw'; did you mean 'yaw'"
    ):
        read_settings(written(tmp_path, text.replace("yaw", "yw")))


def test_file_has_receivers_and_the_origin_of_their_map(tmp_path: Path):
    text = 'map = "site/map"\nplanar = true\ndatum = [48.1, 11.5, 560.0]\n' + ROVER
    text += "[fix.gps]\nsigma = [1.5, 4.0]\n[heading.imu]\nsigma_deg = 5.0\n[barometer.bmp]\nwander = 2\n"
    settings = read_settings(written(tmp_path, text))
    assert (settings.map, settings.datum, settings.planar) == ("site/map", (48.1, 11.5, 560.0), True)
    assert settings.fix == {"gps": FixNoise(sigma=(1.5, 4.0))}
    assert settings.heading == {"imu": HeadingNoise(sigma_deg=5.0)}
    assert settings.barometer == {"bmp": BarometerNoise(wander=2.0)}
    with pytest.raises(ConfigError, match="a place has a latitude of -90 to 90"):
        read_settings(written(tmp_path, text.replace("48.1", "98.1")))
    with pytest.raises(
        ConfigError, match=r"rover.toml:\d+: fix.gps: sigma of a satellite receiver is above zero"
    ):
        read_settings(written(tmp_path, text.replace("4.0]", "0.0]")))


def test_what_is_no_number_is_stated_in_a_file_alone():
    with pytest.raises(
        InvalidInput, match=r"'bias=1' is not part of SENSOR:sigma_deg=NUMBER,delay_s=NUMBER,gate=NUMBER$"
    ):
        parse_sensor("magnetometer", "mag:bias=1")


MAGNETOMETER = """
[magnetometer.mag]
sigma_deg = 8.0
bias = [1e-6, 0.0, -3e-6]
soft_iron = [[0.0, 2.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
place = [48.1, 11.5]
"""


def test_file_has_the_calibration_and_the_place_of_a_magnetometer(tmp_path: Path):
    noise = read_settings(written(tmp_path, ROVER + MAGNETOMETER)).magnetometer["mag"]
    assert (noise.sigma_deg, noise.place) == (8.0, (48.1, 11.5))
    # The bias is subtracted first.
    assert noise.calibrated(np.array((21e-6, 5e-6, -43e-6))) == pytest.approx([10e-6, 20e-6, -40e-6])


@pytest.mark.parametrize(
    ("right", "wrong", "text"),
    [
        ("8.0", "0.0", "magnetometer.mag: sigma_deg is a standard deviation above zero"),
        ("-3e-6]", "nan]", "magnetometer.mag: bias of a magnetometer is finite; got"),
        ("2.0", "inf", "magnetometer.mag: soft_iron of a magnetometer is finite; got"),
        ("48.1", "98.1", "magnetometer.mag: a place has a latitude of -90 to 90"),
        ("bias = [1e-6, ", "bias = [", "magnetometer.mag.bias: .*length 3"),
    ],
)
def test_unusable_settings_of_a_magnetometer_are_named(tmp_path: Path, right: str, wrong: str, text: str):
    with pytest.raises(ConfigError, match=rf"rover.toml:\d+: {text}"):
        read_settings(written(tmp_path, ROVER + MAGNETOMETER.replace(right, wrong)))


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (
            "wheels:sgma=1",
            r"'sgma=1' is not part of SENSOR:sigma=NUMBER,scale=NUMBER,axes=x\+y,delay_s=NUMBER,gate=NUMBER; "
            r"did you mean 'sigma'\?",
        ),
        ("wheels:sigma=1,sigma=2", "'sigma=2' is not part of"),
        ("wheels:sigma=a", "sigma is a number, not 'a'"),
        ("wheels:sigma=nan", "sigma is a standard deviation above zero, or three"),
        ("wheels:scale=-1", "the scale of a velocity is a part of it, 0 or more"),
        ("wheels:axes=x+yaw", "axes of a velocity are x, y, z, not 'yaw'"),
        ("wheels:axes=x+x", "axes of a velocity are some of x, y, z, each once; got x, x"),
        ("wheels:delay_s=70", r"delay_s is by how much stamps are late \[s\], at most 60; got 70.0"),
        ("wheels:gate=0.5", "the gate of a source is the part of its readings that pass .* got 0.5"),
        ("wheels:gate=1", "above 0.5 and below 1, as 0.999; got 1.0"),
        ("wheels:", "'' is not part of"),
        ("a/b", "contains '/'"),
    ],
)
def test_unusable_noise_of_a_source_is_refused(text: str, error: str):
    with pytest.raises(InvalidInput, match=error):
        parse_sensor("velocity", text)


def test_initial_pose_is_where_the_base_starts():
    mounts = TransformBuffer()
    mounts.insert_static(Transform("r1/base", "r1/imu", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
    settings = OdometrySettings(initial_pose=(2.0, 1.0, 90.0))
    base = settings.estimator("r1", "base", "imu", mounts, None)
    base.imu(0, [0.0, 0.0, 0.0], [0.0, 0.0, 9.80665])
    pose = base.state().odom_from_base
    assert [*pose.translation, pose.rpy[2]] == pytest.approx([2.0, 1.0, 0.0, math.pi / 2])


def test_wheels_of_a_command_line_may_be_several_on_a_side():
    text = "left=a,left=b,right=c,radius=0.1,track=0.5"
    assert parse_diff_drive(text) == DiffDrive(["a", "b"], "c", 0.1, 0.5)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("left=a,right=b,radius=0.1", "track missing"),
        ("left=a,right=b,radius=x,track=1", "radius is a number"),
        ("left=a,right=b,radius=1,radius=2,track=1", "'radius=2' is not part of"),
        ("a,b", "'a' is not part of left=JOINT"),
    ],
)
def test_unusable_wheels_are_refused(text: str, error: str):
    with pytest.raises(InvalidInput, match=error):
        parse_diff_drive(text)


def test_names_of_tables_are_those_of_a_file(tmp_path: Path):
    """What --replay prints is to be copied."""
    path = tmp_path / "r1.toml"
    named = ("velocity", "wheels"), ("relative", "odometry/driver")
    sensors = [Sensor(kind, name, kind.noise()) for kind in KINDS for of, name in named if kind.name == of]
    path.write_text("".join(f"[{table_name(one.kind, one.name)}]\ndelay_s = 0.3\n" for one in sensors))
    assert [(one.name, one.noise.delay_s) for one in read_settings(str(path)).sensors] == [
        (name, 0.3) for _, name in named
    ]


def test_settings_of_the_rover_explain_every_key(tmp_path: Path):
    """Those of other robots are comments; without their # it is a file that can be read."""
    text = (Path(__file__).parents[3] / "models/rover.toml").read_text()
    path = tmp_path / "rover.toml"
    path.write_text(re.sub(r"^# (?=\[|\w+ = )", "", text, flags=re.MULTILINE))
    assert len(read_settings(str(path)).sensors) == len(KINDS)
    tables = tomllib.loads(path.read_text())
    wheels = {"ackermann", "mecanum"}  # in place of diff_drive
    assert {one.name for one in fields(OdometrySettings)} - tables.keys() == wheels
    common = {one.name for one in fields(SourceNoise)}
    assert common < tables["velocity"]["flow"].keys()
    for kind in KINDS:
        (table,) = tables[kind.name].values()
        assert {one.name for one in fields(kind.noise)} - common - table.keys() == set()


def test_what_is_wrong_with_a_source_whose_name_is_quoted_has_its_line(tmp_path: Path):
    file = tmp_path / "r1.toml"
    file.write_text('imu = "imu"\n\n[relative."pose/camera"]\nsigma = 0.1\ngate = 1\nsigm = 2\n')
    with pytest.raises(ConfigError, match=r"r1.toml:6: relative.pose/camera.sigm: unknown key; did you mean"):
        read_settings(str(file))


def test_a_word_that_a_key_does_not_know_is_answered_with_those_that_it_knows(tmp_path: Path):
    file = tmp_path / "r1.toml"
    file.write_text('[relative."pose/camera"]\ncovariance = "dependant"\n')
    with pytest.raises(
        ConfigError, match=r"r1.toml:2: .*dependent, independent, stated, not 'dependant'; did"
    ):
        read_settings(str(file))
