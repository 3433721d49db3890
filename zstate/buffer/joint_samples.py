"""Copies of the samples of joints that a buffer keeps: of one driver, or of a robot with several."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from zstate.buffer.history_view import HistoryView
from zstate.buffer.robot_joints import RobotJoints
from zstate.buffer.tracks import JointTrack
from zstate.model.joint_history import JointHistory
from zstate.model.robot import coordinate_names, velocity_columns_by_position


def track_samples(
    track: JointTrack, view: HistoryView, start: int | None = None, end: int | None = None
) -> JointHistory:
    """Copies of the samples of ``track`` in ``view`` with stamps in [start, end) [ns]; None is no limit."""
    coordinates = coordinate_names(track.model)
    stamps = view.kept_stamps()
    first = 0 if start is None else int(stamps.searchsorted(start))
    last = len(stamps) if end is None else int(stamps.searchsorted(end))
    rows = view.kept_rows()[first:last].copy()
    positions, velocities = rows[:, : track.position_count], rows[:, track.position_count :]
    return JointHistory(
        track.model.joint_names,
        coordinates,
        tuple(coordinates[column] for column in velocity_columns_by_position(track.model)),
        stamps[first:last].copy(),
        positions,
        None if np.isnan(velocities).all() else velocities,
    )


def robot_samples(joints: RobotJoints, start: int | None, end: int | None) -> JointHistory:
    """Copies of the samples of a robot in [start, end) [ns].

    With several tracks, an instant for each of their samples that all of them cover: positions are
    interpolated between a track's own samples, and velocities known at its samples only.
    """
    robot, tracks = joints.robot, joints.tracks
    if tracks in ((), (robot,)):
        return track_samples(robot, robot.history.view, start, end)
    views = joints.path.views()
    parts = [track_samples(track, view, start, end) for track, view in zip(tracks, views, strict=True)]
    stamps = np.unique(np.concatenate([part.stamps for part in parts]))
    positions, valid = joints.positions_in(views, stamps)
    model = robot.model
    coordinates, slots = coordinate_names(model), velocity_columns_by_position(model)
    slot_names = tuple(coordinates[slot] for slot in slots)
    whole = JointHistory(model.joint_names, coordinates, slot_names, stamps, positions)
    if any(part.velocities is not None for part in parts):
        velocities = np.full((len(stamps), len(slots)), np.nan)
        for part, columns in zip(parts, joints.columns, strict=True):
            if part.velocities is not None:
                own = frozenset(coordinates[int(column)] for column in columns)
                known = [name for name in part.velocity_coordinates if name in own]
                sources = np.array([part.velocity_coordinates.index(name) for name in known], np.intp)
                places = np.array([slot_names.index(name) for name in known], np.intp)
                rows = stamps.searchsorted(part.stamps)
                velocities[np.ix_(rows, places)] = part.velocities[:, sources]
        whole = replace(whole, velocities=velocities)
    return whole.select(np.flatnonzero(valid))
