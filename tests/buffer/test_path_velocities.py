"""Velocities and predictions: from what was published, else from the samples around the instant."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import model_samples
from helpers.buffers import MS, NOW, S, every_joint, failure, filled, moving, pose_of_every, static, x_of

from zstate import se3
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import JointTrack
from zstate.errors import InFuture, InPast, NoData
from zstate.transform import Transform

ROTATED_ORIGINS = model_samples.every_joint().model

FREE = (0.3, -0.2, 0.5)
SPIN = (0.1, 0.4, -0.3)


def positions_at(track: JointTrack, t: float) -> np.ndarray:
    """A smooth motion of every joint; the floating joint turns about a fixed axis."""
    turned = se3.quaternion_exp(tuple(t * w for w in SPIN), se3.SCALARS)
    return pose_of_every(
        track,
        free=(*(t * v for v in FREE), *turned),
        spin=math.sin(t),
        bend=0.4 * t * t,
        lift=math.cos(t),
        slide=(t, 0.5 * t * t, math.sin(2 * t)),
    )


def velocities_at(track: JointTrack, t: float) -> np.ndarray:
    parts = {
        "free": (*FREE, *SPIN),
        "spin": (math.cos(t),),
        "bend": (0.8 * t,),
        "raise": (-math.sin(t),),
        "slide": (1.0, t, 2 * math.cos(2 * t)),
    }
    return np.concatenate([parts[name] for name in track.model.joint_names])


def difference(buffer: TransformBuffer, frame: str, reference: str, step_ns: int, stamp: int) -> np.ndarray:
    """Linear and angular velocity from two poses, to the second order of the step."""
    before, after = (buffer.lookup(reference, frame, stamp + sign * step_ns) for sign in (-1, 1))
    seconds = 2 * step_ns * 1e-9
    turned = se3.multiply(tuple(after.rotation), se3.conjugate(tuple(before.rotation)))
    turn = np.array(se3.rotation_vector(turned, se3.SCALARS))
    return np.hstack((after.translation - before.translation, turn)) / seconds


FRAMES = ["body", "wheel", "arm", "follower", "second", "lift", "sled", "tip"]


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("reference", ["root", "sled", "second"])
def test_published_velocities_give_the_rate_of_the_pose(frame: str, reference: str) -> None:
    buffer, track = every_joint()
    for k in range(-1, 2):
        t = 0.7 + k * 1e-4
        stamp = NOW + k * 100_000
        buffer.insert_joints(track, stamp, positions_at(track, t), velocities_at(track, t))
    twist = buffer.twist(frame, reference, NOW)
    measured = difference(buffer, frame, reference, 100_000, NOW)
    np.testing.assert_allclose((*twist.linear, *twist.angular), measured, atol=2e-6)
    assert (twist.frame, twist.reference, twist.stamp) == (frame, reference, NOW)


@pytest.mark.parametrize("frame", FRAMES)
def test_without_velocities_the_rate_is_that_of_the_interpolated_pose(frame: str) -> None:
    buffer, track = every_joint()
    for t in (0.0, 0.5):
        buffer.insert_joints(track, NOW + round(t * S), positions_at(track, t))
    stamp = NOW + 200 * MS
    twist = buffer.twist(frame, "root", stamp)
    measured = difference(buffer, frame, "root", 10_000, stamp)
    np.testing.assert_allclose((*twist.linear, *twist.angular), measured, atol=1e-6)


@pytest.mark.parametrize("link", ROTATED_ORIGINS.links)
def test_rates_behind_rotated_origins_are_those_of_the_pose(link: str) -> None:
    buffer = TransformBuffer()
    track = buffer.add_robot(ROTATED_ORIGINS)
    for seed in (0, 1):
        positions = model_samples.random_positions(ROTATED_ORIGINS, seed, spread=1.0)
        buffer.insert_joints(track, NOW + seed * S, positions)
    stamp = NOW + S // 3
    twist = buffer.twist(link, "sole", stamp)
    measured = difference(buffer, link, "sole", 10_000, stamp)
    np.testing.assert_allclose((*twist.linear, *twist.angular), measured, atol=1e-6)


def test_pose_tracks_move_at_the_rate_between_their_samples() -> None:
    buffer = filled(
        moving("map", "a", 0, yaw=0.1), moving("map", "a", S, x=2.0, yaw=0.6), static("a", "b", x=1.0)
    )
    for stamp in (0, S // 4, S, None):
        twist = buffer.twist("b", "map", stamp)
        yaw = 0.1 + 0.5 * (1.0 if stamp is None else stamp / S)
        expected = (2.0 - 0.5 * math.sin(yaw), 0.5 * math.cos(yaw), 0.0)
        np.testing.assert_allclose(twist.linear, expected, atol=1e-14)
        np.testing.assert_allclose(twist.angular, (0, 0, 0.5), atol=1e-14)


def test_fixed_path_has_zero_velocity_and_a_single_sample_has_no_rate() -> None:
    buffer = filled(static("a", "b"), moving("b", "c", 0))
    assert buffer.twist("b", "a", NOW).linear.tolist() == [0, 0, 0]
    assert buffer.twist("b", "a").stamp is None
    with pytest.raises(NoData, match="two samples, or published velocities") as caught:
        buffer.twist("c", "a")
    assert caught.value.edge == ("b", "c")
    with pytest.raises(InFuture):
        buffer.twist("c", "a", 1)
    with pytest.raises(InPast):
        buffer.twist("c", "a", -1)


def bent(*samples: tuple[int, float, float | None]) -> TransformBuffer:
    """The arm at these (seconds, angle, velocity or None)."""
    buffer, track = every_joint()
    for seconds, angle, velocity in samples:
        rates = None
        if velocity is not None:
            rates = np.zeros(track.model.velocity_count)
            rates[track.model.velocity_columns["bend"]] = velocity
        buffer.insert_joints(track, seconds * S, pose_of_every(track, bend=angle), rates)
    return buffer


@pytest.mark.parametrize("seconds", [0, 1, 2])
def test_velocities_of_a_sample_are_its_rate_even_if_its_neighbours_have_none(seconds: int) -> None:
    samples = [(n, 0.1 * n * n, 5.0 if n == seconds else None) for n in range(3)]
    assert bent(*samples).twist("arm", "body", seconds * S).angular[2] == 5.0


def test_single_sample_with_velocities_has_a_rate() -> None:
    assert bent((0, 0.1, 3.0)).twist("arm", "body").angular[2] == 3.0


def test_joint_prediction_continues_at_the_published_velocities() -> None:
    buffer = bent((0, 0.0, None), (1, 0.5, 2.0))
    answer = buffer.lookup("body", "arm", S + 100 * MS, predict_s=0.2)
    assert answer.rpy[2] == pytest.approx(0.5 + 2.0 * 0.1)
    assert (answer.kind, answer.stamp) == ("predicted", S + 100 * MS)
    assert answer.predicted_s == pytest.approx(0.1)


def test_prediction_reaches_exactly_as_far_as_requested() -> None:
    buffer = bent((0, 0.0, 1.0))
    assert buffer.lookup("body", "arm", 20 * MS, predict_s=0.02).kind == "predicted"
    assert isinstance(failure(buffer, "body", "arm", 20 * MS + 1, predict_s=0.02), InFuture)
    assert isinstance(failure(buffer, "body", "arm", -1, predict_s=0.02), InPast)
    assert buffer.lookup("body", "arm", predict_s=0.02).kind == "exact"


def test_prediction_of_joints_needs_published_velocities() -> None:
    buffer = bent((0, 0.0, 1.0), (1, 1.0, None))
    error = failure(buffer, "body", "arm", S + 1, predict_s=1.0)
    assert isinstance(error, InFuture)
    assert "no velocity is known" in str(error)


def test_unpredictable_edge_is_reported_rather_than_an_older_one() -> None:
    buffer = bent((2, 0.0, None))
    buffer.insert(moving("map", "root", 0))
    buffer.insert(moving("map", "root", S))
    error = failure(buffer, "map", "arm", 3 * S, predict_s=5.0)
    assert (type(error), error.edge) == (InFuture, ("root", "body"))


def test_poses_are_predicted_at_the_twist_between_their_last_samples() -> None:
    start = Transform.from_rpy("map", "a", (0, 0, 0), (0, 0, 0.25), 0)
    end = Transform.from_rpy("map", "a", (1, 2, 3), (0, 0, 0.75), S)
    answer = filled(start, end).lookup("map", "a", 3 * S, predict_s=2.0)
    np.testing.assert_allclose(answer.translation, (3, 6, 9), atol=1e-14)
    np.testing.assert_allclose(answer.rpy, (0, 0, 1.75), atol=1e-14)
    assert isinstance(failure(filled(start), "map", "a", 1, predict_s=1.0), InFuture)


def test_floating_base_is_predicted_by_its_published_twist() -> None:
    buffer, track = every_joint()
    buffer.insert_joints(track, 0, positions_at(track, 0.5), velocities_at(track, 0.5))
    answer = buffer.lookup("root", "body", 100 * MS, predict_s=0.1)
    other, other_track = every_joint()
    other.insert_joints(other_track, 0, positions_at(other_track, 0.6))
    # The floating joint of this motion has a constant twist, so the prediction is the truth.
    np.testing.assert_allclose(answer.matrix, other.lookup("root", "body").matrix, atol=1e-14)


def test_prediction_never_replaces_a_sample() -> None:
    buffer = filled(moving("a", "b", 0), moving("a", "b", S, x=1.0), moving("a", "b", 2 * S, x=5.0))
    answer = buffer.lookup("a", "b", S + S // 2, predict_s=9.0)
    assert (x_of(answer), answer.kind) == (3.0, "interpolated")
