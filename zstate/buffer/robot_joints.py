"""All joints of a robot at one instant, or at many, from the tracks of its drivers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.path import TrackUse, TransformPath, ViewReader, Views, joint_interpolators
from zstate.buffer.tracks import JointTrack
from zstate.checks import Floats
from zstate.model.joint_history import JointHistory
from zstate.model.robot import POSITION_COUNTS, coordinate_names, velocity_columns_by_position


class RobotJoints:
    """Reads the joints of ``robot``, each from the track that moves it, and interpolated as in lookups.

    Positions are in the order of the robot's ``joint_names``. Without ``with_parts`` all of them are read
    from the robot's own track, though parts of the robot may move some.
    """

    def __init__(self, robot: JointTrack, read_views: ViewReader, *, with_parts: bool) -> None:
        self._robot = robot
        parts: Mapping[str, JointTrack] = robot.parts if with_parts else {}
        joints: dict[JointTrack, list[str]] = {}
        for name in robot.model.joint_names:
            joints.setdefault(parts.get(name, robot), []).append(name)
        self._tracks = tuple(joints)
        root = robot.frame(robot.model.root)
        at_root = TrackUse(robot, [], (root, root))
        uses = [_use(track, names) for track, names in joints.items()] or [at_root]
        # A path without steps: it reads the values, and its errors name the limiting joint's edge.
        self._path = TransformPath(root, root, (), (), uses, read_views)
        self._columns = [_columns(robot, names) for names in joints.values()]

    def positions(self, at: int | None, views: Views | None = None) -> tuple[Floats, int]:
        """All positions (nq,) at a stamp [ns], and that stamp; by default the newest that all tracks reach.

        Of the samples in ``views`` of its tracks, if they are given. Raises NoData, InPast, InFuture, Stale
        or NotFinite.
        """
        views = self._path.views() if views is None else views
        values, stamp, *_ = self._path.read(views, at)
        positions = np.empty(self._robot.position_count)
        for columns, numbers in zip(self._columns, values, strict=False):
            positions[columns] = np.hstack(numbers)
        if not np.isfinite(positions).all():
            raise self._path.not_finite(views, values, stamp)
        return positions, stamp

    def positions_many(self, stamps: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        """All positions at each stamp, (T, nq), NaN where they are not known, and (T,) where they are."""
        return self._positions_in(self._path.views(), stamps)

    def _positions_in(self, views: Views, stamps: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        positions = np.full((len(stamps), self._robot.position_count), np.nan)
        values, valid = self._path.values_at(views, stamps)
        for columns, numbers in zip(self._columns, values, strict=False):
            rows = [row for number in numbers for row in np.atleast_2d(number)]
            positions[np.ix_(valid, columns)] = np.stack(rows, axis=-1)
        unusable = ~np.isfinite(positions).all(axis=1)
        positions[unusable] = np.nan
        return positions, valid & ~unusable

    def samples(self, start: int | None, end: int | None) -> JointHistory:
        """Copies of the samples in [start, end) [ns].

        With several tracks, an instant for each of their samples that all of them cover: positions are
        interpolated between a track's own samples, and velocities known at its samples only.
        """
        if self._tracks in ((), (self._robot,)):
            return self._robot.samples(self._robot.history.view, start, end)
        views = self._path.views()
        parts = [track.samples(view, start, end) for track, view in zip(self._tracks, views, strict=True)]
        stamps = np.unique(np.concatenate([part.stamps for part in parts]))
        positions, valid = self._positions_in(views, stamps)
        model = self._robot.model
        coordinates, slots = coordinate_names(model), velocity_columns_by_position(model)
        slot_names = tuple(coordinates[slot] for slot in slots)
        whole = JointHistory(model.joint_names, coordinates, slot_names, stamps, positions)
        if any(part.velocities is not None for part in parts):
            velocities = np.full((len(stamps), len(slots)), np.nan)
            for part, columns in zip(parts, self._columns, strict=True):
                if part.velocities is not None:
                    own = frozenset(coordinates[int(column)] for column in columns)
                    known = [name for name in part.velocity_coordinates if name in own]
                    sources = np.array([part.velocity_coordinates.index(name) for name in known], np.intp)
                    places = np.array([slot_names.index(name) for name in known], np.intp)
                    rows = stamps.searchsorted(part.stamps)
                    velocities[np.ix_(rows, places)] = part.velocities[:, sources]
            whole = replace(whole, velocities=velocities)
        return whole.select(np.flatnonzero(valid))


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
