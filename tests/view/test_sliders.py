"""Sliders as joint states and as commands of a driver: values, limits, rates, conflicts, control."""

from __future__ import annotations

import math
import os
import re
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT, SampleCollector

from zstate.driving import Commander, DriverHost, stop
from zstate.driving.driver_state import DriverStateListener
from zstate.errors import InvalidInput
from zstate.model.load import load_model
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.discovery import discover
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.odometry import ImuNoise
from zstate.odometry.simulated_rover import SimulatedRover, SimulatedWheels
from zstate.se3 import quaternion_from_rpy
from zstate.sources.square_drive import WheelPair
from zstate.transform import Transform
from zstate.view.sliders import (
    SliderCommander,
    SliderMapping,
    SliderPublisher,
    SliderSpec,
    velocity_specs,
)
from zstate.wire.messages import from_block

ARM = parse_urdf(
    """<robot name="arm"><link name="base"/><link name="upper"/><link name="left"/><link name="right"/>
    <joint name="bent" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
      <limit lower="0.5" upper="1.5" velocity="1" effort="1"/></joint>
    <joint name="finger" type="prismatic"><parent link="upper"/><child link="left"/><axis xyz="0 1 0"/>
      <limit lower="-0.04" upper="0.04" velocity="1" effort="1"/></joint>
    <joint name="other" type="prismatic"><parent link="upper"/><child link="right"/><axis xyz="0 1 0"/>
      <limit lower="-1" upper="1" velocity="1" effort="1"/>
      <mimic joint="finger" multiplier="-2" offset="0.1"/></joint></robot>""",
    "arm.urdf",
)


@pytest.fixture
def arm(sessions):
    with SliderPublisher(sessions[0], ARM, "arm1", rate_hz=200.0) as sliders:
        yield sliders


def test_sliders_start_at_zero_or_in_the_middle_of_limits_without_zero(arm):
    assert arm.positions.tolist() == [1.0, 0.0]


def test_slider_value_is_published(arm, sessions):
    tap = SampleCollector(sessions[1], "zstate/arm1/joint_states")
    arm.set("bent", 1.25)
    until(lambda: any(from_block(state.positions)[0] == 1.25 for state in tap.joint_states(1)))
    tap.close()


def test_listener_receives_link_and_mimic_joint_of_a_moved_slider(arm, sessions):
    with TransformListener(sessions[1], "arm1") as listener:
        listener.buffer.wait("base", "left", timeout_s=DEADLINE_S)
        arm.set("finger", 0.03)

        def follows() -> bool:
            left = listener.buffer.lookup("upper", "left").translation[1]
            right = listener.buffer.lookup("upper", "right").translation[1]
            return math.isclose(left, 0.03) and math.isclose(right, 0.1 - 2 * 0.03)

        until(follows)
    assert arm.mimics == {"other": pytest.approx(0.1 - 2 * 0.03)}


def test_zero_uses_the_nearest_limit_if_zero_is_outside(arm):
    arm.set("finger", 0.02)
    arm.zero()
    assert arm.positions.tolist() == [0.5, 0.0]
    arm.home()
    assert arm.positions.tolist() == [1.0, 0.0]


def test_random_positions_are_within_the_limits(arm):
    generator = np.random.default_rng(1)
    for _ in range(50):
        arm.random(generator)
        assert (arm.mapping.lower <= arm.values).all()
        assert (arm.values <= arm.mapping.upper).all()


def test_sine_moves_all_joints_until_a_slider_is_set(arm):
    arm.sine_enabled = True
    before = arm.values
    until(lambda: not np.isclose(arm.values, before).any())
    arm.set("finger", 0.01)
    assert not arm.sine_enabled
    bent = arm.values[0]
    arm.read(0)
    assert arm.values.tolist() == [bent, 0.01]


def test_value_beyond_the_limits_is_refused_with_the_limits(arm):
    with pytest.raises(InvalidInput, match=r"'bent' takes 0.5 to 1.5 rad, not 2"):
        arm.set("bent", 2.0)
    with pytest.raises(InvalidInput, match="did you mean 'finger'"):
        arm.set("fingr", 0.0)
    assert arm.positions.tolist() == [1.0, 0.0]


def test_changed_rate_is_kept(arm):
    arm.rate_hz = 50.0
    until(lambda: arm.achieved_hz is not None and 49.0 < arm.achieved_hz < 51.0)
    with pytest.raises(InvalidInput, match="a rate is above 0"):
        arm.rate_hz = 0.0
    assert arm.rate_hz == 50.0


def test_nothing_is_published_while_another_program_writes_the_joints(sessions):
    with StatePublisher(sessions[1], RRBOT, "r1", program="driver") as driver:
        driver.publish([0.0, 0.0])
        until(lambda: discover(sessions[0], 0.2))
        with SliderPublisher(sessions[0], RRBOT, "r1") as sliders:
            until(lambda: sliders.conflict)
            assert sliders.achieved_hz is None
            assert f"pid {os.getpid()}" in sliders.conflict
            assert "driver@" in sliders.conflict
            assert "joint_states of 'r1'" in sliders.conflict
            assert not sliders.open()
            driver.close()
            until(sliders.open)
            assert sliders.conflict == ""
            until(lambda: sliders.achieved_hz)


def test_only_joint_states_are_published_if_another_program_publishes_the_model(sessions):
    streams = ("robot_description", "tf_static", "tf")
    with StatePublisher(sessions[1], RRBOT, "r1", streams=streams, program="model"):
        until(lambda: discover(sessions[0], 0.2))
        with SliderPublisher(sessions[0], RRBOT, "r1") as sliders:
            assert sliders.conflict == ""
            (robot,) = discover(sessions[1])
            writers = {(stream, writer.program) for stream, writer in robot.writers}
            mine = {stream for stream, program in writers if program != "model"}
            assert mine == {"joint_states"}


def test_closed_sliders_disappear_from_discovery_and_do_not_reopen(sessions):
    sliders = SliderPublisher(sessions[0], RRBOT, "r1")
    sliders.close()
    sliders.close()
    until(lambda: not discover(sessions[1], 0.2))
    assert not sliders.open()


CART = """<robot name="cart">
  <link name="world"/><link name="body"/><link name="deck"/><link name="arm"/><link name="lift"/>
  <link name="wheel"/><link name="claw"/>
  <joint name="float" type="floating"><parent link="world"/><child link="body"/></joint>
  <joint name="drive" type="planar"><parent link="body"/><child link="deck"/><axis xyz="0 0 1"/></joint>
  <joint name="swing" type="revolute"><parent link="deck"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-0.5" upper="1.5" velocity="1" effort="1"/></joint>
  <joint name="rise" type="prismatic"><parent link="arm"/><child link="lift"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.25" velocity="1" effort="1"/></joint>
  <joint name="roll" type="continuous"><parent link="lift"/><child link="wheel"/><axis xyz="1 0 0"/></joint>
  <joint name="grip" type="prismatic"><parent link="lift"/><child link="claw"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.25" velocity="1" effort="1"/><mimic joint="rise" multiplier="2"/></joint>
</robot>"""


@pytest.fixture
def cart() -> RobotModel:
    return parse_urdf(CART, "cart.urdf")


def test_every_driven_joint_has_sliders_within_its_limits(cart):
    names = [spec.name for spec in SliderMapping(cart).specs]
    floating = [f"float.{part}" for part in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert names == [*floating, "drive.x", "drive.y", "drive.yaw", "swing", "rise", "roll"]
    by_name = {spec.name: spec for spec in SliderMapping(cart).specs}
    assert by_name["swing"] == SliderSpec("swing", "rad", -0.5, 1.5)
    assert by_name["rise"] == SliderSpec("rise", "m", 0.0, 0.25)


def test_coordinates_without_limits_reach_half_a_turn_or_two_metres(cart):
    by_name = {spec.name: spec for spec in SliderMapping(cart).specs}
    assert by_name["roll"] == SliderSpec("roll", "rad", -math.pi, math.pi)
    assert by_name["drive.yaw"] == SliderSpec("drive.yaw", "rad", -math.pi, math.pi)
    assert by_name["drive.x"] == SliderSpec("drive.x", "m", -2.0, 2.0)


def test_positions_follow_the_order_of_the_model(cart):
    values = np.array([1.0, 2.0, 0.5, 0.1, -0.2, 0.3, -1.0, 0.25, 0.75, 1.25, 0.125, -3.0])
    x, y, z, w = quaternion_from_rpy(0.1, -0.2, 0.3)
    expected = [1.0, 2.0, 0.5, x, y, z, w, -1.0, 0.25, 0.75, 1.25, 0.125, -3.0]
    np.testing.assert_allclose(SliderMapping(cart).positions(values), expected, atol=1e-15)


def test_values_invert_positions(cart):
    mapping, generator = SliderMapping(cart), np.random.default_rng(3)
    for _ in range(20):
        values = generator.uniform(mapping.lower, mapping.upper)
        np.testing.assert_allclose(mapping.values(mapping.positions(values)), values, atol=1e-9)


def test_robot_without_joints_has_no_sliders():
    fixed = parse_urdf('<robot name="rock"><link name="rock"/></robot>', "rock.urdf")
    mapping = SliderMapping(fixed)
    assert mapping.specs == ()
    assert mapping.positions(np.empty(0)).shape == (0,)


@pytest.mark.robots
def test_panda_has_one_slider_for_each_joint():
    panda = load_model("panda")
    assert tuple(spec.name for spec in SliderMapping(panda).specs) == panda.joint_names


BROWSER, OTHER_BROWSER = 1, 2


@pytest.fixture
def browsers() -> set[int]:
    """The browsers that answer."""
    return {BROWSER, OTHER_BROWSER}


@pytest.fixture
def commander(sessions, host_driver, browsers) -> Iterator[SliderCommander]:
    """The sliders of a driver, which has published its state."""
    with (
        DriverStateListener(sessions[1], "arm") as states,
        SliderCommander(sessions[1], "arm", states, browsers.__contains__) as sliders,
    ):
        yield sliders


def in_control(sliders: SliderCommander) -> SliderCommander:
    until(lambda: sliders.take_control(BROWSER))  # the driver's state may not have arrived yet
    return sliders


def test_a_driver_is_commanded_from_the_first_move_of_a_slider_until_control_is_released(
    sessions, host_driver, commander
):
    host: DriverHost = host_driver()
    commander.set(BROWSER, "elbow", 0.5)
    in_control(commander)
    assert commander.targets == {}
    with TransformListener(sessions[1], "arm") as listener:
        listener.buffer.wait("base", "lower", timeout_s=DEADLINE_S)
        commander.set(BROWSER, "elbow", 0.25)
        until(lambda: listener.buffer.joint_positions("arm")[0].tolist() == [0.0, 0.25])
    assert host.state == "active"
    commander.release_control()
    until(lambda: host.state == "holding")
    assert not commander.has_control
    assert commander.problem == ""


def test_wheels_are_commanded_by_velocities_within_the_limits_of_the_model(sessions, browsers):
    model = load_model("diffbot")
    left, right = velocity_specs(model)
    assert left == SliderSpec("left_wheel_joint", "rad/s", -20.0, 20.0)  # of its URDF
    mount = Transform("base_footprint", "imu_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    noise = ImuNoise(gyro=1e-3, accel=1e-2, gyro_bias=0.0, accel_bias=0.0)
    rover = SimulatedRover(WheelPair(0.08, 0.32), mount, noise)
    with (
        DriverHost(sessions[0], SimulatedWheels(rover, model.joint_names), model, "cart") as host,
        DriverStateListener(sessions[1], "cart") as states,
        SliderCommander(sessions[1], "cart", states, browsers.__contains__) as sliders,
    ):
        thread = threading.Thread(target=host.run)
        thread.start()
        in_control(sliders)
        sliders.set(BROWSER, left.name, 2.0)
        sliders.set(BROWSER, right.name, -2.0)
        until(lambda: rover.pose.yaw < -0.5)
        assert sliders.problem == ""
        host.close()
        thread.join()


def test_a_stop_ends_control_and_after_its_release_nothing_moves_before_a_slider(
    sessions, host_driver, commander
):
    host: DriverHost = host_driver()
    in_control(commander).set(BROWSER, "elbow", 3.0)
    until(lambda: host.state == "active")
    stop(sessions[0], "arm", "door open", timeout_s=DEADLINE_S)
    until(lambda: not commander.has_control)
    assert re.match("control has ended: stopped by .*: door open", commander.problem)
    in_control(commander).set(BROWSER, "elbow", 3.0)  # ignored while the driver is stopped
    commander.release_stops(BROWSER)
    until(lambda: host.state == "ready")
    assert commander.has_control
    assert commander.targets == {}
    commander.stop()
    until(lambda: host.state == "stopped")
    assert not commander.has_control


def test_control_is_refused_while_another_program_commands_the_robot(sessions, host_driver, commander):
    host_driver()
    with Commander(sessions[0], "arm", program="teleop") as teleop:
        teleop.wait_for_driver(DEADLINE_S)
        assert not commander.take_control(BROWSER)
        assert "teleop@" in commander.problem
        assert not commander.has_control


def test_control_ends_when_the_driver_ends(host_driver, commander):
    host: DriverHost = host_driver()
    in_control(commander)
    host.close()
    until(lambda: not commander.has_control)
    assert commander.problem == "control has ended: off: the loop has ended"


def test_only_the_browser_that_has_taken_control_commands_and_releases_a_stop(
    sessions, host_driver, commander
):
    host: DriverHost = host_driver()
    in_control(commander)
    assert not commander.take_control(OTHER_BROWSER)
    commander.set(OTHER_BROWSER, "elbow", 0.5)
    assert commander.targets == {}
    commander.stop()
    in_control(commander)
    until(lambda: host.state == "stopped")
    commander.release_stops(OTHER_BROWSER)
    assert host.state == "stopped"


def test_control_ends_when_its_browser_does_not_answer(host_driver, commander, browsers):
    host: DriverHost = host_driver()
    in_control(commander).set(BROWSER, "elbow", 3.0)
    until(lambda: host.state == "active")
    browsers.remove(BROWSER)
    until(lambda: host.state == "holding")
    assert not commander.has_control
    assert "has left the page or does not answer" in commander.problem


def test_control_ends_when_its_thread_fails(sessions, host_driver):
    host_driver()

    def fails(client: int) -> bool:
        raise RuntimeError(f"no browser {client}")

    with (
        DriverStateListener(sessions[1], "arm") as states,
        SliderCommander(sessions[1], "arm", states, fails) as sliders,
    ):
        until(lambda: sliders.take_control(BROWSER) or sliders.problem)
        until(lambda: not sliders.has_control)
        assert sliders.problem == "control has ended: RuntimeError: no browser 1"
