"""zstate move and zstate stop, of drivers in this process and in others."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import (
    Command,
    Spawn,
    failure,
    interrupted,
    run_cli,
    run_watched,
    start_rover,
    started,
)
from helpers.processes import DEADLINE_S, Child, repeated, until
from helpers.programs import driver

from zstate import JointReading, TransformListener, connect
from zstate.driving import Commander, stop
from zstate.driving.messages import DriverState, state_text
from zstate.net.latched import LatchedSubscriber
from zstate.sources import JointStateListener
from zstate.wire.keys import stream_key
from zstate.wire.native import decode
from zstate.wire.protocol import SerializedSample


@contextmanager
def states_of(robot: str) -> Generator[list[str]]:
    """The states of a driver as `zstate drive` prints them, as they come."""
    lines: list[str] = []

    def on_value(sample: SerializedSample) -> None:
        lines.append(state_text(decode(sample.payload, sample.encoding, DriverState)))

    with connect() as session, LatchedSubscriber(session, stream_key(robot, "driver"), on_value):
        yield lines


@pytest.fixture
def a_driver() -> Generator[None]:
    """That of rrbot."""
    with driver():
        yield


def line_with(child: Child, text: str) -> str:
    while text not in (line := child.line()):
        pass
    return line


def printed(*arguments: str) -> str:
    ended = run_cli(*arguments)
    assert ended.code == 0, ended.stderr
    return ended.stdout


def test_joints_are_moved_and_the_outcome_is_awaited():
    with driver(), states_of("rrbot") as lines, connect() as session:
        reached = printed("move", "rrbot", "shoulder=0.3", "elbow=-0.2")
        assert re.fullmatch(r"reached in \d+\.\d s\n", reached)
        until(lambda: any(line.startswith("active, commanded by zstate-move@") for line in lines))
        with TransformListener(session, "rrbot") as listener:
            listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
            until(lambda: np.allclose(listener.buffer.joint_positions("rrbot")[0], [0.3, -0.2], atol=0.02))


def test_motion_beyond_the_limits_is_refused_with_all_findings_and_stretched_on_request(a_driver: None):
    fast = ("move", "rrbot", "shoulder=1", "elbow=-1", "--seconds", "0.3")
    # A cubic at rest at both ends has its largest speed, 1.5 times the mean, half-way: 1.5 * 1 / 0.3.
    # Its acceleration is 6 * 1 / 0.3^2 at both ends, and the limits are reached in 0.2 s by default.
    *_, shoulder, elbow, starting, bending = failure(*fast).splitlines()
    assert "'shoulder' moves at 5 rad/s, above 2.5" in shoulder
    assert "'elbow' moves at -5 rad/s, above 3.5" in elbow
    assert "'shoulder' accelerates at 66.6666667 rad/s^2, above 12.5" in starting
    assert "'elbow' accelerates at -66.6666667 rad/s^2, above 17.5" in bending
    refused = run_cli(*fast, "--json")
    document = json.loads(refused.stdout)
    assert (refused.code, document["outcome"], len(document["findings"])) == (1, "refused", 4)
    assert document["reason"] == "", "a text, as of every other outcome"
    assert json.loads(printed(*fast, "--stretch", "--json"))["outcome"] == "reached"


def test_degrees_are_converted_on_request_and_guessed_in_a_refusal():
    with (
        driver("gripper"),
        connect() as session,
        JointStateListener(session, "gripper") as joints,
    ):
        text = failure("move", "gripper", "thumb_joint=60")
        assert "'thumb_joint' at 60 rad is outside 0 to 1.2" in text
        assert "s after the start; this looks like degrees" in text
        assert "--deg takes numbers in degrees" in text
        newest: list[JointReading] = []

        def is_there(positions: list[float]) -> bool:
            newest.extend(one for one in [joints.read(0)] if one is not None)
            return bool(newest) and np.allclose(newest[-1].positions, positions, atol=2e-3)

        # The linear joint stays in metres.
        printed("move", "gripper", "thumb_joint=60", "finger_joint=0.03", "--deg")
        until(lambda: is_there([0.03, np.pi / 3]))


def test_points_of_a_file_are_followed(a_driver: None, tmp_path: Path):
    points = tmp_path / "wave.csv"
    points.write_text("time, elbow\n0.4, 0.2\n0.8, -0.1\n")
    assert printed("move", "rrbot", "--file", str(points)).startswith("reached in ")
    points.write_text("time,elbow\n0.4,0.2,1\n")
    assert "wave.csv, line 2 has 3 numbers, and the first line 2" in failure(
        "move", "rrbot", "--file", str(points)
    )
    points.write_text("elbow,time\n")
    assert "starts with 'elbow,time', not with time,JOINT,..." in failure(
        "move", "rrbot", "--file", str(points)
    )


def test_wheels_keep_a_velocity_for_some_seconds_and_brake():
    turned: list[JointReading] = []
    with (
        driver("diffbot"),
        states_of("diffbot") as lines,
        connect() as session,
        JointStateListener(session, "diffbot", on_reading=turned.append) as joints,
    ):
        until(lambda: joints.read(0) is not None)
        assert printed("move", "diffbot", "--velocity", "left_wheel_joint=2", "--seconds", "0.5") == ""
        until(lambda: any(line.startswith("active, commanded by zstate-move@") for line in lines))
        until(lambda: turned[-1].velocities[0] == pytest.approx(0.0, abs=1e-3))
        assert "limits" not in failure("move", "diffbot", "--velocity", "left_wheel=2")
    assert max(one.velocities[0] for one in turned) == pytest.approx(2.0, abs=0.01)
    left, right = turned[-1].positions
    assert left > 0.4 * 2.0
    assert right == 0.0


@pytest.mark.processes
def test_ctrl_c_brakes_wheels(spawn: Spawn):
    with driver("diffbot"):
        child = started(spawn, "move", "diffbot", "--velocity", "left_wheel_joint=2", "--seconds", "60")
        until(lambda: "moving" in child.stderr)
        interrupted(child)
        with connect() as session, JointStateListener(session, "diffbot") as joints:
            until(lambda: (reading := joints.read(0)) and abs(reading.velocities[0]) < 1e-3)


@pytest.mark.processes
def test_ctrl_c_cancels_a_motion_and_the_joints_brake(spawn: Spawn):
    with driver(), states_of("rrbot") as lines:
        child = started(spawn, "move", "rrbot", "shoulder=2", "--seconds", "60")
        until(lambda: any(line.startswith("active, commanded by zstate-move@") for line in lines))
        until(lambda: "moving" in child.stderr)
        interrupted(child)
    assert "cancelled: the joints of 'rrbot' brake" in child.stderr


def test_motion_ends_with_the_stop_of_another_program(a_driver: None):
    def open_door(command: Command) -> None:
        with states_of("rrbot") as lines, connect() as session:
            until(lambda: any(line.startswith("active, commanded by zstate-move@") for line in lines))
            stop(session, "rrbot", "door open", timeout_s=DEADLINE_S)
            assert command.is_over()

    ended = run_watched(open_door, "move", "rrbot", "shoulder=2", "--seconds", "60", code=1)
    assert "the motion of 'rrbot' was stopped: " in ended.stderr
    assert "door open" in ended.stderr
    assert "door open" in failure("move", "rrbot", "shoulder=0")


def test_motions_without_a_driver_or_joints_are_refused(tmp_path: Path):
    assert "no driver of 'rrbot' has published its state within 0.3 s" in failure(
        "move", "rrbot", "elbow=1", "--timeout", "0.3"
    )
    for arguments, error in (
        ((), "give JOINT=VALUE for some joints"),
        (("elbow",), "'elbow' is not JOINT=VALUE with a number"),
        (("elbow=1", "elbow=2"), "a joint is given twice"),
        (("--file", __file__, "--seconds", "1"), "--file has its own times"),
        (("elbow=1", "--velocity", "--stretch"), "--velocity takes JOINT=VALUE and --seconds"),
    ):
        assert error in failure("move", "rrbot", *arguments, code=2)


@pytest.mark.processes
def test_stop_is_latched_over_a_restart_of_the_driver_until_the_release(spawn: Spawn):
    host = started(spawn, "drive", "sim", "rrbot")
    line_with(host, "ready")
    assert printed("stop", "rrbot", "--reason", "door open").startswith("rrbot: stopped by zstate-stop@")
    stopped = host.line()
    assert stopped.startswith("stopped by zstate-stop@")
    assert stopped.endswith(": door open")
    host.kill()
    again = started(spawn, "drive", "sim", "rrbot")
    line_with(again, stopped)
    assert printed("stop", "rrbot", "--release").startswith("rrbot: ready: released by zstate-stop@")
    line_with(again, "ready: released by zstate-stop@")


def test_all_drivers_are_stopped_and_reported_as_json():
    with driver(name="left"), driver(name="right"):
        documents = [json.loads(line) for line in printed("stop", "--all", "--json").splitlines()]
    assert [document["robot"] for document in documents] == ["left", "right"]
    for document in documents:
        assert (document["state"], document["is_stopped"], document["error"]) == ("stopped", True, None)


def test_release_while_another_program_commands_is_refused_with_its_name(a_driver: None):
    with connect() as session, Commander(session, "rrbot", program="teleop") as commander:
        commander.wait_for_driver(DEADLINE_S)
        assert "teleop@" in failure("stop", "rrbot", "--release")


def test_stops_that_no_driver_confirms_fail():
    message = failure("stop", "rrbot", "--timeout", "0.3")
    assert "rrbot: no driver of 'rrbot' has confirmed the stop within 0.3 s" in message
    assert "no robot has a driver" in failure("stop", "--all")
    assert "name the robots to stop, or give --all" in failure("stop", code=2)
    assert "leave out --relax" in failure("stop", "rrbot", "--release", "--relax", code=2)


@contextmanager
def keys_moving(robot: str) -> Generator[tuple[int, subprocess.Popen[str]]]:
    """`zstate move ROBOT --keys` in a terminal, and what types there."""
    keyboard, terminal = pty.openpty()
    command = [sys.executable, "-m", "zstate", "move", robot, "--keys", "--timeout", str(DEADLINE_S)]
    move = subprocess.Popen(command, stdin=terminal, stderr=subprocess.PIPE, text=True)
    try:
        yield keyboard, move
    finally:
        move.kill()
        move.communicate()
        os.close(keyboard)
        os.close(terminal)


def rates_of(joints: JointStateListener) -> Callable[[], np.ndarray]:
    """The newest velocities of two joints; zero before the first."""
    rates = np.zeros(2)

    def measured() -> np.ndarray:
        reading = joints.read(0)
        if reading is not None and reading.velocities is not None:
            rates[:] = reading.velocities
        return rates

    return measured


@pytest.mark.processes
def test_wheels_turn_while_a_key_is_held_and_stop_at_once_at_another_one(spawn: Spawn):
    start_rover(spawn)
    with (
        connect() as session,
        JointStateListener(session, "rover") as joints,
        keys_moving("rover") as (keyboard, move),
    ):
        measured = rates_of(joints)
        assert move.stderr is not None
        assert "driving left_wheel_joint and right_wheel_joint of 'rover': hold" in move.stderr.readline()
        with repeated(lambda: os.write(keyboard, b"w")):
            until(lambda: np.allclose(measured(), [4.0, 4.0], atol=0.1))
        with repeated(lambda: os.write(keyboard, b"\x1b[D")):  # the left arrow
            until(lambda: np.allclose(measured(), [-2.0, 2.0], atol=0.1))
        os.write(keyboard, b" ")
        until(lambda: np.allclose(measured(), 0.0, atol=0.01))
        os.write(keyboard, b"q")
        assert move.wait(DEADLINE_S) == 0


@pytest.mark.processes
@pytest.mark.parametrize("end", ["q", "signal"])
def test_wheels_stop_at_once_when_the_program_of_the_keys_ends(end: str):
    with (
        # By its ttl the driver would turn the wheels for longer than this test waits.
        driver("diffbot", ttl_s=4 * DEADLINE_S),
        connect() as session,
        JointStateListener(session, "diffbot") as joints,
    ):
        measured = rates_of(joints)
        with keys_moving("diffbot") as (keyboard, move):
            with repeated(lambda: os.write(keyboard, b"w")):
                until(lambda: np.allclose(measured(), [4.0, 4.0], atol=0.1))
                if end == "signal":
                    move.send_signal(signal.SIGTERM)
            os.write(keyboard, b"q")
            move.wait(DEADLINE_S)
        until(lambda: np.allclose(measured(), 0.0, atol=0.01))


@pytest.mark.processes
def test_keys_need_a_terminal_and_joints_that_are_wheels(a_driver: None):
    assert "reads the keys of a terminal, and standard input is none" in failure("move", "rrbot", "--keys")
    assert "--keys goes with --wheels" in failure("move", "rrbot", "--keys", "elbow=1", code=2)
    with keys_moving("rrbot") as (_, move):
        assert move.wait(DEADLINE_S) == 1
        assert move.stderr is not None
        assert "Name them with --wheels LEFT,RIGHT; it has shoulder, elbow" in move.stderr.read()
