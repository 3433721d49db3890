"""Joint tracks: joint positions between samples, and what each type of joint makes of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.buffers import EVERY_JOINT, NOW, S, every_joint, failure, pose_of_every

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InvalidInput, NoData
from zstate.model.kinematics import Kinematics
from zstate.model.load import load_model

PI = math.pi


def between(start: dict, end: dict, target: str, source: str, quarters: int = 1):
    """The answer ``quarters`` of the way from one set of joint positions to another."""
    buffer, track = every_joint()
    buffer.insert_joints(track, NOW, pose_of_every(track, **start))
    buffer.insert_joints(track, NOW + 4 * S, pose_of_every(track, **end))
    return buffer.lookup(target, source, NOW + quarters * S)


def yaw_of(transform) -> float:
    """The turn about z, in (-pi, pi]."""
    return float(transform.rpy[2])


def turns_equal(a: float, b: float) -> bool:
    return abs(math.remainder(a - b, 2 * PI)) < 1e-12


@pytest.mark.parametrize(
    ("start", "end", "at_a_quarter"),
    [
        (0.0, 1.0, 0.25),
        (3.0, -3.0, 3.0 + 0.25 * (2 * PI - 6.0)),
        (-3.0, 3.0, -3.0 - 0.25 * (2 * PI - 6.0)),
        (-0.5 * PI, 0.5 * PI, -0.25 * PI),
        (-1.6, 1.6, -1.6 - 0.25 * (2 * PI - 3.2)),
        (0.0, 4 * PI, PI),
        (3.2, -3.0, 3.2 - 0.25 * 6.2),
        (100.0, 110.0, 102.5),
        (-PI, PI, -PI),
    ],
)
def test_continuous_joints_interpolate_linearly_except_when_the_encoder_wrapped(
    start, end, at_a_quarter
) -> None:
    answer = between({"spin": start}, {"spin": end}, "body", "wheel")
    assert turns_equal(yaw_of(answer), at_a_quarter)


def test_exactly_half_a_turn_is_no_wrap() -> None:
    answer = between({"spin": -0.5 * PI}, {"spin": 0.5 * PI}, "body", "wheel", 2)
    assert yaw_of(answer) == pytest.approx(0.0, abs=1e-15)


def test_revolute_joints_interpolate_linearly_for_any_numbers() -> None:
    answer = between({"bend": -3.0}, {"bend": 3.0}, "body", "arm")
    assert yaw_of(answer) == pytest.approx(-1.5)


def test_mimic_joints_follow_their_master_through_chains() -> None:
    bend = 0.25 * 2.0
    follow = 2.0 * bend + 0.25
    answer = between({}, {"bend": 2.0}, "arm", "follower")
    assert yaw_of(answer) == pytest.approx(follow)
    answer = between({}, {"bend": 2.0}, "follower", "second")
    assert answer.translation[0] == pytest.approx(-3.0 * follow + 0.5)


def test_mimic_of_more_than_a_turn_between_samples_is_not_shortened() -> None:
    # The follower turns by 2 * 8 rad, which two poses could not show.
    assert turns_equal(yaw_of(between({}, {"bend": 8.0}, "arm", "follower")), 2 * 2.0 + 0.25)


def test_mimic_of_a_continuous_joint_follows_its_direction() -> None:
    text = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
      <joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
      <joint name="k" type="continuous"><parent link="a"/><child link="c"/><axis xyz="0 0 1"/>
        <mimic joint="j" multiplier="0.5"/></joint></robot>"""
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model(text))
    buffer.insert_joints(track, 0, [3.0])
    buffer.insert_joints(track, 4 * S, [-3.0])
    master = 3.0 + 0.25 * (2 * PI - 6.0)
    assert yaw_of(buffer.lookup("a", "c", S)) == pytest.approx(0.5 * master)


def test_prismatic_and_planar_joints_move_along_their_axes() -> None:
    answer = between({}, {"lift": 2.0, "slide": (4.0, 8.0, 1.0)}, "body", "tip")
    x, y, yaw = 1.0, 2.0, 0.25
    expected = (x + 0.5 * math.cos(yaw), 1.0 + y + 0.5 * math.sin(yaw), 0.5)
    np.testing.assert_allclose(answer.translation, expected, atol=1e-15)
    assert yaw_of(answer) == pytest.approx(yaw)


def test_planar_yaw_rotates_as_a_continuous_joint() -> None:
    answer = between({"slide": (0, 0, 3.0)}, {"slide": (0, 0, -3.0)}, "lift", "sled", 2)
    assert turns_equal(yaw_of(answer), PI)


def test_floating_joints_interpolate_as_poses_behind_their_origin() -> None:
    half = 0.5 * 1.0
    end = {"free": (4.0, 8.0, 12.0, 0.0, 0.0, math.sin(half), math.cos(half))}
    answer = between({}, end, "root", "body")
    # The origin lifts by 1 m and turns a quarter about z: its x is the root's y.
    np.testing.assert_allclose(answer.translation, (-2.0, 1.0, 4.0), atol=1e-14)
    assert yaw_of(answer) == pytest.approx(0.5 * PI + 0.25)


@pytest.mark.parametrize(
    "name", ["rrbot", "diffbot", "gripper", pytest.param("panda", marks=pytest.mark.robots)]
)
def test_links_at_a_sample_equal_the_kinematics(name: str) -> None:
    model = load_model(name)
    buffer = TransformBuffer()
    track = buffer.add_robot(model)
    positions = 0.3 * np.arange(1, model.position_count + 1)
    buffer.insert_joints(track, NOW, positions)
    for link, pose in zip(model.links, Kinematics(model).link_poses(positions), strict=True):
        q = pose[3:] * np.sign(pose[3:] @ buffer.lookup(model.root, link).rotation)
        np.testing.assert_allclose(buffer.lookup(model.root, link).pose7, (*pose[:3], *q), atol=1e-12)


@pytest.mark.parametrize(
    ("positions", "complaint"),
    [
        ([0.0] * 3, "13 positions"),
        ([0.0] * 6 + [math.nan] + [0.0] * 6, "'free'"),
        ([0.0] * 6 + [1.0] + [math.inf] + [0.0] * 5, "'spin'"),
        ([0.0] * 13, "quaternion"),
        ([0.0] * 6 + [1.0011] + [0.0] * 6, "quaternion"),
    ],
)
def test_invalid_positions_are_refused_and_change_nothing(positions, complaint: str) -> None:
    buffer, track = every_joint()
    with pytest.raises(InvalidInput, match=complaint):
        buffer.insert_joints(track, 0, positions)
    assert isinstance(failure(buffer, "root", "body"), NoData)


def test_floating_joints_quaternion_within_a_thousandth_is_normalised() -> None:
    buffer, track = every_joint()
    buffer.insert_joints(track, 0, pose_of_every(track, free=(0, 0, 0, 0, 0, 0, 1.0009), lift=5.0))
    # The origin lifts by 1 m and the joint by 5 m, which a stretched quaternion would scale.
    np.testing.assert_allclose(buffer.lookup("root", "lift").translation, (0, 0, 6), atol=1e-14)


@pytest.mark.parametrize("model", [load_model("rrbot"), load_model(EVERY_JOINT)], ids=["plain", "floating"])
def test_block_of_bytes_is_inserted_as_its_numbers(model) -> None:
    buffer = TransformBuffer()
    track = buffer.add_robot(model, "r")
    numbers = model.neutral + 1e-4
    buffer.insert_joints(track, 0, numbers)
    buffer.insert_joints(track, S, numbers.tobytes())
    ends = f"r/{model.root}", f"r/{model.links[-1]}"
    assert buffer.lookup(*ends, 0).pose7.tolist() == buffer.lookup(*ends, S).pose7.tolist()
    for broken in (numbers.tobytes()[8:], numbers.tobytes()[1:], (numbers * np.nan).tobytes(), b""):
        with pytest.raises(InvalidInput):
            buffer.insert_joints(track, 2 * S, broken)
    assert buffer.latest(*ends) == S


def test_velocities_may_start_later_and_be_missing_again() -> None:
    buffer, track = every_joint()
    rates = np.zeros(track.model.velocity_count)
    for n, given in enumerate((None, rates, None)):
        buffer.insert_joints(track, n * S, pose_of_every(track, bend=float(n)), given)
    assert buffer.lookup("body", "arm", 3 * S // 2).rpy[2] == pytest.approx(1.5)
    with pytest.raises(InvalidInput, match="velocities"):
        buffer.insert_joints(track, 3 * S, pose_of_every(track), [0.0])


def test_positions_between_samples_with_velocities_are_linear() -> None:
    buffer, track = every_joint()
    for t, bend in ((0, 0.0), (2, 6.0)):
        rates = np.full(track.model.velocity_count, 11.0)
        buffer.insert_joints(track, t * S, pose_of_every(track, bend=bend), rates)
    assert yaw_of(buffer.lookup("body", "arm", S // 2)) == pytest.approx(0.25 * 6.0)
