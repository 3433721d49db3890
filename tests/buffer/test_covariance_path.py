"""Covariances of lookups over several edges."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.buffers import S

from zstate import se3
from zstate.buffer.buffer import TransformBuffer
from zstate.model.load import load_model
from zstate.transform import UPPER_TRIANGLE, Transform

ARM = """<robot name="arm"><link name="base"/><link name="upper"/><link name="hand"/>
  <joint name="lift" type="revolute"><parent link="base"/><child link="upper"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/><axis xyz="0 0 1"/></joint>
  <joint name="wrist" type="fixed"><parent link="upper"/><child link="hand"/><origin xyz="2 0 0"/></joint>
</robot>"""


def random_covariance(random: np.random.Generator, sigma: float) -> np.ndarray:
    """A covariance of deviations of about ``sigma`` [m] and [rad], all of them correlated."""
    root = random.normal(size=(6, 6)) * sigma / np.sqrt(6.0)
    return root @ root.T


def random_pose(random: np.random.Generator) -> se3.Pose:
    q = random.normal(size=4)
    return (*random.uniform(-3.0, 3.0, 3).tolist(), *(q / np.linalg.norm(q)).tolist())


def perturbed(pose: se3.Pose, errors: np.ndarray) -> se3.Pose:
    """Poses whose errors, (N, 6), are those that ``Transform.covariance`` defines."""
    x, y, z, *w = errors.T
    turned = se3.multiply(se3.quaternion_exp((w[0], w[1], w[2]), se3.ARRAYS), pose[3:])
    return (pose[0] + x, pose[1] + y, pose[2] + z, *turned)


def errors_of(poses: se3.Pose, mean: se3.Pose) -> np.ndarray:
    """The errors of poses against ``mean``: (N, 6)."""
    moved = [found - expected for found, expected in zip(poses[:3], mean[:3], strict=True)]
    turned = se3.multiply(poses[3:], se3.conjugate(mean[3:]))
    return np.stack([*moved, *se3.rotation_vector(turned, se3.ARRAYS)], axis=-1)


def test_a_turn_of_the_base_displaces_the_hand_at_the_end_of_its_arm():
    """At a distance L of the base, in its x: y = y_base + L yaw; the joint and the fixed edge are exact."""
    deviation, yaw_deviation, length = 0.1, 0.02, 2.0
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model(ARM))
    for second in (0, 1):
        buffer.insert_joints(track, second * S, [0.0])
        base = Transform("odom", "base", (5.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), second * S)
        buffer.insert(base.with_covariance(np.diag([deviation**2] * 3 + [0.0, 0.0, yaw_deviation**2])))
    expected = np.diag([deviation**2] * 3 + [0.0, 0.0, yaw_deviation**2])
    expected[1, 1] += (length * yaw_deviation) ** 2
    expected[1, 5] = expected[5, 1] = length * yaw_deviation**2
    for at in (0, S // 2, None):
        covariance = buffer.lookup("odom", "hand", at).covariance
        assert covariance is not None
        np.testing.assert_allclose(covariance, expected, atol=1e-15)
    assert buffer.lookup("base", "hand").covariance is None


def test_covariance_of_a_path_is_that_of_its_samples_with_random_errors():
    """Two uncertain edges up to the target and two down to the source, with static edges between them.

    The entry (i, j) of the covariance of N samples deviates by sqrt((s_ii s_jj + s_ij^2) / N): 6 deviations
    are allowed for 21 entries, and 1 % of the variances for the terms of second order in 0.01 rad.
    """
    random, count = np.random.default_rng(20), 20_000
    buffer = TransformBuffer()
    chains: list[se3.Pose] = []
    mean_chains: list[se3.Pose] = []
    for side in ("left", "right"):
        sampled = mean = se3.IDENTITY
        parent = "top"
        for number in range(2):
            pose, static, covariance = (
                random_pose(random),
                random_pose(random),
                random_covariance(random, 0.01),
            )
            moving = Transform(parent, f"{side}{number}", pose[:3], pose[3:], S)
            buffer.insert(moving.with_covariance(covariance))
            buffer.insert_static(Transform(f"{side}{number}", f"{side}_end{number}", static[:3], static[3:]))
            errors = random.multivariate_normal(np.zeros(6), covariance, count, method="eigh")
            sampled = se3.compose(se3.compose(sampled, perturbed(pose, errors)), static)
            mean = se3.compose(se3.compose(mean, pose), static)
            parent = f"{side}_end{number}"
        chains.append(sampled)
        mean_chains.append(mean)
    target_from_source = se3.compose(se3.invert(mean_chains[0]), mean_chains[1])
    errors = errors_of(se3.compose(se3.invert(chains[0]), chains[1]), target_from_source)
    measured = errors.T @ errors / count

    found = buffer.lookup("left_end1", "right_end1")
    covariance = found.covariance
    assert covariance is not None
    variances = np.outer(np.diag(covariance), np.diag(covariance))
    tolerance = 6.0 * np.sqrt((variances + covariance**2) / count) + 0.01 * np.sqrt(variances)
    assert (np.abs(covariance - measured) < tolerance).all()
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    # Every other way to the same transform has the same covariance.
    inverse = buffer.lookup("right_end1", "left_end1").inverse()
    product = buffer.lookup("left_end1", "right0") @ buffer.lookup("right0", "right_end1")
    for other in (inverse, product):
        assert other.covariance is not None
        np.testing.assert_allclose(other.covariance, covariance, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("known", [("odom", "base"), ("base", "mast")])
def test_covariance_is_unknown_if_that_of_one_moving_edge_is(known: tuple[str, str]):
    buffer = TransformBuffer()
    for edge in (("odom", "base"), ("base", "mast")):
        moved = Transform(*edge, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), S)
        buffer.insert(moved.with_covariance(np.eye(6)) if edge == known else moved)
    assert buffer.lookup(*known).covariance is not None
    assert buffer.lookup("odom", "mast").covariance is None
    buffer.insert_many([("odom", "base")], 2 * S, [se3.IDENTITY], covariances=[np.eye(6)[UPPER_TRIANGLE]])
    buffer.insert_many([("base", "mast")], 2 * S, [se3.IDENTITY], covariances=[np.eye(6)[UPPER_TRIANGLE]])
    assert buffer.lookup("odom", "mast", 2 * S).covariance is not None
    # Before that, one of the two samples around has none.
    assert buffer.lookup("odom", "mast", 3 * S // 2).covariance is None
    assert buffer.lookup("odom", "mast", 2 * S + 1, predict_s=0.1).covariance is None
    assert buffer.lookup_between("odom", 2 * S, "mast", 2 * S, "base").covariance is None


@pytest.mark.parametrize("compiled", [True, False])
def test_poses_and_placed_points_are_the_same_with_covariances(compiled: bool):
    random = np.random.default_rng(3)
    plain, uncertain = TransformBuffer(), TransformBuffer()
    for second in range(3):
        for edge in (("odom", "base"), ("base", "mast")):
            pose = random_pose(random)
            moved = Transform(*edge, pose[:3], pose[3:], second * S)
            plain.insert(moved)
            uncertain.insert(moved.with_covariance(random_covariance(random, 0.1)))
    stamps, points = np.arange(0, 2 * S, S // 7), random.normal(size=(15, 3))
    paths = [buffer._path("mast", "odom", compiled=compiled) for buffer in (plain, uncertain)]
    for at in (*stamps.tolist(), None):
        transforms = [path.transform(at) for path in paths]
        assert transforms[0].pose7.tolist() == transforms[1].pose7.tolist()
        assert [transform.covariance is None for transform in transforms] == [True, False]
    for first, second in zip(
        *((*path.poses(stamps), *path.place(points, stamps)) for path in paths), strict=True
    ):
        assert np.array_equal(first, second)
