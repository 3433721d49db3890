"""zstate drive: drivers of this package and of a user's file, as processes."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Command, Spawn, failure, interrupted, run_cli, run_watched, started
from helpers.processes import DEADLINE_S, Child, until
from helpers.programs import driver
from helpers.raw_ros_nodes import COMMANDS, announced_publisher

from zstate import JointReading, TransformListener, connect, load_model
from zstate.driving import Commander
from zstate.sources import JointStateListener

ARM = """
import socket
import sys
import time
from pathlib import Path
from zstate.driving import SimulatedDriver

class Arm(SimulatedDriver):
    def __init__(self, model, joint_names, log: str, failures: bool = False):
        super().__init__(model, "mirror")
        self.log, self.failures = Path(log), failures
        self.log.write_text(f"{' '.join(joint_names)} ")

    def read(self, stamp):
        if self.failures:
            raise OSError("no reply from servo 3")
        return super().read(stamp)

    def close(self):
        self.log.write_text(self.log.read_text() + "closed")

class Unreachable(Arm):
    def open(self):
        socket.create_connection(("127.0.0.1", 1))

class Servos(Arm):
    def __init__(self, model, joint_names, log: Path, ids: list[int], serial: str | None = None):
        super().__init__(model, joint_names, log)
        log.write_text(f"{ids} {serial!r}")

class Paced(Arm):
    def read(self, stamp):
        time.sleep(0.01)
        return super().read(stamp)

class Leaving(Arm):
    def read(self, stamp):
        raise SystemExit(0)

    def stop(self, how):
        raise SystemExit(0)

    def enable(self, on):
        self.log.write_text(f"{self.log.read_text()}enable {on} ")
        raise SystemExit(0)

class LeavingAtOnce(Arm):
    def __init__(self, model, joint_names):
        sys.exit("no licence")

class LeavingOpen(Arm):
    def open(self):
        sys.exit()

class SlowToOpen(Arm):
    def open(self):
        self.log.write_text("opening")
        while True:
            time.sleep(0.002)

class SlowToStop(Arm):
    def stop(self, how):
        self.log.write_text(self.log.read_text() + "stopping ")
        while self.log.with_suffix(".held").exists():
            time.sleep(0.002)
        super().stop(how)
        self.log.write_text(self.log.read_text() + "stopped ")

class Nothing:
    pass
"""


CONNECTS = 1 + ARM.splitlines().index('        socket.create_connection(("127.0.0.1", 1))')
"""The line of its own code where a driver fails."""

LEAVES = 1 + ARM.splitlines().index("        raise SystemExit(0)")


@pytest.fixture
def arm(tmp_path: Path) -> str:
    """The file of a driver."""
    file = tmp_path / "arm.py"
    file.write_text(ARM)
    return str(file)


def line_with(child: Child | Command, text: str) -> str:
    while text not in (line := child.line()):
        pass
    return line


@pytest.mark.processes
def test_changes_of_state_are_lines_and_the_end_is_a_report(spawn: Spawn):
    child = started(spawn, "drive", "sim", "rrbot", "--ttl", "0.5")
    assert child.line() == (
        "driving 'rrbot' (2 joints, sim) at 100 Hz; the joints hold after 500.0 ms without a command"
    )
    assert child.line() == (
        "the joints brake from their velocity limits in 0.2 s; --acceleration sets others"
    )
    assert child.line() == "ready"
    with connect() as session, Commander(session, "rrbot", program="teleop") as commander:
        commander.wait_for_driver(DEADLINE_S)
        until(lambda: _is_moved(commander))
        assert child.line().startswith("active, commanded by teleop@")
        assert child.line().startswith("holding: nothing from teleop@")
        with TransformListener(session, "rrbot") as listener:
            assert listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
    interrupted(child)
    assert " samples; commanded 100 Hz, achieved " in child.line()
    assert child.line().startswith("late by ")
    # A busy machine has more commands wait than a tick takes.
    refused = child.line().partition(" written, 0 failures of the driver, commands refused: ")[2]
    assert re.fullmatch(r"none|\d+ overrun", refused)


@pytest.mark.processes
def test_a_second_signal_does_not_skip_the_stop_of_the_driver(spawn: Spawn, arm: str, tmp_path: Path):
    log = tmp_path / "log"
    child = started(spawn, "drive", f"{arm}:SlowToStop", "rrbot", "--param", f"log={log}", "--ttl", "20")
    line_with(child, "ready")
    with connect() as session, Commander(session, "rrbot") as commander:
        commander.wait_for_driver(DEADLINE_S)
        until(lambda: _is_moved(commander))
        log.write_text("")
        held = log.with_suffix(".held")
        held.touch()
        child.process.send_signal(signal.SIGINT)
        until(lambda: "stopping" in log.read_text())
        child.process.send_signal(signal.SIGINT)
        child.process.send_signal(signal.SIGTERM)
        held.unlink()
        assert child.process.wait(DEADLINE_S) == 130
    assert log.read_text().startswith("stopping stopped ")
    assert log.read_text().endswith("closed")


def test_a_driver_that_raises_system_exit_ends_the_command_with_the_cause(arm: str, tmp_path: Path):
    log = tmp_path / "log"
    text = failure("drive", f"{arm}:Leaving", "rrbot", "--param", f"log={log}")
    assert f"the driver of 'rrbot' raised SystemExit(0) ({arm}, line {LEAVES})" in text
    assert log.read_text().endswith("enable False closed")


@pytest.mark.parametrize(
    ("name", "given", "error"),
    [
        ("LeavingAtOnce", (), "LeavingAtOnce failed: SystemExit: no licence (ARM, line "),
        ("LeavingOpen", ("--param", "log=/dev/null"), "LeavingOpen failed: SystemExit (ARM, line "),
    ],
)
def test_a_driver_that_exits_before_the_loop_runs_ends_the_command_with_one_error(
    arm: str, name: str, given: tuple[str, ...], error: str
):
    text = failure("drive", f"{arm}:{name}", "rrbot", *given)
    assert error.replace("ARM", arm) in text
    assert len(text.splitlines()) == 1


@pytest.mark.parametrize("code", ["", "0", "3", "'no SDK'"])
def test_a_driver_whose_file_exits_ends_the_command_with_one_error(tmp_path: Path, code: str):
    file = tmp_path / "arm.py"
    file.write_text(f"import sys\nsys.exit({code})\n")
    what = f": {code.strip(chr(39))}" if code else ""
    text = failure("drive", f"{file}:Arm", "rrbot")
    assert text.strip() == f"zstate: {file} failed: SystemExit{what} ({file}, line 2)"


@pytest.mark.processes
def test_a_signal_while_a_driver_opens_ends_the_command_with_its_own_code(
    spawn: Spawn, arm: str, tmp_path: Path
):
    log = tmp_path / "log"
    child = started(spawn, "drive", f"{arm}:SlowToOpen", "rrbot", "--param", f"log={log}")
    until(lambda: log.exists() and log.read_text() == "opening")
    child.process.send_signal(signal.SIGTERM)
    assert child.wait() == 128 + signal.SIGTERM
    assert child.stderr == ""


def _is_moved(commander: Commander) -> bool:
    commander.send({"elbow": 0.1})
    return commander.driver is not None and commander.driver.state == "active"


@pytest.mark.processes
def test_driver_of_a_file_gets_its_parameters_and_is_closed_at_the_end(
    spawn: Spawn, arm: str, tmp_path: Path
):
    log = tmp_path / "log.txt"
    child = started(spawn, "drive", f"{arm}:Arm", "rrbot", "--name", "left", "--param", f"log={log}")
    line_with(child, "ready")
    assert log.read_text() == "shoulder elbow "
    child.process.send_signal(signal.SIGTERM)
    assert child.wait() == 128 + signal.SIGTERM
    assert log.read_text() == "shoulder elbow closed"


def test_parameters_have_the_types_that_the_driver_annotates(arm: str, tmp_path: Path):
    log = tmp_path / "log.txt"
    given = [f"--param={one}" for one in (f"log={log}", "ids=[1, 2]", "serial=0042")]
    assert run_cli("drive", f"{arm}:Servos", "rrbot", *given, "--seconds", "0.05").code == 0
    assert log.read_text() == "[1, 2] '0042'closed"


def test_ros_nodes_command_the_joints_as_a_controller_and_receive_them():
    def send(command: Command) -> None:
        assert command.line().startswith("driving 'rrbot' (2 joints, sim)")
        assert line_with(command, "ROS 2 nodes") == (
            "ROS 2 nodes command shoulder, elbow, in this order, on /forward_position_controller/commands "
            "and /forward_position_controller/joint_trajectory"
        )
        readings: list[JointReading] = []
        with (
            connect() as session,
            JointStateListener(
                session, "rrbot", load_model("rrbot"), wire="ros2", on_reading=readings.append
            ),
            announced_publisher(session, "teleop", COMMANDS) as node,
        ):
            node.numbers([0.0, 0.1])
            until(lambda: readings and abs(readings[-1].positions[1] - 0.1) < 1e-3)
        assert "active, commanded by /teleop" in line_with(command, "active")

    given = ("drive", "sim", "rrbot", "--wire", "native", "--wire", "ros2", "--ttl", "10")
    run_watched(send, *given, "--ros2-controller", "forward_position_controller")


def test_device_sets_the_pace_of_the_loop(arm: str, tmp_path: Path):
    given = ("drive", f"{arm}:Paced", "rrbot", "--param", f"log={tmp_path / 'log.txt'}")
    ended = run_cli(*given, "--rate", "device", "--seconds", "0.5")
    assert ended.code == 0
    assert " at the pace of the device; " in ended.stdout.splitlines()[0]
    assert re.search(r"^\d+ samples at the pace of the device, [\d.]+ Hz$", ended.stdout, re.MULTILINE)


def test_driver_that_fails_three_times_in_a_row_ends_the_command_stopped(arm: str, tmp_path: Path):
    given = ("drive", f"{arm}:Arm", "rrbot", "--param", f"log={tmp_path / 'log.txt'}")
    ended = run_cli(*given, "--param", "failures=true")
    assert ended.code == 1
    assert "'rrbot' is stopped: the driver failed in 3 ticks in a row" in ended.stderr
    assert "no reply from servo 3" in ended.stderr
    assert re.search(r"^0 setpoints written, 3 failures of the driver", ended.stdout, re.MULTILINE)
    # The stop is kept for the next host.
    again = run_cli(*given, "--seconds", "0.5")
    assert re.search(r"^stopped by zstate-drive@", again.stdout, re.MULTILINE)


@pytest.mark.parametrize(
    ("arguments", "code", "error"),
    [
        (("arm.urdf",), 2, "'arm.urdf' is neither 'sim' nor FILE.py:CLASS"),
        (("gone.py:Arm",), 2, "there is no file 'gone.py'"),
        (("ARM:Amr",), 1, "has no 'Amr'; did you mean 'Arm'?"),
        (("ARM:Arm",), 1, "missing a required argument: 'log'; it is "),
        (("ARM:Arm", "--param", "port"), 2, "'port' is not a parameter; write KEY=VALUE"),
        (("ARM:Nothing",), 1, "is no driver: it has no joint_names, modes, open, enable, read, write"),
        (("ARM:Unreachable", "--param", "log=/dev/null"), 1, f"Connection refused (ARM, line {CONNECTS})"),
        (
            ("ARM:Servos", "--param", "log=/dev/null", "--param", "ids=1,2"),
            *(1, "--param ids=1,2 does not fit ARM:Servos, which takes list[int] as 'ids'; VALUE is JSON"),
        ),
        (("sim", "--ros2-controller", "arm_controller"), 2, "--ros2-controller needs one wire `ros2`, as in"),
        (("ARM:Arm", "--plant", "lag"), 2, "--plant is of `sim`"),
        (("sim", "--velocity", "elbow=fast"), 2, "'elbow=fast' is not JOINT=VALUE with a number"),
        (("sim", "--velocity", "9"), 1, "velocity 9 of 'shoulder' is above 2.5, the limit in the URDF"),
        (("sim", "--effort", "elbow=99"), 1, "effort 99 of 'elbow' is above 30, the limit in the URDF"),
        (
            ("sim", "--wire", "native", "--wire", "ros2", "--ros2-controller", "c", "--ros2-mode", "effort"),
            *(1, "ros2_mode='effort' is none of the driver's modes, ['position', 'velocity']"),
        ),
        (("sim", "--velocity", "1", "--velocity", "elbow=2"), 2, "--velocity is one number for all joints"),
    ],
)
def test_unusable_drivers_and_options_are_refused(
    arm: str, arguments: tuple[str, ...], code: int, error: str
):
    driver, *rest = arguments
    assert error.replace("ARM", arm) in failure(
        "drive", driver.replace("ARM", arm), "rrbot", *rest, code=code
    )


def test_joint_without_a_velocity_limit_needs_one(tmp_path: Path):
    urdf = tmp_path / "wheel.urdf"
    urdf.write_text(
        "<robot name='wheel'><link name='a'/><link name='b'/><joint name='turn' type='continuous'>"
        "<parent link='a'/><child link='b'/></joint></robot>"
    )
    message = failure("drive", "sim", str(urdf), code=2)
    assert "no limit for the velocity of turn; give one, such as --velocity turn=1.0" in message


def test_second_host_of_a_robot_is_refused_with_the_name_of_the_first():
    with driver():
        message = failure("drive", "sim", "rrbot")
    assert f"@{os.uname().nodename} pid {os.getpid()}" in message


@pytest.mark.processes
def test_up_starts_a_driver_as_a_program_and_closes_it(spawn: Spawn, arm: str, tmp_path: Path):
    log = tmp_path / "log.txt"
    run = ["zstate", "drive", "arm.py:Arm", RRBOT, "--param", f"log={log}"]
    cell = tmp_path / "cell.toml"
    cell.write_text(
        f"[[program]]\nname = 'driver'\nrun = {json.dumps(run)}\n"
        "[[program]]\nname = 'note'\nrun = 'echo driven'\nafter = 'driver'\n"
    )
    child = started(spawn, "up", str(cell))
    assert "driving 'rrbot' (2 joints, arm.py:Arm)" in line_with(child, "driv")
    line_with(child, "driven")
    interrupted(child)
    assert log.read_text() == "shoulder elbow closed"
