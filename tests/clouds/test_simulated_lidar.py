"""SimulatedLidar: a room of flat walls, of which a cloud is flat only if each point has its own pose."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.buffer.buffer import TransformBuffer
from zstate.clouds import SimulatedLidar
from zstate.clouds.simulated_lidar import MountedLidar
from zstate.errors import InvalidInput
from zstate.transform import Transform

MS = 1_000_000
SIZE = (12.0, 8.0, 3.0)
TURNING = 2.0  # [rad/s]


def pose_at(stamp: int) -> Transform:
    """A lidar that turns at 2 rad/s, half a metre from the axis."""
    angle = TURNING * stamp * 1e-9
    rotation = (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))
    return Transform("map", "lidar", (0.5 * math.cos(angle), 0.5 * math.sin(angle), 1.2), rotation, stamp)


def distances(points: np.ndarray) -> np.ndarray:
    """How far each point is from the nearest wall, ceiling or floor [m]."""
    x, y, z = points.astype(float).T
    length, width, height = SIZE
    walls = [abs(abs(x) - length / 2), abs(abs(y) - width / 2), abs(z), abs(z - height)]
    return np.min(walls, axis=0)


def test_walls_are_flat_to_1_mm_at_2_rad_per_s_where_one_pose_is_off_by_decimetres():
    buffer = TransformBuffer()
    for stamp in range(0, 600 * MS, 10 * MS):
        buffer.insert(pose_at(stamp))
    lidar = SimulatedLidar(size=SIZE)
    # The truth is that of the motion, not that of the buffer.
    truth = [pose_at(int(stamp)).pose7 for stamp in lidar.stamps(303 * MS)]
    cloud = lidar.cloud(303 * MS, truth)
    assert len(cloud) == 130_048
    placed, valid = buffer.place(cloud.xyz, cloud.stamps, "lidar", "map")
    assert valid.all()
    assert distances(placed).max() < 1e-3
    rigid, _ = buffer.place(cloud.xyz, cloud.stamp, "lidar", "map")
    assert distances(rigid).max() > 0.3


def still(lidar: SimulatedLidar, position: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    return np.tile([*position, 0.0, 0.0, 0.0, 1.0], (len(lidar.stamps(0)), 1))


def test_columns_follow_each_other_through_a_turn_with_their_rings():
    lidar = SimulatedLidar(rings=3, columns=4, turn_ns=400, size=(2.0, 4.0, 3.0))
    cloud = lidar.cloud(1000, still(lidar))
    assert cloud.stamps is not None
    assert cloud.stamps.tolist() == [1000] * 3 + [1100] * 3 + [1200] * 3 + [1300] * 3
    assert cloud.ring is not None
    assert cloud.ring.tolist() == [0, 1, 2] * 4
    # The level laser looks along x, y, -x and -y.
    assert np.allclose(cloud.xyz[1::3], [[1, 0, 0], [0, 2, 0], [-1, 0, 0], [0, -2, 0]], atol=1e-6)


def test_intensity_falls_with_the_angle_to_the_wall():
    lidar = SimulatedLidar(rings=3, columns=4, turn_ns=400, size=SIZE)
    intensity = lidar.cloud(0, still(lidar, (0.0, 0.0, 1.5))).intensity
    assert intensity is not None
    # To the front, across 6 m of a room 3 m high: a laser at 22.5 degrees meets the floor.
    assert intensity[:3].tolist() == [
        round(255 * math.sin(math.pi / 8)),
        255,
        round(255 * math.sin(math.pi / 8)),
    ]


def test_noise_is_that_of_the_ranges_and_repeated_with_the_seed():
    exact = SimulatedLidar(seed=1)
    first, second = (SimulatedLidar(noise_m=0.02, seed=1) for _ in range(2))
    clouds = [one.cloud(0, still(one)).xyz for one in (exact, first, second)]
    noise = np.linalg.norm(clouds[1], axis=1) - np.linalg.norm(clouds[0], axis=1)
    assert noise.std() == pytest.approx(0.02, rel=0.02)  # of 130,000 draws
    assert np.array_equal(clouds[1], clouds[2])


def test_outside_of_the_room_nothing_is_measured():
    lidar = SimulatedLidar(rings=2, columns=4)
    cloud = lidar.cloud(0, still(lidar, (0.0, 0.0, 5.0)))
    assert not cloud.valid.any()


def test_a_mounted_lidar_measures_from_its_poses_and_ends_at_the_newest():
    buffer = TransformBuffer()
    for stamp in range(0, 400 * MS, 10 * MS):
        buffer.insert(pose_at(stamp))
    source = MountedLidar(SimulatedLidar(columns=100), buffer, "lidar", "map")
    cloud = source.read(10**9)
    assert cloud is not None
    assert cloud.end_stamp == 390 * MS
    placed, valid = buffer.place(cloud.xyz, cloud.stamps, "lidar", "map")
    assert valid.all()
    assert distances(placed).max() < 1e-5  # the truth is that of the buffer
    assert source.read(10**9) is None  # no newer pose


@pytest.mark.parametrize(
    "options", [{"rings": 0}, {"columns": 0}, {"size": (1.0, 0.0, 1.0)}, {"noise_m": -1.0}]
)
def test_impossible_lidars_are_refused(options: dict):
    with pytest.raises(InvalidInput):
        SimulatedLidar(**options)


def test_poses_of_another_number_of_columns_are_refused():
    with pytest.raises(InvalidInput, match=r"\(1016, 7\)"):
        SimulatedLidar().cloud(0, np.zeros((5, 7)))
