"""The /tf and /tf_static messages of a state publisher, as CDR, and a reader's history of them.

For systems without robot_state_publisher. Standard library only, because it runs in their environments.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from bench.job import Job
from bench.subjects.edges import Edge, Pose, compose, path_between, read_edges

STAMP = struct.Struct("<iI")
HISTORY_NS = 10_000_000_000
_LITTLE_ENDIAN = bytes((0, 1, 0, 0))


class TfBytes:
    """TFMessages of one row each, computed and serialized beforehand except for the stamps."""

    def __init__(self, job: Job) -> None:
        edges = read_edges(job.urdf)
        moving = [edge for edge in edges if edge.moves]
        self._rows = [_pieces(moving, dict(zip(job.joints, row, strict=True))) for row in job.rows]
        self.static = bytes(STAMP.size).join(_pieces([edge for edge in edges if not edge.moves], {}))

    def message(self, row: int, stamp: int) -> bytes:
        """The message of all moving edges at ``stamp`` [ns]."""
        return STAMP.pack(*divmod(stamp, 10**9)).join(self._rows[row])


def _pieces(edges: Sequence[Edge], positions: Mapping[str, float]) -> list[bytes]:
    """tf2_msgs/msg/TFMessage in little-endian CDR, cut at the stamps."""
    message, cuts = bytearray(struct.pack("<I", len(edges))), [0]
    for edge in edges:
        message += bytes(STAMP.size)
        cuts.append(len(message))
        for name in (edge.parent, edge.child):
            message += bytes(-len(message) % 4)
            message += struct.pack("<I", len(name.encode()) + 1) + name.encode() + b"\0"
        message += bytes(-len(message) % 8) + struct.pack("<7d", *edge.pose(positions))
    ends = [cut - STAMP.size for cut in cuts[1:]] + [len(message)]
    pieces = [bytes(message[begin:end]) for begin, end in zip(cuts, ends, strict=True)]
    return [_LITTLE_ENDIAN + pieces[0], *pieces[1:]]


class TfHistory:
    """The last 10 s of the edges between base and tip, from received messages.

    Accepts ROS 2 messages of any binding. Other edges are not kept, and the path from base to tip is computed
    beforehand: less work than a transform buffer does.
    """

    def __init__(self, job: Job) -> None:
        edges = read_edges(job.urdf)
        moving = {edge.child for edge in edges if edge.moves}
        self._path = path_between(edges, job.base, job.tip)
        self._moving = [child for child in self._path if child in moving]
        self._links = set(job.links) - {job.base}
        self._known: set[str] = set()
        self._statics: dict[str, Pose] = {}
        self._poses: dict[int, dict[str, Pose]] = {}
        self._stamps: deque[int] = deque()

    def add_statics(self, message: Any) -> None:
        """Adds a message of /tf_static."""
        for stamped in message.transforms:
            self._statics[stamped.child_frame_id] = _pose(stamped.transform)
        self._known.update(self._statics)

    def add(self, message: Any) -> int:
        """Adds a message of /tf; returns its stamp."""
        by_child = {stamped.child_frame_id: stamped.transform for stamped in message.transforms}
        at = message.transforms[0].header.stamp
        stamp: int = at.sec * 10**9 + at.nanosec
        self._poses[stamp] = {child: _pose(by_child[child]) for child in self._moving}
        self._stamps.append(stamp)
        if self._stamps[0] < stamp - HISTORY_NS:
            self._poses.pop(self._stamps.popleft(), None)
        if len(self._known) < len(self._links):
            self._known.update(by_child)
        return stamp

    def pose(self, stamp: int) -> Pose:
        """The pose of the tip in the base. Raises KeyError if an edge is unknown at that stamp."""
        moving, statics = self._poses[stamp], self._statics
        return compose([moving[child] if child in moving else statics[child] for child in self._path])

    def has_pose(self, stamp: int) -> bool:
        """Whether the pose at ``stamp`` is known; False until the static edges have arrived."""
        try:
            self.pose(stamp)
        except KeyError:
            return False
        return True

    def has_tree(self) -> bool:
        """Whether every link has been received."""
        return self._known >= self._links


def _pose(transform: Any) -> Pose:
    t, q = transform.translation, transform.rotation
    return (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
