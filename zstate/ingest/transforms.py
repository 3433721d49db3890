"""Ingest of transforms that publishers computed: moving ones, static ones, and a filter for known models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from zstate._util.bounded import BoundedDict
from zstate.clock import SET_BACK_NS
from zstate.errors import InsertRefused, InvalidInput
from zstate.ingest.base import ClockSetBack, StreamIngest
from zstate.ingest.frame_ownership import CONTESTED, Admitted, EdgeSource, FrameOwnership
from zstate.transform import Transform
from zstate.wire.keys import MODEL_WRITER, EdgeNames, full_name
from zstate.wire.messages import (
    Edges,
    RobotDescription,
    Sample,
    StaticTransforms,
    TransformSample,
    WriterTransforms,
    covariances_of,
    order_digest,
    poses_from_block,
)

# Limit of the edges in the caches of one writer: it may shuffle its edges from sample to sample.
_MAX_CACHED_EDGES = 100_000


class TransformIngest(StreamIngest):
    """Inserts transform samples as poses of edges; needs no model."""

    def __init__(
        self, robot: str, ownership: FrameOwnership, on_set_back: ClockSetBack | None = None
    ) -> None:
        super().__init__(robot, ownership, on_set_back)
        # The newest stamp [ns], in a list that is updated, by the digest of a sample's edges. ``_newest`` is
        # not used here.
        self._newest_by_order: BoundedDict[bytes, list[int]] = BoundedDict()
        self._edges: Edges = ()
        self._order = b""
        self._described = EdgeSource(robot, "", is_model=True)
        self._undescribed = EdgeSource(robot, "")
        # By the edges that samples name: their full names, and which of those are admitted.
        self._full_names: BoundedDict[Edges, Edges] = BoundedDict()
        self._cached_edges = 0
        self._admitted: BoundedDict[Edges, Admitted] = BoundedDict()
        # The full names of edges that are all admitted, by their digest: nearly all samples.
        self._all_admitted: BoundedDict[bytes, Edges] = BoundedDict()
        self._version = -1
        # Whether samples have no edges but those of models, by their digest.
        self._repeats: BoundedDict[bytes, bool] = BoundedDict()
        self._model_edges = ownership.model_edges

    def describe(self, description: RobotDescription) -> None:
        self.has_data = True
        self._set_domain(description)
        with self._lock:
            order = order_digest(description.moving_edges)
            if order == self._order:
                return
            try:
                edges = self._named(description.moving_edges)
            except InvalidInput as error:
                self._counters.count_refusal("robot description", str(error))
                return
            self._release(self._described)
            self._edges, self._order = edges, order
            self._ownership.add_description(self.robot)
            self._feed.domain.assign(self.robot, (child for _, child in edges))
            self._insert_early()

    def _named(self, edges: Edges) -> Edges:
        return tuple((full_name(self.robot, parent), full_name(self.robot, child)) for parent, child in edges)

    def _insert_counted(self, sample: Sample, *, is_in_order: bool) -> bool | None:
        if self._repeats_models(sample):
            return False  # what the joint states give again is neither received nor late
        return super()._insert_counted(sample, is_in_order=is_in_order)

    def _repeats_models(self, sample: Sample) -> bool:
        """Whether all edges of a sample are those of models, which compute them."""
        model_edges = self._ownership.model_edges
        if not model_edges:
            return False
        if self._model_edges is not model_edges:
            self._model_edges = model_edges
            self._repeats.clear()
        repeats = self._repeats.get(sample.order)
        if repeats is None:
            assert isinstance(sample, TransformSample)
            repeats = False
            with suppress(InvalidInput):  # a name that is refused and counted when it is inserted
                repeats = self._ownership.repeats_models(self._named(sample.edges or ()))
            self._repeats[sample.order] = repeats
        return repeats

    def _insert(self, sample: Sample) -> bool | None:
        assert isinstance(sample, TransformSample)
        covariances = sample.covariances if isinstance(sample, WriterTransforms) else None
        if self._version == self._ownership.version and covariances is None:
            edges = self._all_admitted.get(sample.order)
            if edges is not None:
                try:
                    return self._buffer.insert_many(edges, sample.stamp, sample.poses, writer=self.writer)
                except InsertRefused:
                    self._all_admitted.clear()  # it is decided again below
        edges, source = self._edges, self._described
        if sample.edges is not None:
            edges, source = self._named_edges(sample.edges), self._undescribed
        elif sample.order != self._order:
            return None
        if not edges:
            return True  # a robot without moving parts
        admitted = self._admit(source, edges)
        try:
            return self._insert_admitted(sample, edges, admitted)
        except InsertRefused as error:
            if error is admitted.refusal or error.reason not in CONTESTED:
                raise
        # The buffer holds a conflicting edge that was not compared yet.
        self._ownership.resolve_edges(edges)
        return self._insert_admitted(sample, edges, self._admit(source, edges))

    def _insert_past(self, samples: Sequence[Sample]) -> int:
        past: list[tuple[Edges, int, NDArray[np.float64], NDArray[np.float64] | None]] = []
        for sample in samples:
            assert isinstance(sample, TransformSample)
            edges = self._all_admitted.get(sample.order) if self._version == self._ownership.version else None
            if edges is None:
                break
            past.append((edges, sample.stamp, poses_from_block(sample.poses), covariances_of(sample)))
        return self._feed.insert_past_poses(past, self.writer)

    def _named_edges(self, names: Edges) -> Edges:
        edges = self._full_names.get(names)
        if edges is None:
            self._cached_edges += len(names)
            if self._cached_edges > _MAX_CACHED_EDGES:
                self._clear_cached_edges()
            edges = self._full_names[names] = self._named(names)
            new = {child for _, child in edges} - {child for _, child in self._undescribed.claims}
            self._ownership.replace_departed(self._undescribed, new)
            self._feed.domain.assign(self.robot, new)
        return edges

    def _admit(self, source: EdgeSource, edges: Edges) -> Admitted:
        """The admitted rows of ``edges``, decided again if the decision may have changed."""
        if self._version == self._ownership.version:
            known = self._admitted.get(edges)
            if known is not None:
                return known
        source.name, source.session = self.writer or "an unannounced writer", self.session or 0
        admitted = self._ownership.admit(source, edges)
        if self._version != self._ownership.version:
            self._admitted.clear()
            self._all_admitted.clear()
            self._version = self._ownership.version
        self._admitted[edges] = admitted
        return admitted

    def _insert_admitted(self, sample: TransformSample, edges: Edges, admitted: Admitted) -> bool:
        if admitted.refusal is not None:
            if not admitted.rows:
                raise admitted.refusal.with_traceback(None)  # it is raised for each sample
            self._count_refusal(admitted.refusal)
        elif admitted.rows is None:
            self._all_admitted[sample.order] = edges
        elif not admitted.rows:
            return True  # a model has all of them by now
        poses = poses_from_block(sample.poses)
        covariances = covariances_of(sample)
        if admitted.rows is not None:
            rows = list(admitted.rows)
            edges, poses = tuple(edges[row] for row in rows), poses[rows]
            covariances = None if covariances is None else covariances[rows]
        return self._buffer.insert_many(
            edges, sample.stamp, poses, covariances=covariances, writer=self.writer
        )

    def _advance(self, sample: Sample) -> bool:
        # One writer may stamp one edge later than another, for instance one from a slow camera.
        newest = self._newest_by_order.get(sample.order)
        if newest is None:
            self._newest_by_order[sample.order] = [sample.stamp]
            return False
        if sample.stamp >= newest[0]:
            newest[0] = sample.stamp
            return False
        return sample.stamp < newest[0] - SET_BACK_NS

    def _newest_of(self, sample: Sample) -> int | None:
        newest = self._newest_by_order.get(sample.order)
        return None if newest is None else newest[0]

    def _set_newest(self, order: bytes, stamp: int) -> None:
        self._newest_by_order[order] = [stamp]

    def _fast_place(self, sample: Sample) -> Edges | None:
        if self._version != self._ownership.version:
            return None
        if isinstance(sample, WriterTransforms) and sample.covariances is not None:
            return None
        if type(sample) not in (TransformSample, WriterTransforms):
            return None  # a plugin's has further numbers, which change as well
        return self._all_admitted.get(sample.order)

    def _drop_history(self) -> None:
        self._newest_by_order.clear()
        self._release(self._described)
        self._release(self._undescribed)

    def _release(self, source: EdgeSource) -> None:
        self._ownership.release(source)
        self._clear_cached_edges()

    def _clear_cached_edges(self) -> None:
        self._full_names.clear()
        self._admitted.clear()
        self._all_admitted.clear()
        self._cached_edges = 0

    def _may_restart_epoch(self) -> bool:
        return not any(map(self._ownership.others_move, (self._described, self._undescribed)))


class StaticTransformIngest:
    """Keeps exactly the static edges that one writer publishes now in a buffer.

    ``children`` are the child frames of these edges, refused ones included. ``is_model`` marks the edges of
    the robot's model.
    """

    def __init__(self, robot: str, writer: str, ownership: FrameOwnership, *, is_model: bool = False) -> None:
        self.children: frozenset[str] = frozenset()
        self._ownership = ownership
        self._source = EdgeSource(robot, writer, is_model=is_model)

    def name_writer(self, writer: str) -> None:
        """Set the printed name of the writer, if it is announced later than its edges."""
        self._ownership.rename(self._source, writer)

    def replace(self, statics: StaticTransforms) -> None:
        """Insert these edges; withdraw earlier ones that are missing or have another parent."""
        self._source.session = statics.session
        edges = self._edges(statics)
        self.children = frozenset(child for _, child in edges)
        self._ownership.set_statics(self._source, edges)

    def add(self, statics: StaticTransforms) -> None:
        """Insert these edges and keep the earlier ones: in ROS no static edge is ever withdrawn."""
        self._source.session = statics.session
        self._ownership.set_statics(self._source, self._edges(statics), adds=True)

    def withdraw(self) -> None:
        """Withdraw all of this writer's edges."""
        self.children = frozenset()
        self._ownership.withdraw_statics(self._source)

    def _edges(self, statics: StaticTransforms) -> dict[EdgeNames, Transform]:
        edges: dict[EdgeNames, Transform] = {}
        robot = self._source.robot
        for names, pose in zip(statics.edges, poses_from_block(statics.poses), strict=True):
            reason = "frame name"
            try:
                parent, child = (full_name(robot, frame) for frame in names)
                reason = "bad numbers"
                edges[parent, child] = Transform.from_pose7(parent, child, pose)
            except InvalidInput as error:
                text = f"static edge of {self._source.name!r}: {error}"
                self._ownership.counters.for_robot(robot).count_refusal(reason, text)
        return edges


class StaticTransformIngests:
    """The static edges of all writers, each of which replaces or withdraws its own.

    ``on_children(robot, writer, children)`` is called with the child frames of a named writer when it
    publishes.
    """

    def __init__(
        self, ownership: FrameOwnership, on_children: Callable[[str, str, frozenset[str]], None]
    ) -> None:
        self._ownership = ownership
        self._on_children = on_children
        self._ingests: dict[tuple[str, int], StaticTransformIngest] = {}

    def insert(self, key: str, robot: str, writer: str | None, statics: StaticTransforms) -> None:
        """Insert edges received on ``key``; ``writer`` is the name in it, None in ROS."""
        if writer is not None:
            ingest = self._ingest(key, robot, writer)
            ingest.replace(statics)
            self._on_children(robot, writer, ingest.children)
        else:
            # A ROS node that is not announced yet is identified by its number.
            session = statics.session
            name = self._ownership.live.get((robot, session), f"a ROS node {session:016x}")
            self._ingest(key, robot, name, session).add(statics)

    def withdraw(self, key: str, robot: str, writer: str) -> None:
        """Withdraw all edges received on ``key``."""
        self._ingest(key, robot, writer).withdraw()
        self._ingests.pop((key, 0), None)
        self._on_children(robot, writer, frozenset())

    def name_writer(self, session: int, name: str) -> None:
        """Set the printed name of a ROS node, whose edges may arrive before its token."""
        for (_, other), ingest in list(self._ingests.items()):
            if other == session:
                ingest.name_writer(name)

    def _ingest(self, key: str, robot: str, writer: str, session: int = 0) -> StaticTransformIngest:
        ingest = StaticTransformIngest(robot, writer, self._ownership, is_model=writer == MODEL_WRITER)
        return self._ingests.setdefault((key, session), ingest)
