"""The simulated hardware of `zstate demo rover`."""

from __future__ import annotations

import math

from zstate import load_model
from zstate.cameras import Camera, SimulatedCamera, floor_surface
from zstate.odometry.cli.rover import ROVER_LENS, ROVER_MODEL, ROVER_WHEELS, RoverCamera
from zstate.odometry.invariant_filter import ImuNoise
from zstate.odometry.simulated_rover import SimulatedRover
from zstate.sources.square_drive import WheelPair
from zstate.transform import Transform

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def test_the_camera_still_takes_pictures_after_several_turns_of_the_rover():
    noise = ImuNoise(gyro=1e-9, accel=1e-9, gyro_bias=0.0, accel_bias=0.0)
    rover = SimulatedRover(
        WheelPair(*ROVER_WHEELS), Transform.from_rpy("base", "imu", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0)), noise
    )
    rover.advance(START)
    lens = Camera(64, 48, (60.0, 60.0, 31.5, 23.5), frame=ROVER_LENS)
    scene = SimulatedCamera(lens, {"the floor": floor_surface((-5.0, 5.0), (-5.0, 5.0))})
    camera = RoverCamera(scene, rover, load_model(ROVER_MODEL))
    rover.drive((-6.0, 6.0))
    for elapsed in range(1, 11):
        taken = camera.read(START + elapsed * SECOND)
        assert taken is not None
    assert rover.pose[2] > 2.0 * math.tau
