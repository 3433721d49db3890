"""Answers at today's stamps against an independent reference of 50 digits: 1e-12."""

from __future__ import annotations

import random
from collections.abc import Callable
from fractions import Fraction

import helpers.exact_poses as exact
import numpy as np
import pytest
from helpers import model_samples
from helpers.buffers import EVERY_JOINT, NOW, S

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import JointTrack
from zstate.model.load import load_model
from zstate.model.robot import Joint
from zstate.transform import Transform

TOLERANCE = 1e-12
Edges = dict[str, tuple[str, Callable[[int], exact.Matrix]]]


def reference(edges: Edges, target: str, source: str, stamp: int) -> np.ndarray:
    """target_from_source by way of the root, whatever branch the frames are on."""

    def root_from(frame: str) -> exact.Matrix:
        if frame not in edges:
            return exact.pose_matrix((0, 0, 0, 0, 0, 0, 1))
        parent, pose = edges[frame]
        return exact.multiply(root_from(parent), pose(stamp))

    return exact.as_floats(exact.multiply(exact.inverse(root_from(target)), root_from(source)))


def a_pose(rng: random.Random, near: list[float] | None = None) -> list[float]:
    """Any pose; or one that has turned very little from ``near``."""
    q = np.array([rng.gauss(0, 1) for _ in range(4)])
    if near is not None:
        q = np.array(near[3:]) + q * 10.0 ** rng.uniform(-12, -3)
    return [*(rng.uniform(-2, 2) for _ in range(3)), *(q / np.linalg.norm(q)).tolist()]


def a_tree(rng: random.Random) -> tuple[TransformBuffer, Edges]:
    """Up to 8 frames; every moving edge covers NOW to NOW + 1 s at irregular stamps of its own."""
    buffer, edges = TransformBuffer(), Edges()
    for n in range(1, rng.randrange(3, 9)):
        parent, child = f"f{rng.randrange(n)}", f"f{n}"
        if rng.random() < 0.25:
            pose = a_pose(rng)
            buffer.insert_static(Transform.from_pose7(parent, child, pose))
            edges[child] = parent, lambda _, pose=pose: exact.pose_matrix(pose)
            continue
        inner = {NOW + rng.randrange(S) for _ in range(rng.randrange(6))}
        samples: dict[int, list[float]] = {}
        for stamp in sorted({NOW - rng.randrange(S), NOW + S + rng.randrange(S)} | inner):
            samples[stamp] = a_pose(rng, near=next(iter(samples.values()), None) if n % 2 else None)
            buffer.insert(Transform.from_pose7(parent, child, samples[stamp], stamp))
        edges[child] = parent, lambda stamp, samples=samples: exact.pose_between(samples, stamp)
    return buffer, edges


@pytest.mark.parametrize("seed", range(30))
def test_pose_edges_agree_with_the_reference(seed: int) -> None:
    rng = random.Random(seed)
    buffer, edges = a_tree(rng)
    frames = ["f0", *edges]
    for _ in range(8):
        target, source = rng.choice(frames), rng.choice(frames)
        stamp = NOW + rng.randrange(S + 1)
        expected = reference(edges, target, source, stamp)
        np.testing.assert_allclose(buffer.lookup(target, source, stamp).matrix, expected, atol=TOLERANCE)
        many = buffer.lookup_many(target, source, [stamp])[0][0]
        again = Transform.from_pose7(target, source, many).matrix
        np.testing.assert_allclose(again, expected, atol=TOLERANCE)


def joint_pose(
    track: JointTrack, joint: Joint, samples: dict[int, np.ndarray]
) -> Callable[[int], exact.Matrix]:
    """The reference's formula of one joint, from positions by stamp."""
    model, origin = track.model, exact.pose_matrix(joint.origin)

    def position(stamp: int, column: int) -> Fraction:
        before, after, ratio = exact.ratio_in(sorted(samples), stamp)
        a, b = Fraction(samples[before][column]), Fraction(samples[after][column])
        return a + ratio * (b - a)

    def driven(stamp: int, follower: Joint) -> Fraction:
        if follower.mimic is None:
            return position(stamp, model.columns[follower.name])
        master = next(other for other in model.joints if other.name == follower.mimic.joint)
        return Fraction(follower.mimic.multiplier) * driven(stamp, master) + Fraction(follower.mimic.offset)

    def motion(stamp: int) -> exact.Matrix:
        if joint.type == "prismatic":
            return exact.moved(joint.axis, exact.exact(driven(stamp, joint)))
        if joint.type in ("revolute", "continuous"):
            return exact.turned(joint.axis, exact.exact(driven(stamp, joint)))
        column = model.columns[joint.name]
        if joint.type == "floating":
            return exact.pose_between({key: row[column : column + 7] for key, row in samples.items()}, stamp)
        x, y, yaw = (exact.exact(position(stamp, column + n)) for n in range(3))
        slid = exact.multiply(exact.moved((1, 0, 0), x), exact.moved((0, 1, 0), y))
        return exact.multiply(slid, exact.turned((0, 0, 1), yaw))

    if joint.type == "fixed":
        return lambda stamp: origin
    return lambda stamp: exact.multiply(origin, motion(stamp))


def random_positions(rng: random.Random, track: JointTrack) -> np.ndarray:
    numbers = np.array([rng.uniform(-1.5, 1.5) for _ in range(track.model.position_count)])
    for joint in track.model.driven_joints:
        if joint.type == "floating":
            column = track.model.columns[joint.name]
            numbers[column : column + 7] = a_pose(rng)
    return numbers


ROTATED_ORIGINS = pytest.param(model_samples.EVERY_JOINT, id="rotated origins")


@pytest.mark.parametrize(
    "name",
    [
        *("rrbot", "diffbot", "gripper", EVERY_JOINT, ROTATED_ORIGINS),
        pytest.param("panda", marks=pytest.mark.robots),
    ],
)
def test_joint_tracks_agree_with_the_reference(name: str) -> None:
    rng = random.Random(name)
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model(name))
    samples = {
        NOW + n * 10_000_019 + rng.randrange(10_000_000): random_positions(rng, track) for n in range(6)
    }
    for stamp, positions in samples.items():
        buffer.insert_joints(track, stamp, positions)
    edges: Edges = {j.child: (j.parent, joint_pose(track, j, samples)) for j in track.model.joints}
    for _ in range(25):
        target, source = rng.choice(track.model.links), rng.choice(track.model.links)
        stamp = rng.randrange(min(samples), max(samples) + 1)
        expected = reference(edges, target, source, stamp)
        np.testing.assert_allclose(buffer.lookup(target, source, stamp).matrix, expected, atol=TOLERANCE)
