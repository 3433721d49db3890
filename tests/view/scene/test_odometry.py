"""OdometryPaths: the paths and ellipses of edges with covariances."""

from __future__ import annotations

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.scene_drawing import at, handles, is_visible, pose_in_fixed, tree  # noqa: E402

from zstate.buffer.buffer import TransformBuffer  # noqa: E402
from zstate.transform import Transform  # noqa: E402
from zstate.view.scene.odometry import OdometryPaths  # noqa: E402
from zstate.view.scene.world import DrawnFrames  # noqa: E402

S = 1_000_000_000
COVARIANCE = np.diag([0.04, 0.01, 1.0, 1.0, 1.0, 1.0])
COVARIANCE[0, 1] = COVARIANCE[1, 0] = 0.01


class Shown:
    """The odometry of a base that moves along x at 1 m/s for 20 s, drawn in ``fixed``."""

    def __init__(self, server, covariance: np.ndarray | None = COVARIANCE) -> None:
        self.server = server
        self.buffer = TransformBuffer(history_s=60.0)
        for second in range(21):
            base = Transform("r1/odom", "r1/base", (second, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0), second * S)
            self.buffer.insert(base if covariance is None else base.with_covariance(covariance))
        self.odometry = OdometryPaths(server.scene)
        self.show()

    def show(self, stamp: int | None = None, fixed: str = "r1/odom") -> None:
        snapshot = self.buffer.snapshot(stamp)
        self.odometry.show(self.buffer, DrawnFrames(snapshot.tree, snapshot.poses_in(fixed), fixed), stamp)

    def points(self, name: str) -> np.ndarray:
        """The visible line of that name in the fixed frame: (N, 3)."""
        found = handles(self.server, viser.LineSegmentsHandle)
        (path,) = [path for path in found if path.endswith(name) and is_visible(self.server, path)]
        points = found[path].points
        assert np.array_equal(points[:-1, 1], points[1:, 0])
        pose = Transform.from_pose7("fixed", "node", pose_in_fixed(self.server, path))
        return pose.apply(np.concatenate((points[:1, 0], points[:, 1])))

    def lines(self) -> list[str]:
        found = handles(self.server, viser.LineSegmentsHandle)
        return sorted(path.rpartition("/")[2] for path in found if is_visible(self.server, path))


@pytest.fixture
def shown(server) -> Shown:
    return Shown(server)


def test_path_is_where_the_base_was_in_the_last_seconds(shown: Shown):
    shown.odometry.path_s = 4.0
    shown.show()
    path = shown.points("path")
    assert np.allclose(path[[0, -1]], [[16.0, 0.0, 2.0], [20.0, 0.0, 2.0]])
    assert np.allclose(np.diff(path[:, 0]), 0.1, atol=1e-5)
    shown.show(stamp=10 * S)
    assert np.allclose(shown.points("path")[[0, -1], 0], [6.0, 10.0])
    shown.show(stamp=2 * S)
    assert np.allclose(shown.points("path")[[0, -1], 0], [0.0, 2.0])


def test_ellipse_has_the_mahalanobis_distance_of_95_percent_around_the_base_on_the_ground(shown: Shown):
    """For two normal numbers P(d^2 < r) = 1 - exp(-r / 2), which is 0.95 at 5.991."""
    ellipse = shown.points("ellipse")
    offsets = ellipse[:, :2] - (20.0, 0.0)
    squares = np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(COVARIANCE[:2, :2]), offsets)
    assert np.allclose(1.0 - np.exp(-squares / 2.0), 0.95, atol=1e-4)
    assert np.allclose(offsets.max(axis=0), np.sqrt(5.991 * np.array([0.04, 0.01])), rtol=2e-3)
    assert np.allclose(ellipse[:, 2], 0.005)


def test_label_at_the_ellipse_shows_what_it_is(shown: Shown):
    (label,) = handles(shown.server, viser.LabelHandle).values()
    assert label.text == "position, 95 %"
    assert np.linalg.norm(shown.points("ellipse") - label.position, axis=1).min() < 1e-6
    shown.buffer.insert(Transform("r1/odom", "r1/base", (21.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0), 21 * S))
    shown.show()
    assert not label.visible  # the covariance is not known


def test_in_a_frame_of_the_robot_the_path_moves_and_not_the_base(shown: Shown):
    shown.show(fixed="r1/base")
    assert np.allclose(shown.points("path")[-1], [0.0, 0.0, 0.0], atol=1e-6)


def test_odometry_can_be_hidden(shown: Shown):
    assert shown.lines() == ["ellipse", "path"]
    shown.odometry.is_on = False
    shown.show()
    assert shown.lines() == []
    shown.odometry.is_on = True
    shown.show()
    assert shown.lines() == ["ellipse", "path"]


def test_edges_without_covariances_are_not_drawn(server):
    assert Shown(server, covariance=None).lines() == []


def test_ellipse_is_hidden_while_the_covariance_is_not_known(shown: Shown):
    shown.buffer.insert(Transform("r1/odom", "r1/base", (21.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0), 21 * S))
    shown.show()
    assert shown.lines() == ["path"]


def test_withdrawn_edge_is_removed(shown: Shown):
    shown.buffer.insert_static(Transform("r1/odom", "r1/base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    shown.show()
    assert handles(shown.server, viser.LineSegmentsHandle) == {}


def test_odometry_without_a_place_is_hidden(shown: Shown):
    frames = tree({"map": None})
    shown.odometry.show(shown.buffer, DrawnFrames(frames, np.array([at()]), "map"), None)
    assert shown.lines() == []
