"""Simulated plants against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.robots import RRBOT

from zstate.driving.driver import Setpoint
from zstate.driving.simulated_driver import SimulatedDriver
from zstate.errors import InvalidInput
from zstate.model.load import load_model

MS = 1_000_000
GRAVITY = 9.81

PENDULUM = """
<robot name="pendulum">
  <link name="base"/>
  <link name="bob">
    <inertial>
      <origin xyz="0 0 -0.5"/>
      <mass value="2.0"/>
      <inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="swing" type="{kind}">
    <parent link="base"/><child link="bob"/><axis xyz="0 1 0"/>
    <limit lower="-10" upper="10" effort="{effort}" velocity="10"/>
    <dynamics damping="{damping}" friction="0.0"/>
  </joint>
</robot>
"""


def pendulum(kind: str = "revolute", effort: float = 100.0, damping: float = 0.0):
    return load_model(PENDULUM.format(kind=kind, effort=effort, damping=damping))


def setpoint(*positions: float) -> Setpoint:
    return Setpoint(0, np.array(positions), np.zeros(len(positions)))


def run(driver: SimulatedDriver, seconds: float) -> np.ndarray:
    """The positions at each millisecond."""
    return np.array([driver.read(tick * MS).positions for tick in range(round(seconds * 1000) + 1)])


def test_a_mirror_is_at_its_setpoint():
    driver = SimulatedDriver(RRBOT, "mirror")
    driver.enable(True)
    driver.read(0)
    driver.write(setpoint(0.25, -0.5))
    assert driver.read(MS).positions.tolist() == [0.25, -0.5]


def test_a_lag_falls_by_e_in_its_time_constant():
    driver = SimulatedDriver(RRBOT, "lag")
    driver.enable(True)
    driver.read(0)
    driver.write(setpoint(1.0, 0.0))
    assert math.isclose(run(driver, 0.05)[-1, 0], 1.0 - math.exp(-1.0), rel_tol=1e-9)


def turning(*velocities: float) -> Setpoint:
    count = len(velocities)
    return Setpoint(0, np.full(count, np.nan), np.array(velocities), None, ("velocity",) * count)


def test_a_mirror_turns_with_its_velocities_beside_positions():
    driver = SimulatedDriver(RRBOT, "mirror")
    driver.enable(True)
    driver.read(0)
    driver.write(Setpoint(0, np.array([0.25, 9.0]), np.array([0.0, 2.0]), None, ("position", "velocity")))
    reading = driver.read(50 * MS)
    assert reading.positions.tolist() == [0.25, 0.1]
    assert reading.velocities.tolist() == [0.0, 2.0]


def test_the_velocity_of_a_lag_approaches_its_setpoint_by_e_in_its_time_constant():
    driver = SimulatedDriver(RRBOT, "lag")
    driver.enable(True)
    driver.read(0)
    driver.write(turning(2.0, 0.0))
    position = run(driver, 0.05)[-1, 0]
    reading = driver.read(50 * MS)
    assert math.isclose(reading.velocities[0], 2.0 * (1.0 - math.exp(-1.0)), rel_tol=1e-9)
    assert math.isclose(position, 2.0 * 0.05 * math.exp(-1.0), rel_tol=1e-9)  # 2 (t - tau (1 - 1/e)) at tau


def test_dynamics_keep_a_velocity_against_gravity_and_apply_efforts_as_they_are():
    driver = SimulatedDriver(pendulum(), "dynamics")
    driver.enable(True)
    driver.read(0)
    driver.write(turning(0.5))
    assert run(driver, 1.0)[-1, 0] == pytest.approx(0.5, abs=0.02)  # less what it takes to speed up
    driver = SimulatedDriver(pendulum(), "dynamics")
    driver.enable(True)
    driver.read(0)
    driver.write(Setpoint(0, np.zeros(1), np.zeros(1), np.array([0.5]), ("effort",)))
    # m l^2 a = tau - m g l sin q: from rest 0.5 Nm on 2 kg at 0.5 m accelerates by 1 rad/s^2.
    assert run(driver, 0.02)[-1, 0] == pytest.approx(0.5 * 1.0 * 0.02**2, rel=0.1)
    assert driver.read(21 * MS).efforts == pytest.approx([0.5])


def relaxed(driver: SimulatedDriver) -> SimulatedDriver:
    """``driver`` with its brakes released, without torque."""
    driver.enable(True)
    driver.stop("relax")
    return driver


@pytest.mark.parametrize("kind", ["revolute", "continuous"])
def test_a_small_swing_without_torque_has_the_period_of_a_mathematical_pendulum(kind: str):
    driver = relaxed(SimulatedDriver(pendulum(kind), "dynamics", start=np.array([0.01])))
    period = math.tau * math.sqrt(0.5 / GRAVITY)
    path = run(driver, 1.5 * period)[:, 0]
    # It is at the bottom after a quarter of a period, and then each half.
    bottoms = np.flatnonzero(np.diff(np.sign(path)))
    assert np.allclose(np.diff(bottoms) * 1e-3, period / 2, atol=2e-3)
    assert np.abs(path).max() <= 0.01 * 1.01


def test_damping_takes_the_energy_away():
    driver = relaxed(SimulatedDriver(pendulum(damping=1.0), "dynamics", start=np.array([0.5])))
    assert abs(run(driver, 10.0)[-1, 0]) < 1e-3


def test_the_controller_holds_against_gravity_within_the_effort_limit():
    needed = 2.0 * GRAVITY * 0.5 * math.sin(1.0)
    for effort, holds in ((1.1 * needed, True), (0.5 * needed, False)):
        driver = SimulatedDriver(pendulum(effort=effort, damping=1.0), "dynamics", start=np.array([1.0]))
        driver.enable(True)
        reading = run(driver, 2.0)[-1, 0]
        assert (abs(reading - 1.0) < 1e-6) == holds
        efforts = driver.read(2001 * MS).efforts
        assert efforts is not None
        assert abs(efforts[0]) <= effort * (1 + 1e-9)


def test_a_stop_holds_and_relax_lets_fall():
    driver = SimulatedDriver(pendulum(damping=1.0), "dynamics", start=np.array([1.0]))
    driver.enable(True)
    driver.stop("hold")
    assert abs(run(driver, 0.5)[-1, 0] - 1.0) < 1e-6
    driver.stop("relax")
    for tick in range(501, 6000):
        reading = driver.read(tick * MS)
    assert abs(reading.positions[0]) < 0.05


def test_brakes_hold_joints_that_are_not_enabled():
    driver = SimulatedDriver(pendulum(), "dynamics", start=np.array([1.0]))
    assert run(driver, 0.5)[-1, 0] == 1.0
    relaxed(driver)
    fallen = run(driver, 0.2)[-1, 0]
    assert fallen < 0.9
    driver.enable(False)
    assert run(driver, 0.2)[-1, 0] == fallen
    assert driver.read(201 * MS).velocities.tolist() == [0.0]


def test_a_falling_joint_stops_at_the_end_of_its_range():
    text = PENDULUM.format(kind="revolute", effort=100, damping=0).replace('lower="-10"', 'lower="0.5"')
    driver = relaxed(SimulatedDriver(load_model(text), "dynamics", start=np.array([1.0])))
    path = run(driver, 2.0)[:, 0]
    step = 1e-3 * math.sqrt(2.0 * GRAVITY / 0.5)  # from the speed of a fall by less than the length
    assert 0.5 - step <= path[-1] <= 0.5
    assert path[-1] == path[-500]


def test_a_setpoint_for_joints_without_power_is_refused():
    with pytest.raises(InvalidInput, match="call enable"):
        SimulatedDriver(RRBOT).write(setpoint(0.0, 0.0))


def test_dynamics_need_inertias():
    massless = PENDULUM.format(kind="revolute", effort=1, damping=0)
    massless = massless.replace('mass value="2.0"', 'mass value="0.0"').replace("1e-9", "0.0")
    with pytest.raises(InvalidInput, match=r"no <inertial>.*use plant='lag'"):
        SimulatedDriver(load_model(massless), "dynamics")


def test_an_unknown_plant_is_refused():
    with pytest.raises(InvalidInput, match="'mirror', 'lag' or 'dynamics', not 'real'"):
        SimulatedDriver(RRBOT, "real")
