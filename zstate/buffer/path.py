"""Paths between two frames: compiled once from the edges of the tree, evaluated at any stamp.

An evaluation searches once in each track of the path, reads only the joints on it, and multiplies. All
numbers of an answer come from one view of each track: its samples at one moment, whatever writers do since.
``TransformPath`` is the reference in Python. ``CompiledPath`` evaluates lookups in the C extension, which has
no formula for prediction and velocities: the reference computes those.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.frame_tree import Edge, TreePath
from zstate.buffer.history_view import HistoryView
from zstate.buffer.interpolation import (
    ContinuousAngleInterpolator,
    Interpolator,
    JointStep,
    LinearInterpolator,
    MovingPose,
    PoseInterpolator,
    PoseStep,
    StaticStep,
    Step,
    Values,
    bracket_at,
    brackets_at,
    chain_motion,
    chain_pose,
    newest_bracket,
)
from zstate.buffer.tracks import JointTrack, PoseTrack, Track, coverage
from zstate.checks import Points
from zstate.errors import InFuture, InPast, LookupFailed, NoData, NotFinite, Stale
from zstate.extension import kernel
from zstate.model.joint_forms import KINDS
from zstate.transform import Kind, Transform

if TYPE_CHECKING or kernel == "c":
    from zstate import _kernel

if TYPE_CHECKING:
    from zstate._kernel import NewerTransforms

F = TypeVar("F", bound=LookupFailed)

Stamps: TypeAlias = NDArray[np.int64]
Views: TypeAlias = Sequence[HistoryView]
ViewReader: TypeAlias = Callable[[Sequence[Track]], list[HistoryView]]
TransformPair: TypeAlias = tuple[Transform, Transform]
StepTuple: TypeAlias = tuple[int, int, int, bool, tuple[float, ...]]
"""A step as the extension takes it: kind, track, column, whether the angle is continuous, numbers."""

# In the order of the extension's Failure.
_FAILURES: tuple[type[LookupFailed], ...] = (InPast, NoData, InFuture)


class TrackUse(NamedTuple):
    """A track of a path, with the interpolators that read it and the first of its edges on the path."""

    track: Track
    interpolators: list[Interpolator]
    edge: tuple[str, str]


@dataclass(eq=False, repr=False)
class TransformPath:
    """A path, from the common ancestor of two frames down to each; ``uses`` are the tracks that it reads.

    ``domain`` is the clock domain of its moving edges, empty if none is known.
    """

    target: str
    source: str
    steps_to_target: Sequence[Step]
    steps_to_source: Sequence[Step]
    uses: Sequence[TrackUse]
    read_views: ViewReader
    domain: str = ""

    def __post_init__(self) -> None:
        self._tracks = tuple(use.track for use in self.uses)

    @property
    def without_covariances(self) -> TransformPath:
        """The path of the same transforms without their covariances."""
        return self

    def views(self) -> Views:
        """The views of all tracks at one moment."""
        return self.read_views(self._tracks)

    def at(self, stamp: object = None, /) -> Transform | None:
        """The transform, if it is found at once; None if ``transform`` has to be used."""

    def at_and_views(self, stamp: object = None, /) -> tuple[Transform, Views] | None:
        """As ``at``, with the views that the transform is computed from."""

    def at_both(self, stamp: object, other: TransformPath, other_stamp: object, /) -> TransformPair | None:
        """``at`` of this path and of another one, at one moment; None unless both are found at once."""

    def raise_if_outside(self, stamp: object, /) -> None:
        """Raises the reason why there is no transform now, if it is found at once."""

    def newer_than(self, stamp: int, version: int) -> NewerTransforms | None:
        """Each newest transform after ``stamp``, while the tree has this ``version``, if found at once."""

    def transform(self, stamp: int | None, predict_ns: int = 0) -> Transform:
        """The transform at ``stamp``, or the latest. Raises NoData, InPast, InFuture, Stale or NotFinite."""
        transform = self.at(stamp)
        if transform is not None:
            return transform
        if not predict_ns:
            self.raise_if_outside(stamp)
        return self.transform_in(self.views(), stamp, predict_ns)

    def transform_in(self, views: Views, stamp: int | None, predict_ns: int = 0) -> Transform:
        """The same of given views of the tracks."""
        if not self.uses:
            pose = self._finite_pose((), (), stamp)
            return Transform.trusted(self.target, self.source, pose, stamp, "static")
        values, at, kind, predicted_ns = self.read(views, stamp, predict_ns)
        pose = se3.normalize(self._finite_pose(views, values, at), se3.SCALARS)
        return Transform.trusted(self.target, self.source, pose, at, kind, predicted_ns * 1e-9)

    def latest_common_stamp(self) -> int:
        """The newest instant that every moving edge has reached [ns]. Raises NoData or Stale."""
        if not self.uses:
            raise NoData(self.target, self.source)
        return self._latest(self.views())

    def read(self, views: Views, stamp: int | None, predict_ns: int = 0) -> tuple[Values, int, Kind, int]:
        """The values of each track at ``stamp``, or at the latest instant. Raises as ``transform``.

        Also the stamp [ns], how the values were made, and how far they are predicted [ns].
        """
        at = self._latest(views) if stamp is None else stamp
        kind: Kind = "exact"
        predicted_ns = 0
        values: list[list[se3.Component]] = []
        for use, view in zip(self.uses, views, strict=True):
            now = bracket_at(view, at)
            if now is not None:
                values.append([one.value(now) for one in use.interpolators])
                kind = "interpolated" if now.seconds and kind == "exact" else kind
            else:
                predicted = self._extrapolate(use, view, at, predict_ns)
                if predicted is None:
                    raise self.failure_at(at, views, predict_ns)
                kind, predicted_ns = "predicted", max(predicted_ns, at - view.newest)
                values.append(predicted)
        return values, at, kind, predicted_ns

    def motion(self, stamp: int | None) -> tuple[MovingPose, int | None]:
        """Pose and velocity of the source in the target. Raises as ``transform``; NoData without rates."""
        views = self.views()
        at = stamp if stamp is not None or not self.uses else self._latest(views)
        values: list[list[se3.Component]] = []
        rates: list[list[se3.Component]] = []
        for use, view in zip(self.uses, views, strict=True):
            now = None if at is None else bracket_at(view, at, for_rate=True)
            if now is None:
                raise self.failure_at(at or 0, views)
            values.append([one.value(now) for one in use.interpolators])
            rates.append([one.rate(now) for one in use.interpolators])
        if any(np.isnan(_flat(numbers)).any() for numbers in rates):
            number = next((number for number, view in enumerate(views) if view.size < 2), 0)
            failure = self._failure(NoData, number, None, coverage(views[number]))
            failure.note = "a rate of change needs two samples, or published velocities"
            raise failure
        above_target = chain_motion(self.steps_to_target, values, rates, se3.SCALARS)
        motion = above_target.inverse().then(chain_motion(self.steps_to_source, values, rates, se3.SCALARS))
        if not np.isfinite((*motion.linear, *motion.angular)).all():
            raise self.not_finite(views, values, at)
        return motion, at

    def values_at(self, views: Views, stamps: Stamps) -> tuple[Values, NDArray[np.bool_]]:
        """The values of each track at the stamps that all of them cover, and (T,) which these are."""
        covered = np.ones(len(stamps), dtype=np.bool_)
        for view in views:
            covered &= (stamps >= view.oldest) & (stamps <= view.newest) if view.size else False
        known = stamps[covered]
        if not len(known):
            return [], covered
        brackets = (brackets_at(view, known) for view in views)
        with np.errstate(over="ignore", invalid="ignore"):
            values = [
                [one.value(now) for one in use.interpolators]
                for use, now in zip(self.uses, brackets, strict=True)
            ]
        return values, covered

    def poses(self, stamps: Stamps) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The pose at each stamp: (T, 7), NaN where it is not known, and (T,) where it is."""
        return self.poses_in(self.views(), stamps)

    def poses_in(self, views: Views, stamps: Stamps) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The same of given views of the tracks."""
        values, valid = self.values_at(views, stamps)
        poses = np.full((len(stamps), 7), np.nan)
        if not valid.any():
            return poses, valid
        with np.errstate(over="ignore", invalid="ignore"):
            pose = se3.normalize(self._pose(values, se3.ARRAYS), se3.ARRAYS)
        found = np.stack(np.broadcast_arrays(*pose, stamps[valid])[:7], axis=-1)
        found[~np.isfinite(found).all(axis=1)] = np.nan
        poses[valid] = found
        valid[valid] = ~np.isnan(found[:, 0])
        return poses, valid

    def place(self, points: Points, stamps: Stamps) -> tuple[Points, NDArray[np.bool_]]:
        """Points (N, 3) of the source in the target, by the pose at their own stamp, (N,), or (1,) of all.

        Also (N,) which are known; the others are NaN: rows without a pose, and points that are not finite.
        """
        return self.place_in(self.views(), points, stamps)

    def place_in(self, views: Views, points: Points, stamps: Stamps) -> tuple[Points, NDArray[np.bool_]]:
        """The same of given views of the tracks."""
        instants, rows = np.unique(stamps, return_inverse=True)
        found = self.poses_in(views, instants)[0][np.broadcast_to(rows, len(points))]
        x, y, z, *rotation = se3.unstack(found)
        px, py, pz = points.astype(np.float64).T
        with np.errstate(over="ignore", invalid="ignore"):
            dx, dy, dz = se3.rotate((*rotation,), (px, py, pz))
            placed = np.stack((x + dx, y + dy, z + dz), axis=-1).astype(points.dtype)
        valid = np.logical_and.reduce(np.isfinite(placed), axis=1)
        placed[~valid] = np.nan
        return placed, valid

    def stale(self, views: Views, stamp: int | None, age_s: float, max_age_s: float) -> Stale:
        """The error for a transform that is too old, naming the edge that is most behind."""
        covered = [coverage(view) for view in views]
        number = min(range(len(covered)), key=lambda n: covered[n].newest or 0)
        return self._failure(Stale, number, stamp, covered[number], age_s=age_s, max_age_s=max_age_s)

    def failure_at(self, at: int, views: Views, predict_ns: int = 0) -> LookupFailed:
        """The error of the limiting track: one that begins later, else an empty one, else one that ends."""
        numbered = list(enumerate(views))
        too_young = [(view.oldest, n) for n, view in numbered if view.size and at < view.oldest]
        if too_young:
            number = max(too_young)[1]
            return self._failure(InPast, number, at, coverage(views[number]))
        empty = [n for n, view in numbered if not view.size]
        if empty:
            return self._failure(NoData, empty[0], at, coverage(views[empty[0]]))
        newest = [
            (view.newest, n)
            for n, view in numbered
            if at > view.newest and self._extrapolate(self.uses[n], view, at, predict_ns) is None
        ]
        end, number = min(newest)
        failure = self._failure(InFuture, number, at, coverage(views[number]))
        if predict_ns and at <= end + predict_ns:
            failure.note = "it cannot be predicted: no velocity is known there"
        return failure

    def _failure(
        self, error: type[F], number: int, at: int | None, samples: Sequence[Any], **facts: Any
    ) -> F:
        """The error of track ``number``, whose ``samples`` begin as Coverage; ``facts`` are of its type."""
        track, _, edge = self.uses[number]
        oldest, newest, rate_hz = samples[:3]
        span = {"requested": at, "oldest": oldest, "newest": newest, "rate_hz": rate_hz}
        failure = error(self.target, self.source, edge=edge, writer=track.writer, **span, **facts)
        failure.track = track.name
        if track.owner is not None:
            failure.is_recorded = track.owner.is_recording
            measured = None if track.writer is None else track.owner.clock_offsets.get(track.writer)
            offset = None if measured is None else measured()
            if offset is not None:
                failure.clock_offset_ns, failure.clock_uncertainty_ns = offset
        return failure

    def _latest(self, views: Views) -> int:
        for number, view in enumerate(views):
            if not view.size:
                raise self._failure(NoData, number, None, coverage(view))
        newest = min(view.newest for view in views)
        begins_last = max(range(len(views)), key=lambda n: views[n].oldest)
        if views[begins_last].oldest > newest:
            # The last sample of one edge is older than all that another one keeps.
            number = min(range(len(views)), key=lambda n: views[n].newest)
            other, other_newest = self.uses[begins_last].edge, views[begins_last].newest
            age_s = (other_newest - newest) * 1e-9
            facts = {"age_s": age_s, "other": other, "other_newest": other_newest}
            raise self._failure(Stale, number, None, coverage(views[number]), **facts)
        return newest

    def _finite_pose(self, views: Views, values: Values, at: int | None) -> se3.Pose:
        pose = self._pose(values, se3.SCALARS)
        if not all(map(math.isfinite, pose)):
            raise self.not_finite(views, values, at)
        return pose

    def not_finite(self, views: Views, values: Values, at: int | None) -> NotFinite:
        """The error for numbers that are too large, naming the edge with the largest."""
        if not self.uses:
            return NotFinite(self.target, self.source, requested=at)
        sizes = [np.abs(_flat(numbers)).max(initial=0.0) for numbers in values]
        number = int(np.argmax(sizes))
        return self._failure(NotFinite, number, at, coverage(views[number]))

    def _pose(self, values: Values, f: se3.Backend) -> se3.Pose:
        target_from_top = chain_pose(self.steps_to_target, values, f)
        source_from_top = chain_pose(self.steps_to_source, values, f)
        if not self.steps_to_target:
            return source_from_top
        return se3.compose(se3.invert(target_from_top), source_from_top)

    @staticmethod
    def _extrapolate(
        use: TrackUse, view: HistoryView, at: int, predict_ns: int
    ) -> list[se3.Component] | None:
        """The values beyond the newest sample, at the last rates; None if that is not possible."""
        if not view.size or not view.newest < at <= view.newest + predict_ns:
            return None
        now = newest_bracket(view, has_rates=isinstance(use.track, JointTrack))
        rates = [one.rate(now) for one in use.interpolators]
        if np.isnan(_flat(rates)).any():
            return None
        seconds = (at - view.newest) * 1e-9
        return [
            one.extrapolate(now.b, rate, seconds, se3.SCALARS)  # type: ignore[arg-type]
            for one, rate in zip(use.interpolators, rates, strict=True)
        ]


def _flat(numbers: Sequence[se3.Component]) -> NDArray[np.float64]:
    """The values or rates of one track, all in one array; there may be none."""
    return np.concatenate([np.empty(0), *(np.ravel(number) for number in numbers)])


class CompiledPath(TransformPath):
    """The same results as ``TransformPath``, in a hundredth of the time."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._histories: tuple[Any, ...] = tuple(track.history for track in self._tracks)
        self._compiled = _kernel.Path(
            Transform,
            self.target,
            self.source,
            _step_tuples(self.steps_to_target, self.uses),
            _step_tuples(self.steps_to_source, self.uses),
            self._histories,
        )
        # An attribute of the instance: a method in between would cost a third of the whole lookup.
        self.at = self._compiled.at

    def at_and_views(self, stamp: object = None, /) -> tuple[Transform, Views] | None:
        found = self._compiled.at_with_windows(stamp)
        return None if found is None else (found[0], self._views_of(found[1]))

    def at_both(self, stamp: object, other: TransformPath, other_stamp: object, /) -> TransformPair | None:
        if not isinstance(other, CompiledPath):
            return None
        return self._compiled.at_both(stamp, other._compiled, other_stamp)

    def _views_of(self, windows: _kernel.Windows) -> Views:
        pairs = zip(self._histories, windows, strict=True)
        return [history.view_of(window) for history, window in pairs]

    def raise_if_outside(self, stamp: object, /) -> None:
        failure = self._compiled.failure_at(stamp)
        if failure is not None:
            kind, number, at, *samples = failure
            raise self._failure(_FAILURES[kind], number, at, samples)

    def newer_than(self, stamp: int, version: int) -> NewerTransforms:
        return _kernel.NewerTransforms(self._compiled, version, stamp)

    def poses(self, stamps: Stamps) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        poses, valid = np.empty((len(stamps), 7)), np.empty(len(stamps), np.bool_)
        windows = self._compiled.poses(stamps, poses, valid)
        if not valid.all():
            # Its order of operations may overflow where that of the reference, which raises, does not.
            poses[~valid], valid[~valid] = self.poses_in(self._views_of(windows), stamps[~valid])
        return poses, valid

    def place(self, points: Points, stamps: Stamps) -> tuple[Points, NDArray[np.bool_]]:
        placed, valid = np.empty_like(points, order="C"), np.empty(len(points), np.bool_)
        windows = self._compiled.place(points, stamps, placed, valid)
        rest = ~valid
        if rest.any():
            for numbers in points.T:  # in a fifth of the time of all(axis=1)
                rest &= np.isfinite(numbers)
        if rest.any():  # as in poses
            their_stamps = stamps if len(stamps) == 1 else stamps[rest]
            views = self._views_of(windows)
            placed[rest], valid[rest] = self.place_in(views, points[rest], their_stamps)
        return placed, valid


def compile_path(
    target: str, source: str, edges: TreePath, read_views: ViewReader, *, compiled: bool = True
) -> TransformPath:
    """The path over ``edges``; the reference if ``compiled`` is False or the extension cannot evaluate it."""
    by_track: dict[Track, TrackUse] = {}
    steps_to_target, steps_to_source = _steps(edges.to_target, by_track), _steps(edges.to_source, by_track)
    uses = tuple(by_track.values())
    kind = CompiledPath if compiled and kernel == "c" else TransformPath
    return kind(target, source, steps_to_target, steps_to_source, uses, read_views, edges.domain)


def _steps(edges: Sequence[Edge], uses: dict[Track, TrackUse]) -> list[Step]:
    """One step for each edge; consecutive static ones multiplied. Adds what they read to ``uses``."""
    steps: list[Step] = []
    for edge in edges:
        step = _step(edge, uses)
        last = steps[-1] if steps else None
        if isinstance(step, StaticStep) and isinstance(last, StaticStep):
            steps[-1] = StaticStep(se3.compose(last.constant, step.constant))
        else:
            steps.append(step)
    return steps


def _step(edge: Edge, uses: dict[Track, TrackUse]) -> Step:
    track = edge.track
    if track is None:
        return StaticStep(edge.pose)
    if isinstance(track, PoseTrack):
        form, interpolators = None, [PoseInterpolator(7 * edge.index)]
    else:
        form, interpolators = track.forms[edge.index], joint_interpolators(track, edge.index)
    known = uses.setdefault(track, TrackUse(track, [], edge.names)).interpolators
    if interpolators[0] not in known:
        known.extend(interpolators)
    place = (list(uses).index(track), known.index(interpolators[0]))
    if form is None or form.kind == "floating":
        return PoseStep(se3.IDENTITY if form is None else form.origin, *place)
    return JointStep(form, *place)


def joint_interpolators(track: JointTrack, index: int) -> list[Interpolator]:
    """The interpolators of the positions of ``track.model.joints[index]``."""
    form = track.forms[index]
    column, velocity = form.column, -1
    if track.history.width > track.position_count:
        velocity = track.position_count + form.velocity_column
    if form.kind == "floating":
        return [PoseInterpolator(column, velocity)]
    if form.kind == "planar":
        offsets = (0, 1, 2) if velocity >= 0 else (0, 0, 0)
        x, y, yaw = ((column + n, velocity + offsets[n]) for n in range(3))
        return [LinearInterpolator(*x), LinearInterpolator(*y), ContinuousAngleInterpolator(*yaw)]
    kind = ContinuousAngleInterpolator if track.is_continuous(index) else LinearInterpolator
    return [kind(column, velocity)]


def _step_tuples(steps: Sequence[Step], uses: Sequence[TrackUse]) -> tuple[StepTuple, ...]:
    """The steps for the extension, with each static pose multiplied into the moving step behind it."""
    tuples: list[StepTuple] = []
    before = se3.IDENTITY
    for step in steps:
        if isinstance(step, StaticStep):
            before = se3.compose(before, step.constant)
        else:
            one, kind = uses[step.use].interpolators[step.column], "floating"
            if isinstance(step, PoseStep):
                numbers = se3.compose(before, step.origin)
            else:
                kind, numbers = step.form.kind, step.form.numbers(before)
            is_angle = isinstance(one, ContinuousAngleInterpolator)
            tuples.append((KINDS.index(kind), step.use, one.column, is_angle, numbers))
            before = se3.IDENTITY
    if before != se3.IDENTITY or not tuples:
        tuples.append((0, 0, 0, False, before))
    return tuple(tuples)


def transforms_at_one_moment(
    first: TransformPath, first_at: int | None, second: TransformPath, second_at: int | None
) -> TransformPair:
    """The transforms of two paths, of one view of each track, without covariances.

    Raises as ``TransformPath.transform``, that of the first path before that of the second.
    """
    first, second = first.without_covariances, second.without_covariances
    both = first.at_both(first_at, second, second_at)
    if both is not None:
        return both
    tracks = tuple({use.track: None for path in (first, second) for use in path.uses})
    views = dict(zip(tracks, first.read_views(tracks), strict=True))
    transform = first.transform_in([views[use.track] for use in first.uses], first_at)
    return transform, second.transform_in([views[use.track] for use in second.uses], second_at)
