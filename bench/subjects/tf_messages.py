"""The /tf and /tf_static messages of a state publisher, as CDR, and a reader of them; standard library only.

For systems without robot_state_publisher and tf2_ros, in whose environments this runs.
"""

from __future__ import annotations

import functools
import socket
import struct
from collections import deque
from collections.abc import Sequence
from typing import Any, TypeAlias

from bench.job import Job
from bench.motion_file import MotionFile
from bench.subjects.subject import Answered

Pose: TypeAlias = "tuple[float, ...]"
"""x y z qx qy qz qw."""

NO_STATE_PUBLISHER = (
    "it has no robot_state_publisher and no tf2_ros, because no wheels of them exist: the transforms of all "
    "moving edges are computed and serialized for each row before the run, and the writer only inserts the "
    "stamps; this favours it, because a state publisher receives, computes and sends another message",
    "the reader's buffer is a dict: of each message it keeps the edges between base and tip for 10 s and "
    "composes them in plain Python along a precomputed path: less work than tf2 does",
)
DOMAIN_VARIABLE = "BENCH_DDS_DOMAIN"
"""The environment variable that gives a worker its domain."""

STAMP = struct.Struct("<iI")
HISTORY_NS = 10_000_000_000
_LITTLE_ENDIAN = bytes((0, 1, 0, 0))
# The well-known ports of DDSI-RTPS: 7400 + 250 * domain. Above 101 they overlap Linux's ephemeral ports.
_FIRST_PORT, _PORTS_OF_A_DOMAIN, _DOMAINS = 7400, 250, 101


@functools.cache
def free_domain(ports: tuple[int, ...]) -> int:
    """A DDS domain without participants on this host; one per run, which owns ``ports``."""
    candidates = range(1, _DOMAINS + 1)
    begin = ports[0] % _DOMAINS
    return next(domain for domain in (*candidates[begin:], *candidates[:begin]) if _is_free(domain))


def _is_free(domain: int) -> bool:
    """Whether the first participant's port is free."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", _FIRST_PORT + _PORTS_OF_A_DOMAIN * domain + 10))
        except OSError:
            return False
    return True


class TfBytes:
    """TFMessages of one row each, serialized beforehand except for the stamps."""

    def __init__(self, job: Job) -> None:
        motion = MotionFile(job.motion)
        self._rows = [
            _pieces([(*edge, row[7 * n : 7 * n + 7]) for n, edge in enumerate(motion.edges)])
            for row in motion.rows()
        ]
        self.static = bytes(STAMP.size).join(_pieces(motion.statics))

    def message(self, row: int, stamp: int) -> bytes:
        """The message of all moving edges at ``stamp`` [ns]."""
        return STAMP.pack(*divmod(stamp, 10**9)).join(self._rows[row])


def _pieces(edges: Sequence[tuple[str, str, Sequence[float]]]) -> list[bytes]:
    """tf2_msgs/msg/TFMessage in little-endian CDR, cut at the stamps."""
    message, cuts = bytearray(struct.pack("<I", len(edges))), [0]
    for *names, pose in edges:
        message += bytes(STAMP.size)
        cuts.append(len(message))
        for name in names:
            message += bytes(-len(message) % 4)
            message += struct.pack("<I", len(name.encode()) + 1) + name.encode() + b"\0"
        message += bytes(-len(message) % 8) + struct.pack("<7d", *pose)
    ends = [cut - STAMP.size for cut in cuts[1:]] + [len(message)]
    pieces = [bytes(message[begin:end]) for begin, end in zip(cuts, ends, strict=True)]
    return [_LITTLE_ENDIAN + pieces[0], *pieces[1:]]


class TfReader:
    """The last 10 s of the edges between base and tip, from messages of any binding of ROS 2.

    Other edges are not kept, and the path from base to tip is computed beforehand: less work than a transform
    buffer does.
    """

    def __init__(self, job: Job, answered: Answered) -> None:
        self._answered = answered
        motion = MotionFile(job.motion)
        moving = {child for _, child in motion.edges}
        parents = {child: parent for parent, child, *_ in (*motion.edges, *motion.statics)}
        self._path = [job.tip]
        while parents[self._path[-1]] != job.base:
            self._path.append(parents[self._path[-1]])
        self._path.reverse()
        self._moving = [child for child in self._path if child in moving]
        self._links = set(job.links) - {job.base}
        self._known: set[str] = set()
        self._statics: dict[str, Pose] = {}
        self._poses: dict[int, dict[str, Pose]] = {}
        self._stamps: deque[int] = deque()

    def on_statics(self, message: Any) -> None:
        """Stores a message of /tf_static."""
        for stamped in message.transforms:
            self._statics[stamped.child_frame_id] = _pose(stamped.transform)
        self._known.update(self._statics)

    def on_transforms(self, message: Any) -> None:
        """Stores a message of /tf and answers at its stamp, if the static edges have arrived."""
        by_child = {stamped.child_frame_id: stamped.transform for stamped in message.transforms}
        at = message.transforms[0].header.stamp
        stamp: int = at.sec * 10**9 + at.nanosec
        self._poses[stamp] = {child: _pose(by_child[child]) for child in self._moving}
        self._stamps.append(stamp)
        if self._stamps[0] < stamp - HISTORY_NS:
            self._poses.pop(self._stamps.popleft(), None)
        if len(self._known) < len(self._links):
            self._known.update(by_child)
        try:
            self.pose(stamp)
        except KeyError:
            return
        self._answered(stamp)

    def pose(self, stamp: int, robot: int = 0) -> Pose:
        """The pose of the tip in the base. Raises KeyError if an edge is unknown at that stamp."""
        moving, statics = self._poses[stamp], self._statics
        edges = (moving[child] if child in moving else statics[child] for child in self._path)
        return functools.reduce(product, edges)

    def has_tree(self) -> bool:
        """Whether every link has been received."""
        return self._known >= self._links


def product(a: Pose, b: Pose) -> Pose:
    """``a_from_c`` of ``a_from_b`` and ``b_from_c``."""
    ax, ay, az, i, j, k, w = a
    x, y, z, bi, bj, bk, bw = b
    tx, ty, tz = 2 * (j * z - k * y), 2 * (k * x - i * z), 2 * (i * y - j * x)
    return (
        ax + x + w * tx + j * tz - k * ty,
        ay + y + w * ty + k * tx - i * tz,
        az + z + w * tz + i * ty - j * tx,
        w * bi + i * bw + j * bk - k * bj,
        w * bj - i * bk + j * bw + k * bi,
        w * bk + i * bj - j * bi + k * bw,
        w * bw - i * bi - j * bj - k * bk,
    )


def _pose(transform: Any) -> Pose:
    t, q = transform.translation, transform.rotation
    return (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
