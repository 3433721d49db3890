"""Paths whose samples have covariances: the covariance of each transform, composed along the path.

Static edges and the joints of a model, as exact as their positions, add nothing. Every other moving edge adds
its own covariance, carried to the source's origin (``carry_covariance``); their errors are taken as
independent. If one of these edges has none, that of the transform is not known: unknown is not zero. Between
two samples a covariance is interpolated linearly, which keeps it positive semidefinite. A prediction has
none, because nothing states how fast its error grows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate import se3
from zstate.buffer.interpolation import Bracket, PoseStep, Step, bracket_at, chain_pose
from zstate.buffer.path import Stamps, TransformPath, Views
from zstate.buffer.tracks import PoseTrack
from zstate.checks import Points, real_numbers
from zstate.covariance import carry_covariance
from zstate.errors import InsertRefused, InvalidInput
from zstate.transform import COVARIANCE_NUMBERS, UPPER_TRIANGLE, PoseWithCovariance, Transform

# The places of the six variances in an upper triangle, row by row.
_VARIANCES = [0, 6, 11, 15, 18, 20]


class CovariancePath(TransformPath):
    """The path ``path``, each of whose moving edges is of a model, or has samples with covariances."""

    def __init__(self, path: TransformPath) -> None:
        super().__init__(
            path.target,
            path.source,
            path.steps_to_target,
            path.steps_to_source,
            path.uses,
            path.read_views,
            path.domain,
        )
        self._path = path
        self._chains = [
            [(step, self._covariance_place(step)) for step in steps]
            for steps in (path.steps_to_target, path.steps_to_source)
        ]

    def _covariance_place(self, step: Step) -> tuple[int, slice] | None:
        """The track of the step's covariance, and its columns there; None for an exact one."""
        if not isinstance(step, PoseStep):
            return None
        track, interpolators, _ = self.uses[step.use]
        if not isinstance(track, PoseTrack):  # a floating joint
            return None
        return step.use, track.covariance_columns(interpolators[step.column].column // 7)

    def at(self, stamp: object = None, /) -> Transform | None:
        found = self._path.at_and_views(stamp)
        return None if found is None else self._with_covariance(*found)

    @property
    def without_covariances(self) -> TransformPath:
        return self._path

    def transform_in(self, views: Views, stamp: int | None, predict_ns: int = 0) -> Transform:
        return self._with_covariance(self._path.transform_in(views, stamp, predict_ns), views)

    def raise_if_outside(self, stamp: object, /) -> None:
        self._path.raise_if_outside(stamp)

    def poses(self, stamps: Stamps) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        return self._path.poses(stamps)

    def place(self, points: Points, stamps: Stamps) -> tuple[Points, NDArray[np.bool_]]:
        return self._path.place(points, stamps)

    def _with_covariance(self, transform: Transform, views: Views) -> Transform:
        """The transform with its covariance, which is computed when it is used; without one if unknown."""
        brackets: list[Bracket] = []
        for view in views:
            now = bracket_at(view, transform.stamp)
            if now is None:  # predicted
                return transform
            brackets.append(now)
        for _, place in chain(*self._chains):
            if place is not None and _is_unknown(brackets[place[0]], place[1]):
                return transform
        return PoseWithCovariance.of_pose(transform, partial(self._triangle, brackets))

    def _triangle(self, brackets: Sequence[Bracket]) -> Sequence[float]:
        """The upper triangle of the covariance between the samples ``brackets`` of the tracks."""
        values = [
            [one.value(now) for one in use.interpolators]
            for use, now in zip(self.uses, brackets, strict=True)
        ]
        target_from_top = se3.invert(chain_pose(self.steps_to_target, values, se3.SCALARS))
        source_x, source_y, source_z, *_ = self._pose(values, se3.SCALARS)
        total = np.zeros((6, 6))
        for steps in self._chains:
            target_from_parent = target_from_top
            for step, place in steps:
                target_from_child = se3.compose(target_from_parent, step.pose(values, se3.SCALARS))
                if place is not None:
                    x, y, z, *_ = target_from_child
                    arm = (source_x - x, source_y - y, source_z - z)
                    covariance = _interpolated(brackets[place[0]], place[1])
                    total += carry_covariance(covariance, target_from_parent[3:], arm)
                target_from_parent = target_from_child
        return total[UPPER_TRIANGLE].tolist()


def _is_unknown(now: Bracket, columns: slice) -> bool:
    return math.isnan(sum(now.a[columns]) + sum(now.b[columns]))


def _interpolated(now: Bracket, columns: slice) -> NDArray[np.float64]:
    """The covariance of an edge between its two samples: (6, 6)."""
    before, after = np.array(now.a[columns]), np.array(now.b[columns])
    matrix = np.empty((6, 6))
    matrix[UPPER_TRIANGLE] = matrix.T[UPPER_TRIANGLE] = (1.0 - now.ratio) * before + now.ratio * after
    return matrix


def check_covariances(edges: Sequence[tuple[str, str]], covariances: ArrayLike) -> NDArray[np.float64]:
    """``covariances`` as (N, 21). Raises InvalidInput or InsertRefused for a variance that cannot be one."""
    array = real_numbers(covariances, "covariances")
    if array.shape != (len(edges), COVARIANCE_NUMBERS):
        raise InvalidInput(
            f"{len(edges)} edges take covariances of shape ({len(edges)}, {COVARIANCE_NUMBERS}), the upper "
            f"triangles row by row; got {array.shape}"
        )
    # NaN is not below zero: it marks a covariance that is not known.
    is_wrong = (array[:, _VARIANCES] < 0.0).any(axis=1) | np.isinf(array).any(axis=1)
    if is_wrong.any():
        first = int(is_wrong.argmax())
        parent, child = edges[first]
        raise InsertRefused(
            f"{parent!r} -> {child!r}: variances are finite and not negative; got "
            f"{array[first, _VARIANCES].tolist()}",
            reason="not a covariance",
            edge=(parent, child),
        )
    return array
