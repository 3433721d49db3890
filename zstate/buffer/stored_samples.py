"""Samples of a buffer in bulk: taken out of it for storage, and set again as they were."""

from __future__ import annotations

from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.feed import BufferFeed
from zstate.buffer.history import History
from zstate.buffer.history_view import HistoryView
from zstate.buffer.pose_tracks import EdgeNames, Poses
from zstate.buffer.tracks import JointTrack, PoseTrack
from zstate.checks import Floats


def take_before(feed: BufferFeed, track: JointTrack | PoseTrack, stamp: int) -> HistoryView:
    """Remove the samples of ``track`` before ``stamp`` [ns] but the last; returns all of these.

    What is left begins with that last one: a history that begins with another sample was restarted.
    """
    with feed.lock:
        view = track.history.view
        end = view.first + int(view.kept_stamps().searchsorted(stamp))
        taken = view._replace(end=end)
        if taken.size > 1:
            rest = view._replace(first=end - 1)
            track.history.replace(rest.kept_stamps(), rest.kept_rows())
    return taken


def load_joints(
    feed: BufferFeed,
    track: JointTrack,
    stamps: NDArray[np.int64],
    positions: Floats,
    velocities: Floats | None,
) -> None:
    """Set all samples of ``track``, which a buffer held before: no number is checked or changed.

    ``stamps`` (T,) [ns] ascend; ``positions`` are (T, nq) and ``velocities`` (T, nv), NaN if not known.
    """
    with feed.lock:
        feed.owner.check(track)
        rows = positions
        if velocities is not None and not track.has_velocities:
            track.history = History(track.history.width + velocities.shape[1], feed.span_ns)
        if track.has_velocities:
            if velocities is None:
                velocities = np.full((len(stamps), track.model.velocity_count), np.nan)
            rows = np.hstack((positions, velocities))
        track.history.replace(stamps, rows)
        feed.tree.invalidate(track)
    feed.waiters.notify(track)


def load_poses(
    feed: BufferFeed, edge: EdgeNames, stamps: NDArray[np.int64], poses: Poses, covariances: Floats | None
) -> None:
    """Set all samples of a moving edge, which a buffer held before: no number is checked or changed.

    ``stamps`` (T,) [ns] ascend, at least one; ``poses`` are (T, 7) and ``covariances`` (T, 21), NaN if
    not known. Raises InsertRefused as ``insert_many``.
    """
    if covariances is not None:
        import_module("zstate.buffer.covariance_path")  # here, not in a lookup later

    with feed.lock:
        ((track, _),) = feed.pose_tracks.track_rows((edge,), int(stamps[-1]), None)
        rows = poses
        if covariances is not None:
            track.history = History(7 + covariances.shape[1], feed.span_ns)
            rows = np.hstack((poses, covariances))
        track.history.replace(stamps, rows)
        feed.tree.invalidate(track)
    feed.waiters.notify(track)
