"""Moving edges that a bridge brings from one side to the other, under the names of their writers."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate.checks import Floats
from zstate.errors import Closed, InsertRefused, InvalidInput, SecondWriter, ZStateError
from zstate.model.robot import RobotModel
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import OdometryPublisher
from zstate.odometry.messages import Odometry
from zstate.transform import Transform
from zstate.wire.keys import full_name
from zstate.wire.measurements import covariance_matrix
from zstate.wire.messages import Edges, covariances_of, from_block, poses_from_block

P = TypeVar("P", TransformPublisher, OdometryPublisher)

RETRY_S = 2.0
"""Edges that another writer owns are tried again after this time: a try takes some round trips."""


def edge_writer_of_node(node: str) -> str:
    """The name under which zstate publishes the edges of a ROS node: ``/r1/ekf`` becomes ``r1.ekf``."""
    return node.strip("/").replace("/", ".")


class _Refusal(NamedTuple):
    """The reason and text of a refusal, and when its edges are tried again [s], by ``time.monotonic``."""

    reason: str
    text: str
    retry_at: float


class TransformRelay(Closeable):
    """Publishes moving edges of ``robot``, except those of its ``model``, for any number of writers.

    ``open_publisher(writer)`` opens the ``TransformPublisher`` of one writer, with its first edge, and
    ``open_odometry(writer)`` the ``OdometryPublisher`` of a writer of odometry.
    ``count_refusal(reason, text)`` is called for each sample that cannot be published, for instance because
    another writer of the robot owns one of its edges; the relay continues. Any thread may call the methods.
    """

    def __init__(
        self,
        robot: str,
        model: RobotModel,
        open_publisher: Callable[[str], TransformPublisher],
        count_refusal: Callable[[str, str], object],
        open_odometry: Callable[[str], OdometryPublisher] | None = None,
    ) -> None:
        self._robot = robot
        edges = [(joint.parent, joint.child) for joint in model.joints]
        # A link with a slash in its name has another name in ROS without a prefix.
        self._model_edges = {(f"{robot}/{parent}", f"{robot}/{child}") for parent, child in edges}
        self._model_edges |= {(full_name(robot, parent), full_name(robot, child)) for parent, child in edges}
        self._open_publisher, self._open_odometry = open_publisher, open_odometry
        self._count_refusal = count_refusal
        self._publishers: dict[str, TransformPublisher] = {}
        self._odometry: dict[str, OdometryPublisher] = {}
        self._published_at: dict[str, float] = {}
        self._kept: BoundedDict[Edges, tuple[int, ...]] = BoundedDict()
        self._refusals: BoundedDict[tuple[str, Edges], _Refusal] = BoundedDict()
        self._lock = threading.Lock()
        self._closed = False

    @property
    def writers(self) -> tuple[str, ...]:
        """The writers with an open publisher."""
        return (*self._publishers, *self._odometry)

    def publish(self, writer: str, edges: Edges, poses: Floats, stamp: int) -> bool:
        """Publish one sample of ``writer``; False if nothing of it is published.

        Row i of ``poses`` (n, 7) is ``parent_from_child`` of ``edges[i]``, named as in messages of the robot.
        Raises Closed.
        """

        def publish() -> bool:
            transforms = [Transform.from_pose7(*edges[row], poses[row]) for row in self._rows(edges)]
            if transforms:
                self._opened(self._publishers, self._open_publisher, writer).publish(transforms, stamp)
            return bool(transforms)

        return self._publish(writer, edges, publish)

    def publish_odometry(self, writer: str, sample: Odometry) -> bool:
        """Publish one sample of ``writer`` with its velocity and covariances; as ``publish``."""
        open_odometry, edges = self._open_odometry, sample.edges
        assert edges is not None
        if open_odometry is None:
            return self.publish(writer, edges, poses_from_block(sample.poses), sample.stamp)

        def publish() -> bool:
            if not self._rows(edges):
                return False
            ((parent, child),), twist = edges, from_block(sample.twist)
            transform = Transform.from_pose7(parent, child, poses_from_block(sample.poses)[0])
            if covariances_of(sample) is not None:
                assert sample.covariances is not None
                transform = transform.with_covariance(covariance_matrix(sample.covariances))
            triangle = sample.twist_covariance
            covariance = None if triangle is None else covariance_matrix(triangle)
            self._opened(self._odometry, open_odometry, writer).publish(
                transform, twist[:3], twist[3:], sample.stamp, twist_covariance=covariance
            )
            return True

        return self._publish(writer, edges, publish)

    def _publish(self, writer: str, edges: Edges, publish: Callable[[], bool]) -> bool:
        """Call ``publish`` unless these edges were refused lately; refusals are counted."""
        refused = self._refusals.get((writer, edges))
        if refused is not None and time.monotonic() < refused.retry_at:
            self._count_refusal(refused.reason, refused.text)
            return False
        try:
            is_published = publish()
        except Closed:
            raise
        except ZStateError as error:
            text = f"transforms of {writer!r}: {error}"
            if isinstance(error, InvalidInput) and not isinstance(error, InsertRefused):
                self._count_refusal("bad numbers", text)
                return False
            reason = error.reason if isinstance(error, InsertRefused) else "second writer"
            self._refusals[writer, edges] = _Refusal(reason, text, time.monotonic() + RETRY_S)
            if isinstance(error, SecondWriter) and error.edge is None:
                self.remove(writer)  # the other writer has its name
            self._count_refusal(reason, text)
            return False
        if is_published:
            self._published_at[writer] = time.monotonic()
        return is_published

    def remove(self, writer: str) -> None:
        """Close the publisher of a writer that has left."""
        with self._lock:
            publishers = self._publishers.pop(writer, None), self._odometry.pop(writer, None)
            self._published_at.pop(writer, None)
        for publisher in publishers:
            if publisher is not None:
                publisher.close()

    def remove_silent(self, longer_than_s: float) -> None:
        """Close the publishers of writers without a sample for this time: the next one opens them again."""
        before = time.monotonic() - longer_than_s
        for writer, published_at in list(self._published_at.items()):
            if published_at < before:
                self.remove(writer)

    def close(self) -> None:
        """Close all publishers. A second call does nothing."""
        with self._lock:
            self._closed = True
            for publishers in (self._publishers, self._odometry):
                while publishers:
                    publishers.popitem()[1].close()

    def _rows(self, edges: Edges) -> tuple[int, ...]:
        """The rows of the edges that are not those of the model."""
        rows = self._kept.get(edges)
        if rows is None:
            names = [tuple(full_name(self._robot, frame) for frame in edge) for edge in edges]
            rows = tuple(row for row, edge in enumerate(names) if edge not in self._model_edges)
            self._kept[edges] = rows
        return rows

    def _opened(self, publishers: dict[str, P], open_publisher: Callable[[str], P], writer: str) -> P:
        with self._lock:
            if self._closed:
                raise Closed("the bridge is closed")
            publisher = publishers.get(writer)
            if publisher is None:
                publisher = publishers[writer] = open_publisher(writer)
            return publisher
