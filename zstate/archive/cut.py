"""A window of an archive as a recording, which all tools on recordings open."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zstate.archive.archive import Archive
from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.buffer.tracks import PoseTrack
from zstate.errors import InvalidInput
from zstate.model.joint_history import JointHistory
from zstate.model.robot import RobotModel
from zstate.recording.encode import RecordingEncoder
from zstate.recording.errors import RecordingError
from zstate.recording.mcap.writer import RecordingWriter
from zstate.streams import StreamName
from zstate.wire.messages import (
    JointState,
    Message,
    RobotDescription,
    StaticTransforms,
    WriterTransforms,
    order_digest,
    to_block,
)

_JOINTS, _EDGES, _STATICS = 1, 2, 3
"""Sessions of the recording; messages of other streams keep theirs."""

_WRITER = "archive"
_IN_THE_BUFFER = {"joint_states", "partial_joint_states", "transforms"}


class _Timed(NamedTuple):
    """A message to record, the name of its writer, and its stream if it is not that of its type."""

    log_time: int
    message: Message
    name: str | None = None
    stream: StreamName = ""


def cut(url: str, path: Path, robot: str, start: int, end: int) -> Counter[str]:
    """Write what the archive ``url`` has of ``robot`` from ``start`` to ``end`` [ns] into the MCAP ``path``.

    Samples have the same stamps and numbers; they are recorded at their stamps, by one writer for each
    stream. Of drivers of some joints each, the rows of ``Archive.joint_states`` are written. Returns the
    numbers of messages by stream. Raises RecordingError if the file exists or cannot be written, and
    InvalidInput as ``Archive.buffer`` does, and for a window without samples.
    """
    archive = Archive(url)
    buffer = archive.buffer(robot, start, end)
    streams = {stream for one in archive.coverage(robot) for stream in one.rows} - _IN_THE_BUFFER
    joints = archive.joint_states(robot, start, end + 1)
    model = feed_of(buffer).tree_snapshot().robots.get(robot)
    parts = [
        _joint_states(joints, None if model is None else model.model),
        *(_edges(track, start, end) for track in _pose_tracks(buffer)),
        *(_messages(archive, robot, stream, start, end) for stream in sorted(streams)),
    ]
    samples = heapq.merge(*parts, key=lambda one: one.log_time)
    first = next(samples, None)
    if first is None:
        raise InvalidInput(f"the archive {url!r} has no sample of {robot!r} between {start} and {end}")
    if path.exists():
        raise RecordingError(f"{str(path)!r} exists; choose another name", path=str(path))
    refused = Counter[str]()
    with RecordingWriter(path) as writer:
        encoder = RecordingEncoder(
            writer,
            lambda reason, text: refused.update((reason,)),
            alone=robot,
            programs={_JOINTS: _WRITER, _EDGES: _WRITER, _STATICS: _WRITER},
        )
        for one in (*_latched(buffer, robot, first.log_time), first, *samples):
            encoder.write_message(robot, one.message, one.log_time, one.name, stream=one.stream)
        written = Counter({stream: count for (_, stream), count in encoder.messages.items()})
    return written + Counter({f"not written ({reason})": count for reason, count in refused.items()})


def _latched(buffer: TransformBuffer, robot: str, at: int) -> Iterator[_Timed]:
    """The model and the static edges, those of each writer in one message."""
    snapshot = feed_of(buffer).tree_snapshot()
    track = snapshot.robots.get(robot)
    if track is not None:
        model = track.model
        yield _Timed(at, RobotDescription(_JOINTS, model.urdf, model.digest, model.joint_names, ()))
    statics: dict[str, list[tuple[tuple[str, str], tuple[float, ...]]]] = {}
    for edge in snapshot.edges.values():
        if edge is not None and edge.kind == "static" and edge.robot is None:
            statics.setdefault(edge.static_writer or _WRITER, []).append((edge.names, edge.pose))
    for name, edges in statics.items():
        poses = to_block([pose for _, pose in edges])
        yield _Timed(at, StaticTransforms(_STATICS, tuple(names for names, _ in edges), poses), name)


def _joint_states(joints: JointHistory, model: RobotModel | None) -> Iterator[_Timed]:
    names = joints.coordinates if model is None else None
    order = order_digest(joints.coordinates if model is None else model.joint_names)
    for row, stamp in enumerate(joints.stamps.tolist()):
        velocities, efforts = (
            None if block is None or np.isnan(block[row]).all() else to_block(block[row])
            for block in (joints.velocities, joints.efforts)
        )
        head = stamp, row, _JOINTS, order
        yield _Timed(stamp, JointState(*head, to_block(joints.positions[row]), velocities, efforts, names))


def _pose_tracks(buffer: TransformBuffer) -> list[PoseTrack]:
    edges = feed_of(buffer).tree_snapshot().edges.values()
    return [edge.track for edge in edges if edge is not None and isinstance(edge.track, PoseTrack)]


def _edges(track: PoseTrack, start: int, end: int) -> Iterator[_Timed]:
    """The samples of the one edge of a track."""
    view = track.history.view
    order, covariances = order_digest(track.edges), track.covariance_columns(0)
    rows = zip(view.kept_stamps().tolist(), view.kept_rows(), strict=True)
    for seq, (stamp, row) in enumerate(rows):
        if start <= stamp <= end:
            triangle = to_block(row[covariances]) if track.has_covariances else None
            head = stamp, seq, _EDGES, order
            yield _Timed(stamp, WriterTransforms(*head, to_block(row[:7]), track.edges, triangle), _WRITER)


def _messages(archive: Archive, robot: str, stream: StreamName, start: int, end: int) -> Iterator[_Timed]:
    for one in archive.messages(robot, stream, start, end + 1):
        yield _Timed(one.log_time, one.message, one.name or None, stream)
