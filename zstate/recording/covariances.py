"""Covariances of recorded poses, in messages of their own: /tf has no room for them.

Each edge with covariances has a topic ``pose_with_covariance/CHILD``, which RViz and Foxglove draw. Its
messages, geometry_msgs/PoseWithCovarianceStamped, are poses of CHILD in ``header.frame_id`` at the stamps of
the samples. Each precedes its sample in the file, and readers join the two by edge and stamp. The metadata
of the channel name the child frame, since the messages do not.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.recording.storage import EDGE_WRITER, Channel
from zstate.transform import UPPER_TRIANGLE
from zstate.wire.messages import (
    POSE_BYTES,
    Edges,
    TransformSample,
    WriterTransforms,
    covariances_of,
    from_block,
    to_block,
)
from zstate.wire.ros2.cdr import CdrReader, CdrWriter
from zstate.wire.ros2.types import POSE_WITH_COVARIANCE

CHILD_FRAME = "zstate.child_frame"
"""Channel metadata key of the frame that the poses of a channel place, as it is named in /tf."""

_POSE_NUMBERS = 7
_MATRIX_NUMBERS = 36
_UNKNOWN = np.full(len(UPPER_TRIANGLE[0]), np.nan)


class EdgeCovariance(NamedTuple):
    """The pose of one edge at ``stamp`` [ns], a block, and the upper triangle of its covariance, (21,)."""

    stamp: int
    parent: str
    child: str
    pose: bytes
    triangle: NDArray[np.float64]


def ros_name(name: str) -> str:
    """``name`` as a token of a ROS topic, where "arm-1" and "fleet/map" are no valid names."""
    return re.sub(r"\W|^(?=\d)", "_", name, flags=re.ASCII)


def covariance_topic(namespace: str, child: str) -> str:
    """The topic of the covariances of ``child``, for a robot in ``namespace`` ("" is the root)."""
    topic = f"/pose_with_covariance/{ros_name(child)}"
    return f"/{namespace}{topic}" if namespace else topic


def is_covariance_topic(topic: str) -> bool:
    """Whether ``topic`` is one of covariances, also in a file without metadata of ours."""
    return topic.rpartition("/")[0].endswith("/pose_with_covariance")


def child_frame(channel: Channel) -> str | None:
    """The child frame of a channel of covariances, as it is named in /tf; None for other channels."""
    if channel.type_name != POSE_WITH_COVARIANCE.name or EDGE_WRITER not in channel.metadata:
        return None
    return channel.metadata.get(CHILD_FRAME)


def known_covariances(message: TransformSample, edges: Edges) -> Iterator[EdgeCovariance]:
    """The covariances of a sample of ``edges`` that are known."""
    triangles = covariances_of(message)
    if triangles is None:
        return
    for row, ((parent, child), triangle) in enumerate(zip(edges, triangles, strict=True)):
        if not np.isnan(triangle).any():
            pose = message.poses[row * POSE_BYTES : (row + 1) * POSE_BYTES]
            yield EdgeCovariance(message.stamp, parent, child, pose, triangle)


def encode_covariance(covariance: EdgeCovariance) -> bytes:
    """The PoseWithCovarianceStamped, with names of ROS. Raises InvalidInput if CDR cannot represent it."""
    matrix = np.empty((6, 6))
    matrix[UPPER_TRIANGLE] = matrix.T[UPPER_TRIANGLE] = covariance.triangle
    writer = CdrWriter()
    writer.stamp(covariance.stamp)
    writer.text(covariance.parent)
    writer.numbers(covariance.pose + to_block(matrix))
    return writer.payload()


def decode_covariance(payload: bytes, child: str) -> EdgeCovariance:
    """The content of a PoseWithCovarianceStamped of ``child``, with names of ROS. Raises MessageError."""
    reader = CdrReader(payload, POSE_WITH_COVARIANCE.name)
    stamp, parent, pose = reader.stamp(), reader.text(), reader.numbers(_POSE_NUMBERS)
    matrix = from_block(reader.numbers(_MATRIX_NUMBERS)).reshape(6, 6)
    return EdgeCovariance(stamp, parent, child, pose, matrix[UPPER_TRIANGLE])


class CovarianceJoin:
    """Joins the samples of one writer with the covariances that precede them."""

    def __init__(self) -> None:
        self._newest: dict[tuple[str, str], EdgeCovariance] = {}

    def add(self, covariance: EdgeCovariance) -> None:
        """Keep a covariance for the next sample of its edge."""
        self._newest[covariance.parent, covariance.child] = covariance

    def join(self, sample: TransformSample) -> TransformSample:
        """``sample`` with the covariances of its edges at its stamp, if there are any."""
        edges = sample.edges or ()
        newest = [self._newest.get(edge) for edge in edges]
        rows = [None if one is None or one.stamp != sample.stamp else one.triangle for one in newest]
        if all(row is None for row in rows):
            return sample
        covariances = to_block([_UNKNOWN if row is None else row for row in rows])
        head = (sample.stamp, sample.seq, sample.session, sample.order)
        return WriterTransforms(*head, sample.poses, sample.edges, covariances)
