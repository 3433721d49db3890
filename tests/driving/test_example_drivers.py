"""The drivers in models/drivers: with devices simulated on ptys by their real bytes, or fakes of an API."""

from __future__ import annotations

import importlib
import math
import os
import re
import select
import signal
import struct
import subprocess
import sys
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from textwrap import dedent
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from helpers.network_namespaces import NamespaceHosts
from helpers.processes import DEADLINE_S, until
from helpers.simulated_motors import SimulatedMotors

from models.drivers.can_motors import CanMotors
from models.drivers.lerobot_robot import LeRobotRobot
from models.drivers.serial_servos import SerialServos
from zstate import TransformListener, load_model
from zstate.driving import Calibration, Commander, DriverHost, Setpoint
from zstate.driving.driver import Driver
from zstate.driving.errors import DriverFault
from zstate.errors import InvalidInput, NoData
from zstate.net.session import Session

ROOT = Path(__file__).parents[2]
DRIVERS = ROOT / "models" / "drivers"
SERVOS = Calibration(4096, zero=2048)
COUNT = math.tau / 4096
SHOULDER, ELBOW = 0.5, -0.4
"""Where a commander moves an arm of two joints."""


def arm(*joints: str) -> str:
    """The URDF of revolute ``joints`` in a row, with limits of -2 and 1 rad, and 4 rad/s."""
    links = "".join(f'<link name="{name}_link"/>' for name in ("base", *joints))
    parts = "".join(
        f'<joint name="{name}" type="revolute"><axis xyz="0 1 0"/><parent link="{parent}_link"/>'
        f'<child link="{name}_link"/><limit lower="-2" upper="1" effort="9" velocity="4"/></joint>'
        for parent, name in zip(("base", *joints), joints, strict=False)
    )
    return f'<robot name="arm">{links}{parts}</robot>'


ARM = load_model(arm("shoulder", "elbow"))


def setpoint(*positions: float) -> Setpoint:
    return Setpoint(0, np.array(positions), np.zeros(len(positions)))


@contextmanager
def opened(driver: Driver) -> Iterator[None]:
    driver.open()
    try:
        yield
    finally:
        driver.close()


@contextmanager
def running(session: Session, driver: Driver) -> Iterator[list[BaseException]]:
    """Hosts ``driver`` in a thread, with patience for a busy machine; yields what its ``run`` raises."""
    failures: list[BaseException] = []
    options = {"faults_allowed": 100, "ttl_s": 5.0, "following_error": 2.0}
    with DriverHost(session, driver, ARM, **options) as host:

        def run() -> None:
            try:
                host.run()
            except BaseException as error:
                failures.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield failures
        finally:
            host.close()
            thread.join()


def check_that_a_commander_moves(sessions: tuple[Session, Session], driver: Driver) -> None:
    """The published joints come within 2 mrad of what a commander sends."""
    with (
        running(sessions[0], driver) as failures,
        Commander(sessions[1], "arm") as commander,
        TransformListener(sessions[1], "arm") as listener,
    ):
        commander.wait_for_driver(DEADLINE_S)

        def is_there() -> bool:
            commander.send({"shoulder": SHOULDER, "elbow": ELBOW})
            with suppress(InvalidInput, NoData):  # until its model and its first sample have come
                positions, _ = listener.buffer.joint_positions("arm")
                return bool(np.abs(positions - (SHOULDER, ELBOW)).max() < 2e-3)
            return False

        until(is_there)
    assert failures == []


def test_each_driver_has_at_most_forty_lines_that_are_not_blank():
    sizes = {
        path.name: sum(bool(line.strip()) for line in path.read_text().splitlines())
        for path in DRIVERS.glob("*.py")
        if not path.name.startswith("simulated")
    }
    assert len(sizes) == 5
    assert {name: size for name, size in sizes.items() if size > 40} == {}


# Servos on a serial bus


class ServoProcess:
    """models/drivers/simulated_servos.py, run as a user does."""

    def __init__(self, path: Path, *options: str) -> None:
        self.path = path
        self._process = subprocess.Popen(
            [sys.executable, str(DRIVERS / "simulated_servos.py"), str(path), *options],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert "unplugs them" in self.line()

    def line(self) -> str:
        assert self._process.stdout
        return self._process.stdout.readline()

    def toggle_cable(self) -> str:
        self._process.send_signal(signal.SIGUSR1)
        return self.line().strip()

    def end(self) -> str:
        """Ends it, and returns the rest of its output."""
        self._process.terminate()
        return self._process.communicate(timeout=DEADLINE_S)[0]


@pytest.fixture
def simulate(tmp_path: Path) -> Iterator[Callable[..., ServoProcess]]:
    """``simulate(*options)`` starts simulated servos, which end with the test."""
    with ExitStack() as ends:

        def start(*options: str) -> ServoProcess:
            servos = ServoProcess(tmp_path / "servos", *options)
            ends.callback(servos.end)
            return servos

        yield start


def servo_driver(servos: ServoProcess) -> SerialServos:
    # A second for a reply: the servos are a process on a busy machine.
    return SerialServos(str(servos.path), ("shoulder", "elbow"), [1, 2], latency_ms=500)


def rests(driver: Driver, *positions: float) -> bool:
    """Whether 20 readings are within two counts of ``positions``; a servo moves half its way in 14 ms."""
    readings = [driver.read(0).positions for _ in range(20)]
    return bool(np.abs(np.array(readings) - positions).max() <= 2 * COUNT)


def test_serial_servos_go_where_a_commander_sends_them(sessions, simulate):
    check_that_a_commander_moves(sessions, servo_driver(simulate()))


def test_serial_servos_without_torque_rest_and_do_not_jump_to_an_old_goal(simulate):
    driver = servo_driver(simulate())
    with opened(driver):
        driver.write(setpoint(1.0, 1.0))
        assert rests(driver, 0.0, 0.0)
        driver.enable(True)
        assert rests(driver, 0.0, 0.0)
        driver.stop("relax")
        driver.write(setpoint(1.0, 1.0))
        assert rests(driver, 0.0, 0.0)


def test_serial_servos_hold_where_they_are_when_stopped(simulate):
    driver = servo_driver(simulate())
    with opened(driver):
        driver.enable(True)
        driver.write(setpoint(1000.0, 0.0))  # 160 turns
        until(lambda: driver.read(0).positions[0] > 10.0)
        driver.stop("hold")
        # From its position at the stop a servo goes to its goal, which is that of the reading before.
        until(lambda: rests(driver, *driver.read(0).positions))
        assert driver.read(0).positions[0] < 1000.0


def test_counts_that_look_like_the_header_of_a_packet_arrive(simulate):
    driver = servo_driver(simulate())
    counts = struct.unpack("<ii", b"\xff\xff\xfd\xff" + b"\xff\xff\xfd\x00")
    with opened(driver):
        driver.enable(True)
        driver.write(Setpoint(0, SERVOS.to_positions(counts), np.zeros(2)))
        until(lambda: SERVOS.to_counts(driver.read(0).positions).tolist() == list(counts))


def test_an_unplugged_cable_is_a_fault_and_the_servos_are_found_when_it_is_plugged_in(sessions, simulate):
    servos = simulate()
    with running(sessions[0], servo_driver(servos)) as failures:
        assert servos.toggle_cable() == "unplugged"
        until(lambda: failures)
    assert isinstance(failures[0], DriverFault)
    with pytest.raises(OSError, match="servos"), opened(servo_driver(servos)):
        pass
    assert servos.toggle_cable() == "plugged in"
    with opened(driver := servo_driver(servos)):
        assert rests(driver, 0.0, 0.0)


def test_corrupted_bytes_of_six_servos_are_counted_and_the_loop_goes_on(sessions, simulate):
    servos = simulate("--servos", "6", "--noise", "0.01")
    joints = tuple(f"joint{number}" for number in range(1, 7))
    driver = SerialServos(str(servos.path), joints, range(1, 7), latency_ms=2)
    options = {"rate_hz": 200.0, "faults_allowed": 400}
    with DriverHost(sessions[0], driver, load_model(arm(*joints)), **options) as host:
        report = host.run(seconds=1.0)
    counted = re.search(r"(\d+) sync reads, (\d+) of them corrupted", servos.end())
    assert counted
    # A busy machine adds replies that are late; the last one may be lost with the port.
    assert 0 < int(counted[2]) <= report.faults + 1
    assert report.faults <= report.rate.ticks


# Motors on a CAN bus


@contextmanager
def can_adapters() -> Iterator[tuple[str, str]]:
    """Two ptys: what is written to one is read from the other, as frames are between two CANable adapters."""
    pairs = [os.openpty(), os.openpty()]
    for _, terminal in pairs:
        tty.setraw(terminal)
    (first, _), (second, _) = pairs
    ended = threading.Event()

    def relay() -> None:
        while not ended.is_set():
            ready, _, _ = select.select([first, second], [], [], 0.05)
            for end in ready:
                os.write(second if end == first else first, os.read(end, 4096))

    thread = threading.Thread(target=relay)
    thread.start()
    try:
        yield os.ttyname(pairs[0][1]), os.ttyname(pairs[1][1])
    finally:
        ended.set()
        thread.join()
        for end in sum(pairs, ()):
            os.close(end)


MOTORS = {"shoulder": (3, 10.0), "elbow": (4, -5.0)}


@pytest.fixture
def slcan() -> Iterator[tuple[SimulatedMotors, dict[str, Any]]]:
    """Motors, and the options of a bus that reaches them from another slcan adapter."""
    options = {"interface": "slcan", "bitrate": 1_000_000, "sleep_after_open": 0.0}
    with can_adapters() as (near, far), SimulatedMotors(channel=far, **options) as motors:
        yield motors, {"channel": near, **options}


def test_can_motors_go_where_a_commander_sends_them(sessions, slcan):
    motors, bus = slcan
    driver = CanMotors(MOTORS, DEADLINE_S, **bus)
    check_that_a_commander_moves(sessions, driver)
    # A motor turns as often as its gear has it: the second one the other way.
    assert motors.turns[3] == pytest.approx(SHOULDER / math.tau * 10.0, abs=0.01)
    assert motors.turns[4] == pytest.approx(ELBOW / math.tau * -5.0, abs=0.01)
    until(lambda: motors.states == {3: 1, 4: 1})


def test_setpoints_of_can_motors_are_frames_with_the_turns_of_each_motor():
    adapter, terminal = os.openpty()
    tty.setraw(terminal)
    driver = CanMotors(MOTORS, interface="slcan", channel=os.ttyname(terminal), sleep_after_open=0.0)
    with opened(driver):
        driver.write(setpoint(math.tau * 0.05, math.tau * -0.1))
        # Half a turn each: node 3 and 4 in bits 5 and above, command 0x0C; 0.5 is 0x3F000000, low byte first.
        half = b"0000003F" + b"00000000"
        received = b""
        while received.count(b"\r") < 3:
            received += os.read(adapter, 4096)
        assert received == b"O\rt06C8" + half + b"\rt08C8" + half + b"\r"
    os.close(terminal)
    os.close(adapter)


def test_can_motors_do_not_jump_to_an_old_input_when_they_are_enabled(slcan):
    motors, bus = slcan
    driver = CanMotors(MOTORS, DEADLINE_S, **bus)
    with opened(driver):
        driver.enable(True)
        until(lambda: motors.states == {3: 8, 4: 8})
        for _ in range(10):
            assert np.abs(driver.read(0).positions).max() == 0.0


def test_a_can_motor_that_sends_nothing_is_named(slcan):
    motors, bus = slcan
    motors.silent.add(4)
    driver = CanMotors(MOTORS, timeout_s=1.0, **bus)
    with opened(driver), pytest.raises(TimeoutError, match=r"only nodes \[3\] have sent"):
        driver.read(0)


UDP_MULTICAST = """
    import numpy as np
    from helpers.processes import until
    from helpers.simulated_motors import SimulatedMotors
    from models.drivers.can_motors import CanMotors
    from zstate.driving import Setpoint
    bus = {"interface": "udp_multicast", "channel": "239.74.163.2"}
    driver = CanMotors({"shoulder": (3, 1.0), "elbow": (4, 1.0)}, timeout_s=10.0, **bus)
    with SimulatedMotors(**bus):
        driver.open()
        driver.enable(True)
        driver.write(Setpoint(0, np.array([1.0, -1.0]), np.zeros(2)))
        until(lambda: np.abs(driver.read(0).positions - [1.0, -1.0]).max() < 1e-3)
        driver.close()
    print("there")
"""


@pytest.mark.netns
def test_can_motors_are_driven_over_udp_multicast():
    # In a namespace with a route for multicast, which a machine without a network does not have.
    with NamespaceHosts("robot") as hosts:
        done = subprocess.run(
            ["ip", "netns", "exec", hosts.namespace("robot"), sys.executable, "-c", dedent(UDP_MULTICAST)],
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), *sys.path, str(ROOT)])},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert done.stdout == "there\n", done.stderr


# LeRobot


class FakeLeRobot:
    """The calls of LeRobot's robots with a bus of motors: an arm whose motors are at their goals at once."""

    def __init__(self) -> None:
        self.numbers = {"shoulder.pos": 0.0, "elbow.pos": 0.0}
        self.bus = self
        self.is_connected = self.has_torque = False

    def connect(self, calibrate: bool = True) -> None:
        assert not calibrate, "which asks questions in the terminal"
        self.is_connected = True

    def enable_torque(self) -> None:
        self.has_torque = True

    def disable_torque(self) -> None:
        self.has_torque = False

    def get_observation(self) -> dict[str, float]:
        return dict(self.numbers)

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        assert self.has_torque
        self.numbers |= action
        return action

    def disconnect(self) -> None:
        assert self.is_connected
        self.is_connected = False


def test_a_robot_of_lerobot_goes_where_a_commander_sends_it(sessions):
    robot = FakeLeRobot()
    check_that_a_commander_moves(sessions, LeRobotRobot(robot, ARM, {"elbow": (-100, 100)}))
    near = 2e-3  # [rad]
    assert robot.numbers["shoulder.pos"] == pytest.approx(math.degrees(SHOULDER), abs=math.degrees(near))
    # The range is from -2 to 1 rad.
    assert robot.numbers["elbow.pos"] == pytest.approx(-100 + 200 * (ELBOW + 2) / 3, abs=200 * near / 3)
    assert not robot.has_torque
    assert not robot.is_connected


def test_numbers_of_lerobot_are_degrees_or_cover_the_range_of_a_joint():
    robot = FakeLeRobot()
    robot.numbers = {"shoulder.pos": 90.0, "elbow.pos": 100.0}
    assert LeRobotRobot(robot, ARM, {"elbow": (0, 100)}).read(0).positions == pytest.approx(
        [math.pi / 2, 1.0]
    )
    robot.numbers["elbow.pos"] = 0.0
    assert LeRobotRobot(robot, ARM, {"elbow": (0, 100)}).read(0).positions[1] == pytest.approx(-2.0)


# ur_rtde

UR_MODULE = "models.drivers.ur_rtde_arm"


class FakeUr:
    """The calls of ur_rtde's two interfaces: an arm that is at its target at once; a cycle for each look."""

    def __init__(self) -> None:
        self.positions = [0.0] * 6
        self.time = 0.0
        self.calls: list[str] = []
        self.is_connected = self.runs = True

    def isConnected(self) -> bool:  # noqa: N802
        return self.is_connected

    def getTimestamp(self) -> float:  # noqa: N802
        return self.time

    def getActualQ(self) -> list[float]:  # noqa: N802
        return self.positions

    def getActualQd(self) -> list[float]:  # noqa: N802
        return [0.0] * 6

    def isProgramRunning(self) -> bool:  # noqa: N802
        return self.runs

    def reuploadScript(self) -> bool:  # noqa: N802
        self.runs = True
        return True

    def servoJ(  # noqa: N802, PLR0917
        self, q: list[float], speed: float, acceleration: float, time: float, lookahead: float, gain: float
    ) -> bool:
        # The ranges are those of URScript's servoj.
        assert len(q) == 6
        assert time == 1 / 125
        assert 0.03 <= lookahead <= 0.2
        assert 100 <= gain <= 2000
        self.positions = q
        return self.runs

    def servoStop(self, a: float = 10.0) -> bool:  # noqa: N802
        self.calls.append("servoStop")
        return True

    def disconnect(self) -> None:
        self.calls.append("disconnect")


@pytest.fixture
def ur(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[FakeUr, Any]]:
    """An arm, and its driver, which finds the fake in the place of ur_rtde."""
    fake = FakeUr()
    for module, interface in {
        "rtde_control": "RTDEControlInterface",
        "rtde_receive": "RTDEReceiveInterface",
    }.items():
        stand_in = ModuleType(module)
        setattr(stand_in, interface, lambda address: fake)
        monkeypatch.setitem(sys.modules, module, stand_in)
    monkeypatch.delitem(sys.modules, UR_MODULE, raising=False)
    driver = importlib.import_module(UR_MODULE).UrRtdeArm("192.0.2.1", rate_hz=125.0)
    driver.open()
    yield fake, driver
    driver.close()


def test_an_arm_of_ur_servos_to_setpoints_and_stops(ur):
    arm, driver = ur
    driver.enable(True)
    assert driver.read(0).positions.tolist() == [0.0] * 6
    assert driver.read(0) is None, "the arm has sent nothing new"
    driver.write(setpoint(0.1, 0.2, 0.3, 0.4, 0.5, 0.6))
    arm.time += 0.002
    assert driver.read(0).positions.tolist() == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    driver.stop("hold")
    driver.close()
    assert arm.calls == ["servoStop", "disconnect", "disconnect"]


def test_an_arm_of_ur_whose_program_has_ended_refuses_setpoints_until_it_is_enabled(ur):
    arm, driver = ur
    arm.runs = False
    with pytest.raises(ConnectionError, match=r"servoJ of the arm at 192\.0\.2\.1"):
        driver.write(setpoint(*[0.0] * 6))
    driver.enable(True)
    driver.write(setpoint(*[0.0] * 6))
    arm.is_connected = False
    with pytest.raises(ConnectionError, match="isConnected"):
        driver.read(0)


# MuJoCo

MJCF = """
<mujoco>
  <option timestep="0.002" gravity="{gravity} 0 0"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="{damping}"/>
      <geom type="sphere" size="0.001" pos="0 0 -0.5" mass="1"/>
      <body name="lower" pos="0 0 -0.5">
        <joint name="elbow" axis="0 1 0" damping="{damping}"/>
        <geom type="sphere" size="0.001" pos="0 0 -0.5" mass="{mass}"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="elbow" kp="100"/>
    <position joint="shoulder" kp="100"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def mjcf(tmp_path: Path) -> Callable[..., Driver]:
    """``mjcf(...)`` is an arm of two joints with a mass at the end of each link."""
    pytest.importorskip("mujoco", reason="MuJoCo 4 needs Python 3.11")
    from models.drivers.mujoco_arm import MujocoArm

    def make(*, gravity: float = 0.0, damping: float = 10.0, mass: float = 1.0) -> Driver:
        path = tmp_path / "arm.xml"
        path.write_text(MJCF.format(gravity=gravity, damping=damping, mass=mass))
        return MujocoArm(path)

    return make


def test_an_arm_of_mujoco_goes_where_a_commander_sends_it(sessions, mjcf):
    driver = mjcf()
    assert driver.joint_names == ("elbow", "shoulder")
    check_that_a_commander_moves(sessions, driver)


def test_joints_of_mujoco_without_torque_fall_for_the_time_between_readings(mjcf):
    driver = mjcf(gravity=9.81, damping=0.0, mass=1e-6)
    with opened(driver):
        driver.write(setpoint(1.0, 1.0))
        driver.read(10**18)
        fallen = driver.read(10**18 + 49_000_000).positions[1]
    # 24 steps of 2 ms, each with a speed of g/l times its end: the mass is at 0.5 m, below the axis.
    steps = 24
    assert abs(fallen) == pytest.approx(9.81 / 0.5 * 0.002**2 * steps * (steps + 1) / 2, rel=1e-2)
