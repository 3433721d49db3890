"""Another implementation of ROS 2 over Zenoh commands a driver as it commands ros2_control."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.processes import until
from helpers.robots import RRBOT, SECOND
from peers import DOMAIN, Peer, repeat_until
from ros_messages import NUMBERS, TRAJECTORY, numbers, trajectory

from zstate.driving import DriverHost, Limits, Setpoint, SimulatedDriver
from zstate.net.session import Session

sdk = pytest.mark.parametrize("peer", ["sdk"], indirect=True)
pytestmark = [pytest.mark.processes, pytest.mark.sdk]

CONTROLLER = "/forward_position_controller"
TTL_S = 30.0
"""zenoh-ros2-sdk signs with numbers of its own, so its motions are valid for one ttl only."""


class Arm(SimulatedDriver):
    """A driver of both joints, at ``positions``."""

    def __init__(self) -> None:
        super().__init__(RRBOT, "mirror")
        self.positions = np.zeros(2)

    def write(self, setpoint: Setpoint) -> None:
        super().write(setpoint)
        self.positions = setpoint.positions


@pytest.fixture
def arm(session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Arm]:
    """An arm whose host is a controller of ROS 2."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    driver = Arm()
    options = {"wires": (f"ros2:domain={DOMAIN}",), "ros2_controller": CONTROLLER[1:], "ttl_s": TTL_S}
    with DriverHost(session, driver, RRBOT, "r1", limits=Limits.of(RRBOT, velocity=2.0), **options) as host:
        loop = threading.Thread(target=host.run)
        loop.start()
        yield driver
        host.close()
        loop.join()


@sdk
def test_commands_of_a_peer_move_the_joints(peer: Peer, arm: Arm):
    peer.advertise(f"{CONTROLLER}/commands", NUMBERS)
    goal = [0.25, -0.5]
    repeat_until(
        lambda: peer.publish(f"{CONTROLLER}/commands", numbers(goal)),
        lambda: arm.positions.tolist() == goal,
    )


@sdk
def test_a_trajectory_of_a_peer_moves_the_joints_through_its_points(peer: Peer, arm: Arm):
    peer.advertise(f"{CONTROLLER}/joint_trajectory", TRAJECTORY)
    names = RRBOT.joint_names[::-1]  # by name, in any order
    motion = trajectory(names, [[-0.05, 0.0], [0.1, 0.2]], [SECOND, 2 * SECOND])
    repeat_until(
        lambda: peer.publish(f"{CONTROLLER}/joint_trajectory", motion), lambda: bool(arm.positions.any())
    )
    lowest = 0.0

    def has_arrived() -> bool:
        nonlocal lowest
        shoulder, elbow = arm.positions
        lowest = min(lowest, elbow)
        return abs(shoulder - 0.2) + abs(elbow - 0.1) < 1e-3

    until(has_arrived)
    assert lowest < -0.04
