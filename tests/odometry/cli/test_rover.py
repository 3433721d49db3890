"""The simulated hardware of `zstate demo rover`."""

from __future__ import annotations

import math

import click
import pytest

from zstate import load_model
from zstate.cameras import Camera, SimulatedCamera, floor_surface
from zstate.errors import LibraryMissing
from zstate.odometry.cli.rover import ROVER_LENS, ROVER_MODEL, ROVER_WHEELS, RoverCamera, run_rover
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


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (
            ZeroDivisionError("0 s"),
            click.ClickException,
            r"camera of the rover raised .*0 s.*line \d",
        ),
        (LibraryMissing("pip install eyes"), LibraryMissing, "^pip install eyes$"),
    ],
)
def test_a_sensor_that_fails_ends_the_process_with_the_reason(
    sessions, monkeypatch: pytest.MonkeyPatch, error, kind, text
):
    def read(camera: RoverCamera, stamp: int):
        raise error

    monkeypatch.setattr(RoverCamera, "read", read)
    with pytest.raises(kind, match=text):
        run_rover(sessions[0], 50.0, "r2", with_camera=True)
