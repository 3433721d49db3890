"""Covariances of moving edges in a buffer."""

import numpy as np
import pytest

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InsertRefused, InvalidInput
from zstate.transform import UPPER_TRIANGLE, Transform

S = 1_000_000_000
NAN_ROW = np.full(21, np.nan)
POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def diagonal(*variances: float) -> np.ndarray:
    return np.diag(np.array(variances))[UPPER_TRIANGLE]


def pose(stamp: int) -> Transform:
    return Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp)


def test_covariance_of_a_sample_is_given_back_with_its_edge():
    buffer = TransformBuffer()
    covariance = np.eye(6) + 0.1
    buffer.insert(pose(S).with_covariance(covariance))
    assert np.array_equal(buffer.lookup("odom", "base").covariance, covariance)
    assert np.array_equal(buffer.plan("odom", "base").at(S).covariance, covariance)


def test_covariance_between_two_samples_is_interpolated():
    buffer = TransformBuffer()
    buffer.insert(pose(0).with_covariance(np.eye(6)))
    buffer.insert(pose(4 * S).with_covariance(5 * np.eye(6)))
    assert np.allclose(buffer.lookup("odom", "base", S).covariance, 2 * np.eye(6))


def test_samples_without_a_covariance_have_none_before_and_after():
    buffer = TransformBuffer()
    plan = None
    for second in range(4):
        sample = pose(second * S)
        buffer.insert(sample.with_covariance(np.eye(6)) if second == 2 else sample)
        plan = plan or buffer.plan("odom", "base")
    known = [buffer.lookup("odom", "base", second * S).covariance is not None for second in range(4)]
    assert known == [False, False, True, False]
    assert buffer.lookup("odom", "base", 3 * S // 2).covariance is None
    assert plan is not None
    assert plan.at(2 * S).covariance is not None


def test_covariances_stay_with_their_edges_when_a_track_is_split():
    buffer = TransformBuffer()
    edges = [("odom", "base"), ("base", "arm"), ("base", "mast")]
    rows = [diagonal(1, 1, 1, 1, 1, 1), NAN_ROW, diagonal(3, 3, 3, 3, 3, 3)]
    buffer.insert_many(edges, S, [POSE] * 3, covariances=rows)
    buffer.insert_many(edges[1:2], 2 * S, [POSE])
    assert np.array_equal(buffer.lookup("odom", "base", S).covariance, np.eye(6))
    assert buffer.lookup("base", "arm", S).covariance is None
    assert np.array_equal(buffer.lookup("base", "mast", S).covariance, 3 * np.eye(6))


def test_paths_of_several_edges_have_the_same_poses_with_covariances():
    plain, uncertain = TransformBuffer(), TransformBuffer()
    edges, poses = [("odom", "base"), ("base", "arm")], [POSE, (1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0)]
    plain.insert_many(edges, S, poses)
    uncertain.insert_many(edges, S, poses, covariances=[diagonal(1, 2, 3, 4, 5, 6), NAN_ROW])
    for target, source in (("odom", "arm"), ("arm", "odom"), ("base", "arm")):
        assert uncertain.lookup(target, source) == plain.lookup(target, source)


@pytest.mark.parametrize(
    ("covariances", "error", "match"),
    [
        ([NAN_ROW], InvalidInput, r"shape \(2, 21\)"),
        (np.zeros((2, 6, 6)), InvalidInput, r"got \(2, 6, 6\)"),
        ([NAN_ROW, diagonal(1, 1, -1, 1, 1, 1)], InsertRefused, "'base' -> 'arm': variances are finite"),
        ([diagonal(1, 1, 1, 1, 1, np.inf), NAN_ROW], InsertRefused, "'odom' -> 'base'"),
    ],
)
def test_bad_covariances_are_refused_and_change_nothing(covariances, error, match):
    buffer = TransformBuffer()
    with pytest.raises(error, match=match):
        buffer.insert_many([("odom", "base"), ("base", "arm")], S, [POSE] * 2, covariances=covariances)
    assert buffer.frames() == ()
