"""Legs: feet by the model and the joints, which of them touch the ground, and walks."""

import numpy as np
import pytest
from helpers.filter_states import derivative
from helpers.imu_simulation import NOISE, SimulatedBody, mean_band

from zstate import InvalidInput
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.odometry import invariant_filter as iekf
from zstate.odometry import legs
from zstate.odometry.legs import (
    Foot,
    ForceThresholds,
    LegNoise,
    Legs,
    SpeedThresholds,
    Stance,
    stance_after,
    updated_by_feet,
)
from zstate.odometry.rotations import Floats, rotation_exp, skew

GATE = 16.27  # 99.9 % of the chi-square distribution of three degrees of freedom

# The IMU is turned by a right angle about z: its x axis is the trunk's y axis.
TRUNK = """<link name="world"/><link name="trunk"/><link name="imu"/><link name="tail"/>
<joint name="body" type="floating"><parent link="world"/><child link="trunk"/></joint>
<joint name="imu" type="fixed"><parent link="trunk"/><child link="imu"/>
  <origin xyz="0.1 0 0.05" rpy="0 0 1.5707963267948966"/></joint>
<joint name="tail" type="fixed"><parent link="trunk"/><child link="tail"/></joint>
<joint name="arm" type="continuous"><parent link="trunk"/><child link="hand"/></joint><link name="hand"/>"""


def joint(name: str, kind: str, parent: str, child: str, *, axis: str, xyz: str) -> str:
    return f"""<link name="{child}"/>
<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>
  <origin xyz="{xyz}"/><limit lower="-100" upper="100" effort="1" velocity="1"/></joint>"""


def robot(*legs: str) -> RobotModel:
    return parse_urdf(f'<robot name="walker">{TRUNK}{"".join(legs)}</robot>', "walker.urdf")


def turning_leg(name: str, y: float) -> str:
    """Hip about x, thigh and shank about y, 0.3 m each."""
    return "".join(
        (
            joint(f"{name}_hip", "revolute", "trunk", f"{name}_a", axis="1 0 0", xyz=f"0.2 {y} 0"),
            joint(f"{name}_thigh", "revolute", f"{name}_a", f"{name}_b", axis="0 1 0", xyz="0 0 0"),
            joint(f"{name}_knee", "revolute", f"{name}_b", f"{name}_c", axis="0 1 0", xyz="0 0 -0.3"),
            joint(f"{name}_ankle", "fixed", f"{name}_c", f"{name}_foot", axis="1 0 0", xyz="0 0 -0.3"),
        )
    )


def sliding_leg(name: str) -> str:
    """Three sliding joints along x, y and z of the trunk, whose foot is where they are, from its origin."""
    ends = ["trunk", f"{name}_a", f"{name}_b", f"{name}_foot"]
    axes = zip("xyz", ("1 0 0", "0 1 0", "0 0 1"), ends[:-1], ends[1:], strict=True)
    return "".join(
        joint(f"{name}_{x}", "prismatic", parent, child, axis=axis, xyz="0 0 0")
        for x, axis, parent, child in axes
    )


TURNING = robot(turning_leg("left", 0.15), turning_leg("right", -0.15))
FEET = ("left_foot", "right_foot")
BENT = {"hip": 0.1, "thigh": 0.6, "knee": -1.1}
POSITIONS = {f"{side}_{name}": angle for side in ("left", "right") for name, angle in BENT.items()}


def turning_legs(
    noise: LegNoise | None = None, detection: ForceThresholds | SpeedThresholds | None = None
) -> Legs:
    return Legs(TURNING, FEET, imu="imu", noise=noise, detection=detection)


def at_rest() -> iekf.FilterState:
    zero = np.zeros(3)
    return iekf.initial_state(
        rotation=np.eye(3),
        velocity=zero,
        position=zero,
        gyro_bias=zero,
        accel_bias=zero,
        covariance=np.eye(15) * 1e-4,
    )


def test_a_foot_is_where_its_joints_place_it_in_the_axes_of_the_imu():
    straight = dict.fromkeys(POSITIONS, 0.0)
    left, right = (foot.offset for foot in turning_legs().feet(straight))
    # In the trunk: hip (0.2, 0.15, 0), 0.6 m down, seen from (0.1, 0, 0.05). The IMU has its axes y, -x, z.
    np.testing.assert_allclose(left, [0.15, -0.1, -0.65], atol=1e-12)
    np.testing.assert_allclose(right, [-0.15, -0.1, -0.65], atol=1e-12)


def test_the_noise_of_encoders_reaches_a_foot_by_its_derivative():
    legs = turning_legs(noise=LegNoise(joint=0.01, foot=0.002))
    assert legs.joint_names == tuple(POSITIONS)  # neither the body's joint nor the arm

    def left_offset(change: Floats) -> Floats:
        moved = {name: POSITIONS[name] + by for name, by in zip(legs.joint_names, change, strict=True)}
        return legs.feet(moved)[0].offset

    by_joints = derivative(left_offset, 6)
    foot = legs.feet(POSITIONS)[0]
    np.testing.assert_allclose(foot.jacobian, by_joints, atol=1e-9)
    np.testing.assert_allclose(foot.covariance, by_joints @ by_joints.T * 1e-4 + np.eye(3) * 4e-6, atol=1e-12)


@pytest.mark.parametrize(("part", "is_same"), [(0.99, True), (1.01, False)])
def test_a_stance_ends_by_a_reading_that_is_further_from_its_mean_than_3_mm_and_four_sigmas(
    part: float, is_same: bool
):
    mean, sigma, stance = np.array([0.2, -0.1, -0.4]), 0.002, None

    def after(stance: Stance | None, step: int, x: float) -> Stance | None:
        foot = Foot("foot", mean + np.array([x, 0.0, 0.0]), np.eye(3), np.zeros((3, 1)))
        return stance_after(stance, step * 10_000_000, [foot], is_whole=True)

    for step in range(51):  # half a second, whose readings are sigma in front of the mean or behind it
        stance = after(stance, step, sigma * (-1) ** step)
    assert stance is not None
    assert stance.before == pytest.approx(mean[np.newaxis])
    moved = after(stance, 51, part * (0.003 + 4.0 * sigma))
    assert moved is not None
    assert (moved.before is not None) == is_same


def test_a_foot_touches_by_force_with_hysteresis():
    legs = turning_legs(detection=ForceThresholds(touchdown=40.0, liftoff=20.0))
    feet = legs.feet(POSITIONS)

    def touching(force: float, before: tuple[str, ...]) -> frozenset[str]:
        # Statics: the motors of the left leg hold against this force of the ground on its foot.
        torques = -feet[0].jacobian.T @ np.array([0.0, 0.6, 0.8]) * force
        efforts = dict(zip(legs.joint_names, torques.tolist(), strict=True))
        return legs.touching(feet, before, state=at_rest(), gyro=np.zeros(3), efforts=efforts)

    assert touching(41.0, ()) == {"left_foot"}
    assert touching(30.0, ()) == frozenset()
    assert touching(30.0, FEET) == {"left_foot"}
    assert touching(19.0, FEET) == frozenset()


def test_a_foot_touches_by_its_speed_in_the_world_with_hysteresis():
    legs = turning_legs(detection=SpeedThresholds(touchdown=0.1, liftoff=0.2))
    feet, gyro, velocity = legs.feet(POSITIONS), np.array([0.1, 0.2, -0.3]), np.array([0.5, 0.1, 0.0])
    state = at_rest()._replace(rotation=rotation_exp(np.array([0.2, 0.3, 0.4])), velocity=velocity)

    def touching(speed: float, before: tuple[str, ...]) -> frozenset[str]:
        # The joints of the left leg move its foot so that its speed in the world is this one.
        wanted = speed * np.array([0.0, 0.0, 1.0])
        by_body = state.rotation.T @ velocity + np.cross(gyro, feet[0].offset)
        rates = np.linalg.lstsq(feet[0].jacobian, wanted - by_body)[0]
        velocities = dict(zip(legs.joint_names, rates.tolist(), strict=True))
        found = legs.touching(feet, before, state=state, gyro=gyro, velocities=velocities)
        return found - {"right_foot"}

    assert touching(0.09, ()) == {"left_foot"}
    assert touching(0.15, ()) == frozenset()
    assert touching(0.15, FEET) == {"left_foot"}
    assert touching(0.21, FEET) == frozenset()


SLIDERS = ("a", "b", "c", "d")
SLIDING_LEGS = Legs(
    robot(*map(sliding_leg, SLIDERS)),
    [f"{name}_foot" for name in SLIDERS],
    imu="imu",
    noise=LegNoise(joint=0.004, foot=0.003, slip=0.01),
)


class Walk:
    """Four sliding legs, of which pairs step every ``stance`` readings, and a body that moves at random."""

    stance = 12

    def __init__(self, seed: int) -> None:
        self.body = SimulatedBody(seed, dt_s=0.01)
        self.points = np.zeros((4, 3))
        self.readings = 0

    def reading(self) -> tuple[dict[str, float], frozenset[str]]:
        """The measured joint positions, and the feet on the ground; a pair steps at each end of a stance."""
        body, noise, rng = self.body, SLIDING_LEGS.noise, self.body.rng
        nominal = np.array([[0.3, 0.2, -0.5], [-0.3, -0.2, -0.5], [0.3, -0.2, -0.5], [-0.3, 0.2, -0.5]])
        step, phase = divmod(self.readings, self.stance)
        self.readings += 1
        if phase == 0:
            pair = slice(0, 2) if step % 2 == 0 else slice(2, 4)
            self.points[pair] = body.position + nominal[pair] @ body.rotation.T
        self.points += rng.normal(size=(4, 3)) * noise.slip * np.sqrt(2.0 * body.dt_s)
        in_imu = (self.points - body.position) @ body.rotation + rng.normal(size=(4, 3)) * noise.foot
        # The axes of the IMU are y, -x and z of the trunk, and it is at (0.1, 0, 0.05) there.
        in_trunk = np.column_stack((-in_imu[:, 1] + 0.1, in_imu[:, 0], in_imu[:, 2] + 0.05))
        measured = in_trunk + rng.normal(size=(4, 3)) * noise.joint
        numbers = {
            f"{name}_{axis}": float(value)
            for name, row in zip(SLIDERS, measured, strict=True)
            for axis, value in zip("xyz", row, strict=True)
        }
        lifted = () if phase < 2 else (SLIDERS[2:] if step % 2 == 0 else SLIDERS[:2])
        return numbers, frozenset(f"{name}_foot" for name in SLIDERS if name not in lifted)

    def estimate(self, steps: int) -> iekf.FilterState:
        """The filter's state after a walk with a reading of the joints at every other sample of the IMU."""
        state = self.body.first_estimate()
        for step in range(steps):
            gyro, accel = self.body.step()
            slip = SLIDING_LEGS.noise.slip
            state = iekf.predict(state, gyro, accel, self.body.dt_s, NOISE, contact_noise=slip)
            if step % 2:
                numbers, touching = self.reading()
                state, _ = updated_by_feet(state, SLIDING_LEGS.feet(numbers), touching, GATE)
        return state


@pytest.mark.long
@pytest.mark.parametrize("walks", [10, pytest.param(20, marks=pytest.mark.soak)])
def test_errors_of_walks_are_as_large_as_the_covariance_states(walks: int):
    nees = []
    for seed in range(walks):
        walk = Walk(seed)
        state = walk.estimate(200)
        assert set(state.feet) <= set(SLIDING_LEGS.names)
        nees.append(walk.body.nees(state))
    low, high = mean_band(runs=walks, freedom=3)
    mean = np.mean(nees, axis=0)
    assert ((low < mean) & (mean < high)).all(), mean


def test_feet_with_a_prior_of_their_own_are_false_fixes(monkeypatch: pytest.MonkeyPatch):
    """What GTSAM does by default: a new foot is known to 0.5 m, whatever the error of the position is."""

    def with_loose_contact(state: iekf.FilterState, foot: str, offset: Floats, _: Floats) -> iekf.FilterState:
        point = state.position + state.rotation @ offset
        size = len(state.covariance)
        by_error = np.vstack((np.eye(size), np.zeros((3, size))))
        by_error[size:, :3] = skew(point)
        covariance = by_error @ state.covariance @ by_error.T
        covariance[size:, size:] += np.eye(3) * 0.5**2
        contacts = np.vstack((state.contacts, point))
        return state._replace(feet=(*state.feet, foot), contacts=contacts, covariance=covariance)

    monkeypatch.setattr(legs, "with_contact", with_loose_contact)
    nees = list[float]()
    for seed in range(6):
        walk = Walk(seed)
        nees.append(float(walk.body.nees(walk.estimate(100))[2]))
    assert np.mean(nees) > 3.0 * mean_band(runs=6, freedom=3)[1]


def test_a_foot_that_slips_is_placed_again_and_does_not_move_the_body():
    legs = turning_legs()
    feet = legs.feet(POSITIONS)
    state, squares = updated_by_feet(at_rest(), feet, FEET, GATE)
    assert squares == {}  # both have just touched down
    aside = np.array([0.0, 0.2, 0.0])
    slipped = [feet[0]._replace(offset=feet[0].offset + aside), feet[1]]
    after, squares = updated_by_feet(state, slipped, FEET, GATE)
    assert squares["left_foot"] > GATE > squares["right_foot"]
    np.testing.assert_allclose(after.position, 0.0, atol=1e-9)
    at = after.feet.index("left_foot")
    np.testing.assert_allclose(after.contacts[at], slipped[0].offset, atol=1e-9)
    lifted, _ = updated_by_feet(after, feet, {"right_foot"}, GATE)
    assert lifted.feet == ("right_foot",)


def test_links_that_are_no_feet_are_refused_with_the_reason():
    with pytest.raises(InvalidInput, match="no link 'left_fot'; did you mean 'left_foot'"):
        Legs(TURNING, ["left_fot"], imu="imu")
    with pytest.raises(InvalidInput, match="'tail' is no foot of a leg, seen from 'imu': no joint moves it"):
        Legs(TURNING, ["tail"], imu="imu")
    with pytest.raises(InvalidInput, match="the joint 'body' has no encoder"):
        Legs(TURNING, ["left_foot"], imu="world")
    with pytest.raises(InvalidInput, match="different links"):
        Legs(TURNING, ["left_foot", "left_foot"], imu="imu")


def test_missing_numbers_are_refused_by_name():
    legs = turning_legs(detection=ForceThresholds(touchdown=40.0, liftoff=20.0))
    with pytest.raises(InvalidInput, match="no position of 'left_knee', 'right_knee', which moves a foot"):
        legs.feet({name: angle for name, angle in POSITIONS.items() if "knee" not in name})
    feet = legs.feet(POSITIONS)
    with pytest.raises(InvalidInput, match="no effort of 'left_hip'"):
        legs.touching(feet, (), state=at_rest(), gyro=np.zeros(3))
    with pytest.raises(InvalidInput, match="neither measured nor detected"):
        turning_legs().touching(feet, (), state=at_rest(), gyro=np.zeros(3))


def test_thresholds_and_noise_that_cannot_be_are_refused():
    with pytest.raises(InvalidInput, match="0 < liftoff < touchdown"):
        ForceThresholds(touchdown=20.0, liftoff=40.0)
    with pytest.raises(InvalidInput, match="0 < touchdown < liftoff"):
        SpeedThresholds(touchdown=0.2, liftoff=0.1)
    with pytest.raises(InvalidInput, match="'joint' of legs is finite and above 0"):
        LegNoise(joint=0.0)
