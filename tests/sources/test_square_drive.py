"""SquareDrive: poses, twists and wheel angles belong to one motion without slip."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from zstate.errors import InvalidInput
from zstate.sources.square_drive import OdometrySource, SquareDrive, WheelPair, WheelSource

WHEELS = WheelPair(radius_m=0.08, track_m=0.32)
SIDE, CORNER, PERIOD_NS = 1.5, 0.4, 16_000_000_000
LAP = 4.0 * (SIDE - 2.0 * CORNER) + 2.0 * math.pi * CORNER
STRAIGHT_NS = round(PERIOD_NS * (SIDE - 2.0 * CORNER) / LAP)
START = 1_789_000_000_000_000_000 // PERIOD_NS * PERIOD_NS
"""The start of a lap."""
QUARTERS = [START + quarter * PERIOD_NS // 4 for quarter in range(4)]
CORNERS = [start + STRAIGHT_NS for start in QUARTERS]
STEP_NS = 100_000
# Three laps, at no regular place of them; not across the ends of the arcs, where the yaw rate jumps.
STAMPS = [
    stamp
    for stamp in range(START, START + 3 * PERIOD_NS, 37_123_457)
    if all(abs((stamp - jump) % (PERIOD_NS // 4)) > 2 * STEP_NS for jump in (QUARTERS[0], CORNERS[0]))
]


def drive(wheels: WheelPair = WHEELS) -> SquareDrive:
    return SquareDrive(wheels, side_m=SIDE, corner_m=CORNER, period_s=PERIOD_NS * 1e-9)


def rotation(angle: float) -> np.ndarray:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def turned(angle: float) -> float:
    """An angle or a difference of two, from -pi to pi."""
    return math.remainder(angle, math.tau)


def difference(angles: tuple[float, float], before: tuple[float, float]) -> list[float]:
    return [turned(after - earlier) for after, earlier in zip(angles, before, strict=True)]


def test_a_lap_passes_the_ends_of_the_sides_and_of_the_arcs():
    straight = SIDE - 2.0 * CORNER
    expected = {
        QUARTERS[0]: (0.0, 0.0, 0.0),
        CORNERS[0]: (straight, 0.0, 0.0),
        QUARTERS[1]: (straight + CORNER, CORNER, math.pi / 2),
        CORNERS[1]: (straight + CORNER, CORNER + straight, math.pi / 2),
        QUARTERS[2]: (straight, SIDE, math.pi),
        CORNERS[2]: (0.0, SIDE, math.pi),
        QUARTERS[3]: (-CORNER, CORNER + straight, 1.5 * math.pi),
        CORNERS[3]: (-CORNER, CORNER, 1.5 * math.pi),
    }
    for stamp, pose in expected.items():
        assert drive().state(stamp)[:3] == pytest.approx(pose, abs=1e-9)
    assert drive().state(START + PERIOD_NS) == drive().state(START)


def test_the_pose_moves_as_the_twist_says():
    for stamp in STAMPS:
        before, state, after = (drive().state(stamp + step) for step in (-STEP_NS, 0, STEP_NS))
        moved = np.subtract(after[:2], before[:2]) / (2e-9 * STEP_NS)
        assert rotation(-state.yaw) @ moved == pytest.approx([state.speed, 0.0], abs=1e-7)
        assert turned(after.yaw - before.yaw) / (2e-9 * STEP_NS) == pytest.approx(state.yaw_rate, abs=1e-7)
        assert state.speed == pytest.approx(LAP / (PERIOD_NS * 1e-9))


@pytest.mark.long
def test_wheels_turn_as_far_as_the_ground_below_them_passes():
    """From the poses alone: each wheel's contact point, its way, and the rotation in that time."""
    step = PERIOD_NS // 1600
    for start in range(START, START + 2 * PERIOD_NS, step):
        ways = np.zeros(2)
        fine = [drive().state(start + k * step // 20) for k in range(21)]
        for before, after in pairwise(fine):
            for wheel, side in enumerate((0.5, -0.5)):
                contacts = [
                    np.array(one[:2]) + rotation(one.yaw) @ [0.0, side * WHEELS.track_m]
                    for one in (before, after)
                ]
                ways[wheel] += np.linalg.norm(contacts[1] - contacts[0])
        rolled = difference(drive().wheel_angles(start + step), drive().wheel_angles(start))
        assert rolled == pytest.approx(ways / WHEELS.radius_m, abs=1e-6)


def test_wheel_angles_move_as_the_wheel_rates_say():
    for stamp in STAMPS:
        before, after = (drive().wheel_angles(stamp + step) for step in (-STEP_NS, STEP_NS))
        rates = np.array(difference(after, before)) / (2e-9 * STEP_NS)
        assert rates == pytest.approx(drive().wheel_rates(stamp), abs=1e-7)


@pytest.mark.parametrize("wheels", [WHEELS, WheelPair(0.0713, 0.297)])
def test_wheel_angles_are_continuous_from_lap_to_lap(wheels: WheelPair):
    """The laps of half a century are counted without an error: one nanosecond is one nanosecond's way."""
    for start in (0, PERIOD_NS, START, START + PERIOD_NS):
        before, after = (drive(wheels).wheel_angles(stamp) for stamp in (start - 1, start))
        way = np.array(drive(wheels).wheel_rates(start - 1)) * 1e-9
        assert difference(after, before) == pytest.approx(way, abs=1e-12)
        assert max(map(abs, after)) <= math.pi


def test_sources_read_the_motion_at_the_stamp():
    stamp = CORNERS[1] + PERIOD_NS // 16
    reading = WheelSource(drive()).read(stamp)
    assert reading.positions.tolist() == list(drive().wheel_angles(stamp))
    assert reading.velocities is not None
    assert reading.velocities.tolist() == list(drive().wheel_rates(stamp))
    (edge,) = OdometrySource(drive(), "odom", "base").read(stamp)
    state = drive().state(stamp)
    assert (edge.target, edge.source, edge.stamp) == ("odom", "base", stamp)
    assert edge.translation.tolist() == [state.x, state.y, 0.0]
    assert edge.rpy == pytest.approx((0.0, 0.0, state.yaw))


@pytest.mark.parametrize(
    "wrong", [{"corner_m": 0.0}, {"corner_m": 0.8}, {"side_m": math.inf}, {"period_s": 0.0}]
)
def test_a_path_that_is_no_square_is_refused(wrong: dict[str, float]):
    with pytest.raises(InvalidInput, match=next(iter(wrong))):
        SquareDrive(WHEELS, **wrong)
