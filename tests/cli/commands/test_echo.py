from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
from math import nan
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import (
    ELBOW,
    SHOULDER,
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_watched,
    started,
)
from helpers.processes import DEADLINE_S, repeated, until
from helpers.programs import moving_edge
from helpers.robots import SampleCollector, wait_for_reader

from zstate import Transform, connect
from zstate.cli.output.joint_state_text import ChangeFilter
from zstate.odometry import (
    FixPublisher,
    ImuPublisher,
    MagneticFieldPublisher,
    OdometryPublisher,
    PosePublisher,
    PressurePublisher,
    VelocityPublisher,
)

FLOATING = """
<robot name="drone">
  <link name="world"/> <link name="body"/> <link name="arm"/>
  <joint name="flight" type="floating"> <parent link="world"/> <child link="body"/> </joint>
  <joint name="swing" type="continuous">
    <parent link="body"/> <child link="arm"/> <axis xyz="0 0 1"/>
  </joint>
</robot>
"""


def test_a_joint_state_is_a_yaml_document():
    with published_robot(velocities=(0.25, 0.0)):
        lines = run_cli("echo", "rrbot", "--once").stdout.splitlines()
    assert lines[0].startswith("stamp: 1")
    assert lines[1].startswith("seq: ")
    assert lines[2:] == [
        "positions:",
        f"  shoulder: {SHOULDER}",
        f"  elbow: {ELBOW}",
        "velocities:",
        "  shoulder: 0.25",
        "  elbow: 0.0",
        "---",
    ]


@pytest.mark.processes
def test_documents_follow_each_other_until_ctrl_c(spawn: Spawn):
    command = started(spawn, "echo", "rrbot", "--field", "seq")
    with published_robot():
        first = int(command.line())
        assert [int(command.line()) for _ in range(20)] == list(range(first + 1, first + 21))
        interrupted(command)


def test_setpoints_of_a_robot_without_a_driver_host_are_explained():
    with published_robot():
        message = failure("echo", "rrbot", "--stream", "joint_setpoints", "--once", "--timeout", "1")
    assert "'rrbot' has no driver host; start the program with its zstate.driving.DriverHost" in message


def test_transforms_are_documents_of_poses_by_edge():
    with moving_edge("r1", "odom", "base", (1.0, 2.0, 3.0)):
        document = json.loads(run_cli("echo", "r1", "--stream", "transforms", "--once", "--json").stdout)
    pose = {"translation": [1.0, 2.0, 3.0], "rotation": [0.0, 0.0, 0.0, 1.0]}
    assert document["transforms"] == {"odom -> base": pose}
    assert document["stamp"] > 0


def test_json_is_one_object_a_line():
    with published_robot():
        document = json.loads(run_cli("echo", "rrbot", "--once", "--json").stdout)
    assert document["positions"] == {"shoulder": SHOULDER, "elbow": ELBOW}
    assert "velocities" not in document


def test_csv_has_one_line_of_names():
    with published_robot():
        ended = run_watched(lambda command: [command.line() for _ in range(3)], "echo", "rrbot", "--csv")
    names, first, second, *_ = csv.reader(ended.stdout.splitlines())
    assert names == ["stamp", "seq", "positions.shoulder", "positions.elbow"]
    assert first[2:] == second[2:] == [str(SHOULDER), str(ELBOW)]
    assert int(second[1]) == int(first[1]) + 1


@pytest.mark.parametrize(
    ("field", "printed"),
    [("elbow", f"{ELBOW}"), ("positions.shoulder", f"{SHOULDER}"), ("velocities.elbow", "0.125")],
)
def test_a_field_is_printed_alone(field: str, printed: str):
    with published_robot(velocities=(0.0, 0.125)):
        assert run_cli("echo", "rrbot", "--once", "--field", field).stdout == f"{printed}\n"


def test_changed_prints_only_changed_documents():
    def change(command: Command) -> None:
        with published_robot():
            first = json.loads(command.line())
            with connect() as reader:
                settle = SampleCollector(reader, "zstate/rrbot/joint_states")
                settle.payloads(20)
                settle.close()
        with published_robot(positions=(SHOULDER, 0.25)):
            second = json.loads(command.line())
        assert first["positions"]["elbow"] == ELBOW
        assert second["positions"] == {"shoulder": SHOULDER, "elbow": 0.25}

    run_watched(change, "echo", "rrbot", "--changed", "--json")


def test_by_accepts_only_larger_differences():
    changes = ChangeFilter(by=0.1)
    states = [
        {"stamp": stamp, "seq": stamp, "positions": {"elbow": elbow}, "velocities": {"elbow": velocity}}
        for stamp, (elbow, velocity) in enumerate([(0.0, 0.0), (0.09, 0.0), (0.11, 0.0), (0.15, 1.0)])
    ]
    assert [changes.accepts(state) for state in states] == [True, False, True, True]
    assert [changes.accepts(value) for value in (5, 5, nan, nan, 6)] == [True, False, True, False, True]
    assert changes.accepts({"elbow": 6.0})
    assert not changes.accepts({"elbow": 6.0})


@pytest.mark.parametrize("amount", ["-1", "nan"])
def test_invalid_amount_is_wrong_usage(amount: str):
    assert "an amount is finite and at least 0" in failure(
        "echo", "rrbot", "--changed", "--by", amount, code=2
    )


def test_unknown_field_error_lists_the_fields():
    with published_robot():
        message = failure("echo", "rrbot", "--once", "--field", "elbo")
    assert "did you mean 'elbow'?" in message
    assert "joints: shoulder, elbow" in message


def test_a_floating_joint_has_its_seven_numbers_together(tmp_path: Path):
    model = tmp_path / "drone.urdf"
    model.write_text(FLOATING)
    pose = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    rates = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    with published_robot("drone", (*pose, 0.75), velocities=(*rates, 0.7), model=str(model)):
        document = json.loads(run_cli("echo", "drone", "--once", "--json").stdout)
    assert document["positions"] == {"flight": list(pose), "swing": 0.75}
    assert document["velocities"] == {"flight": list(rates), "swing": 0.7}


def test_numbers_without_a_description_have_no_names():
    with published_robot(streams=("joint_states",)):
        ended = run_cli("echo", "rrbot", "--once", "--json")
    assert json.loads(ended.stdout)["positions"] == [SHOULDER, ELBOW]
    assert "`zstate publish rrbot` publishes it" in ended.stderr


def test_echo_waits_for_a_robot_and_prints_the_reason():
    def watch(command: Command) -> None:
        until(lambda: "waiting: robot 'rrbot' is not announced" in command.stderr)
        with published_robot():
            assert command.line() == str(ELBOW)
        assert "received zstate/rrbot/joint_states" in command.stderr

    run_watched(watch, "echo", "rrbot", "--field", "elbow")


def test_once_gives_up_with_the_reason():
    with published_robot(streams=("robot_description",)):
        message = failure("echo", "rrbot", "--once", "--timeout", "1")
    assert "zstate: gave up after 1 s: joint_states of 'rrbot' has no writer" in message


@pytest.mark.processes
def test_sigterm_ends_it_as_well(spawn: Spawn):
    command = started(spawn, "echo", "rrbot", "--field", "elbow")
    with published_robot():
        command.line()
        command.process.send_signal(signal.SIGTERM)
        assert command.wait(2.0) == 128 + signal.SIGTERM


@pytest.mark.processes
def test_a_reader_that_leaves_ends_it_quietly():
    command = [sys.executable, "-m", "zstate", "echo", "rrbot"]
    with (
        published_robot(),
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process,
    ):
        assert process.stdout
        assert process.stderr
        process.stdout.readline()
        process.stdout.close()
        process.wait(DEADLINE_S)
        assert process.stderr.read() == b""


def test_undecodable_messages_are_reported_once_and_skipped():
    def disturb(command: Command) -> None:
        with published_robot(), connect() as stranger:
            command.line()
            wait_for_reader(stranger, "zstate/rrbot/joint_states")
            for _ in range(3):
                stranger.zenoh.put("zstate/rrbot/joint_states", b"hello", encoding="text/plain")
            until(lambda: "text/plain" in command.stderr)
            assert [command.line() for _ in range(50)] == [str(ELBOW)] * 50
        assert command.stderr.count("text/plain") == 1

    run_watched(disturb, "echo", "rrbot", "--field", "elbow")


def test_a_name_that_no_robot_can_have_is_refused():
    assert "'a/b'" in failure("echo", "a/b")


def test_robot_may_be_omitted_if_there_is_only_one():
    with published_robot():
        assert "elbow" in run_cli("echo", "--once").stdout
        assert run_cli("hz", "--once").stdout.startswith("average rate: ")


@pytest.mark.parametrize("command", ["echo", "hz"])
def test_with_several_robots_the_candidates_are_named(command: str):
    with published_robot("left"), published_robot("right"):
        assert "which robot? announced: 'left', 'right'" in failure(command, "--once")


@pytest.mark.parametrize("command", ["echo", "hz"])
def test_a_topic_of_ros_leads_to_its_wire(command: str):
    message = failure(command, "/joint_states", code=2)
    assert f"is a ROS topic, not a robot; `zstate {command} --wire ros2` reads /joint_states" in message


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (
            "odometry",
            {
                **{"parent": "r1/odom", "child": "r1/base", "translation": [1.0, 0.0, 0.0]},
                **{"rotation": [0.0, 0.0, 0.0, 1.0], "linear": [0.5, 0.0, 0.0], "angular": [0.0, 0.0, 0.25]},
                "pose_sigma": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
            },
        ),
        (
            "pose",
            {
                **{"parent": "r1/odom", "child": "r1/base", "translation": [1.0, 0.0, 0.0]},
                **{"rotation": [0.0, 0.0, 0.0, 1.0], "pose_sigma": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]},
            },
        ),
        ("imu", {"frame": "r1/chest", "gyro": [0.0, 0.0, 0.25], "accel": [0.0, 0.0, 9.81]}),
        (
            "fix",
            {
                **{"frame": "r1/gps", "status": "fix", "latitude": 47.5, "longitude": 8.25, "altitude": None},
                **{"sigma_east": 1.0, "sigma_north": 2.0, "sigma_up": 3.0},
            },
        ),
        ("pressure", {"frame": "r1/bmp", "pressure": 101325.0, "sigma": 1.5}),
        ("magnetic_field", {"frame": "r1/mag", "field": [2e-5, 0.0, -4e-5], "field_sigma": [1e-7] * 3}),
        ("velocity", {"frame": "r1/flow", "linear": [0.5, 0.0, 0.0], "velocity_sigma": [2.0, 2.0, 2.0]}),
    ],
)
def test_odometry_and_measurements_are_documents(stream: str, expected: dict[str, object]):
    variances = np.diag(np.arange(1.0, 7.0) ** 2)
    base = Transform("odom", "base", [1, 0, 0], [0, 0, 0, 1]).with_covariance(variances)
    with (
        connect() as session,
        OdometryPublisher(session, "r1") as odometry,
        ImuPublisher(session, "r1", frame="chest") as imu,
        VelocityPublisher(session, "r1", "flow") as velocity,
        PosePublisher(session, "r1", "mocap") as mocap,
        FixPublisher(session, "r1", "gps") as gps,
        PressurePublisher(session, "r1", "bmp") as barometer,
        MagneticFieldPublisher(session, "r1", "mag", covariance=np.eye(3) * 1e-14) as mag,
    ):

        def publish() -> None:
            odometry.publish(base, [0.5, 0, 0], [0, 0, 0.25])
            imu.publish([0, 0, 0.25], [0, 0, 9.81])
            velocity.publish([0.5, 0, 0], covariance=np.eye(3) * 4)
            mocap.publish(base)
            gps.publish(47.5, 8.25, covariance=variances[:3, :3])
            barometer.publish(101325.0, variance=2.25)
            mag.publish([2e-5, 0, -4e-5])

        with repeated(publish):
            document = json.loads(run_cli("echo", "r1", "--stream", stream, "--once", "--json").stdout)
            rate = json.loads(run_cli("hz", "r1", "--stream", stream, "--once", "--json").stdout)
            listed = json.loads(run_cli("ls", "--json").stdout)
    assert {name: value for name, value in document.items() if name not in ("stamp", "seq")} == expected
    assert rate["rate_hz"] > 1.0
    names = {writer["stream"]: writer["names"] for writer in listed[0]["writers"]}
    assert names == {
        **{"odometry": ["odometry"], "imu": ["imu"], "velocity": ["flow"], "pose": ["mocap"]},
        **{"fix": ["gps"], "magnetic_field": ["mag"], "pressure": ["bmp"]},
    }
    assert all(writer["rate_hz"] for writer in listed[0]["writers"])


def test_receiver_without_a_fix_says_so_in_a_row_of_the_same_columns():
    with (
        connect() as session,
        FixPublisher(session, "r1", "gps") as gps,
        repeated(lambda: gps.publish(None, None, status=-1)),
    ):
        names, row = run_cli("echo", "r1", "--stream", "fix", "--once", "--csv").stdout.splitlines()
    assert names == ("stamp,seq,frame,status,latitude,longitude,altitude,sigma_east,sigma_north,sigma_up")
    assert row.split(",")[2:] == ["r1/gps", "no fix", *["nan"] * 6]


def test_sensor_that_is_not_published_is_explained():
    with published_robot():
        message = failure("echo", "rrbot", "--stream", "imu", "--once", "--timeout", "1")
    assert "imu of 'rrbot' has no writer; start the program of the sensor" in message
    assert "zstate.odometry.ImuPublisher" in message


def test_it_ends_after_the_seconds_that_are_given():
    with published_robot():
        ended = run_cli("echo", "rrbot", "--field", "seq", "--seconds", "2")
    numbers = list(map(int, ended.stdout.splitlines()))
    assert len(numbers) > 1
    assert numbers == sorted(set(numbers))


def test_without_samples_it_fails_after_the_seconds_with_the_reason():
    assert "gave up after 0.5 s" in failure("echo", "rrbot", "--seconds", "0.5")


def test_seconds_are_refused_with_once():
    assert "--timeout limits the wait" in failure("echo", "rrbot", "--once", "--seconds", "1", code=2)
