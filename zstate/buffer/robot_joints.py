"""All joints of a robot at one instant, or at many, from the tracks of its drivers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.path import TrackUse, TransformPath, ViewReader, Views, joint_interpolators
from zstate.buffer.tracks import JointTrack
from zstate.checks import Floats
from zstate.model.robot import POSITION_COUNTS


class RobotJoints:
    """Reads the joints of ``robot``, each from the track that moves it, and interpolated as in lookups.

    Positions are in the order of the robot's ``joint_names``. Without ``with_parts`` all of them are read
    from the robot's own track, though parts of the robot may move some.
    """

    def __init__(self, robot: JointTrack, read_views: ViewReader, *, with_parts: bool) -> None:
        self.robot = robot
        parts: Mapping[str, JointTrack] = robot.parts if with_parts else {}
        joints: dict[JointTrack, list[str]] = {}
        for name in robot.model.joint_names:
            joints.setdefault(parts.get(name, robot), []).append(name)
        self.tracks = tuple(joints)
        root = robot.frame(robot.model.root)
        at_root = TrackUse(robot, [], (root, root))
        uses = [_use(track, names) for track, names in joints.items()] or [at_root]
        # A path without steps: it reads the values, and its errors name the limiting joint's edge.
        self.path = TransformPath(root, root, (), (), uses, read_views)
        self.columns = [_columns(robot, names) for names in joints.values()]

    def positions(self, at: int | None, views: Views | None = None) -> tuple[Floats, int]:
        """All positions (nq,) at a stamp [ns], and that stamp; by default the newest that all tracks reach.

        Of the samples in ``views`` of its tracks, if they are given. Raises NoData, InPast, InFuture, Stale
        or NotFinite.
        """
        views = self.path.views() if views is None else views
        values, stamp, *_ = self.path.read(views, at)
        positions = np.empty(self.robot.position_count)
        for columns, numbers in zip(self.columns, values, strict=False):
            positions[columns] = np.hstack(numbers)
        if not np.isfinite(positions).all():
            raise self.path.not_finite(views, values, stamp)
        return positions, stamp

    def positions_many(self, stamps: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        """All positions at each stamp, (T, nq), NaN where they are not known, and (T,) where they are."""
        return self.positions_in(self.path.views(), stamps)

    def positions_in(self, views: Views, stamps: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        """The same of given views of the tracks."""
        positions = np.full((len(stamps), self.robot.position_count), np.nan)
        values, valid = self.path.values_at(views, stamps)
        for columns, numbers in zip(self.columns, values, strict=False):
            rows = [row for number in numbers for row in np.atleast_2d(number)]
            positions[np.ix_(valid, columns)] = np.stack(rows, axis=-1)
        unusable = ~np.isfinite(positions).all(axis=1)
        positions[unusable] = np.nan
        return positions, valid & ~unusable


def _columns(robot: JointTrack, names: list[str]) -> NDArray[np.intp]:
    """The columns of these joints in the positions of the robot."""
    counts = {joint.name: POSITION_COUNTS[joint.type] for joint in robot.model.driven_joints}
    firsts = robot.model.columns
    columns = [firsts[name] + number for name in names for number in range(counts[name])]
    return np.array(columns, dtype=np.intp)


def _use(track: JointTrack, names: list[str]) -> TrackUse:
    """How a path reads these joints of a track; its errors name the edge of the first."""
    indices = {joint.name: index for index, joint in enumerate(track.model.joints)}
    interpolators = [one for name in names for one in joint_interpolators(track, indices[name])]
    return TrackUse(track, interpolators, track.edge(track.forms[indices[names[0]]]))
