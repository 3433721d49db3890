"""Path: the way between two frames, compiled once, evaluated at any instant.

A lookup searches once in each track it passes, reads only the joints on its way, and multiplies.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.cells import Between, Cell
from zstate.buffer.history import View
from zstate.buffer.steps import Motion, Step, Values, chain_motion, chain_pose
from zstate.buffer.tracks import JointTrack, Track, coverage, of_track
from zstate.errors import InFuture, InPast, LookupFailed, NoData, NotFinite, Stale
from zstate.transform import Kind, Transform

Stamps: TypeAlias = NDArray[np.int64]
ViewTaker: TypeAlias = Callable[[Sequence["TrackUse"]], list[View]]


class TrackUse(NamedTuple):
    """A track that the path passes: which of its cells, and the first of its edges on the way."""

    track: Track
    cells: tuple[Cell, ...]
    edge: tuple[str, str]


class Answer(NamedTuple):
    """What a path says: target_from_source as seven floats, when, and how that was found."""

    pose: se3.Pose
    stamp: int | None
    kind: Kind
    predicted_s: float = 0.0


class Reading(NamedTuple):
    """The values of all cells of a path at an instant, and how they were found."""

    values: list[list[se3.Component]]
    stamp: int
    kind: Kind
    predicted_ns: int


class Path:
    """From ``source`` to ``target`` by way of where their branches meet.

    ``domain`` is the clock domain of its moving edges, empty if none is known.
    """

    domain = ""

    def __init__(
        self,
        names: tuple[str, str],
        steps_to_target: Sequence[Step],
        steps_to_source: Sequence[Step],
        uses: Sequence[TrackUse],
        take_views: ViewTaker,
    ) -> None:
        self.target, self.source = names
        self.steps_to_target = steps_to_target
        self.steps_to_source = steps_to_source
        self.uses = tuple(uses)
        self.tracks = tuple(use.track for use in uses)
        self._take_views = take_views

    def at(self, stamp: object = None, /) -> Transform | None:
        """The answer where that is found at once; None where ``answer`` has to be asked."""

    def refuse(self, stamp: object, /) -> None:
        """Raise the reason where it is known at once that there is no answer at this moment."""

    def latest(self) -> int:
        """The newest instant that every moving edge knows [ns]. Raises NoData or Stale."""
        if not self.uses:
            raise NoData(self.target, self.source)
        return self._latest(self._take_views(self.uses))

    def answer(self, stamp: int | None, predict_ns: int = 0) -> Answer:
        """The pose at ``stamp``, or at the latest instant.

        Raises NoData, InPast, InFuture, Stale or NotFinite.
        """
        if not self.uses:
            return Answer(self._finite_pose((), stamp), stamp, "static")
        reading = self.read(stamp, predict_ns)
        pose = se3.normalize(self._finite_pose(reading.values, reading.stamp), se3.SCALARS)
        return Answer(pose, reading.stamp, reading.kind, reading.predicted_ns * 1e-9)

    def read(self, stamp: int | None, predict_ns: int = 0) -> Reading:
        """What the cells of each track say at ``stamp``, or at the latest instant. Raises as ``answer``."""
        views = self._take_views(self.uses)
        at = self._latest(views) if stamp is None else stamp
        kind: Kind = "exact"
        predicted_ns = 0
        values: list[list[se3.Component]] = []
        for use, view in zip(self.uses, views, strict=True):
            now = _between(view, at)
            if now is not None:
                values.append([cell.value(now) for cell in use.cells])
                kind = "interpolated" if now.seconds and kind == "exact" else kind
            else:
                ahead = self._ahead(use, view, at, predict_ns)
                if ahead is None:
                    raise self.blame(at, views, predict_ns)
                kind, predicted_ns = "predicted", max(predicted_ns, at - view.newest)
                values.append(ahead)
        return Reading(values, at, kind, predicted_ns)

    def motion(self, stamp: int | None) -> tuple[Motion, int | None]:
        """Pose and velocity of the source in the target. Raises as ``answer``, and NoData without a rate."""
        views = self._take_views(self.uses)
        at = stamp if stamp is not None or not self.uses else self._latest(views)
        values: list[list[se3.Component]] = []
        rates: list[list[se3.Component]] = []
        for use, view in zip(self.uses, views, strict=True):
            now = None if at is None else _between(view, at, moving=True)
            if now is None:
                raise self.blame(at or 0, views)
            values.append([cell.value(now) for cell in use.cells])
            rates.append([cell.rate(now) for cell in use.cells])
        if any(np.isnan(_numbers(cells)).any() for cells in rates):
            raise self._no_rate(views)
        above_target = chain_motion(self.steps_to_target, values, rates, se3.SCALARS)
        motion = above_target.inverse().then(chain_motion(self.steps_to_source, values, rates, se3.SCALARS))
        if not np.isfinite((*motion.linear, *motion.angular)).all():
            raise self.not_finite(values, at)
        return motion, at

    def poses(self, stamps: Stamps) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The pose at each stamp: (T, 7), NaN where it is not known, and (T,) where it is."""
        views = self._take_views(self.uses)
        valid = np.ones(len(stamps), dtype=np.bool_)
        for view in views:
            valid &= _within(view, stamps)
        known = stamps[valid]
        poses = np.full((len(stamps), 7), np.nan)
        if not len(known):
            return poses, valid
        with np.errstate(over="ignore", invalid="ignore"):
            values = [
                [cell.value(now) for cell in use.cells]
                for use, now in zip(self.uses, (_between_many(view, known) for view in views), strict=True)
            ]
            pose = se3.normalize(self._pose(values, se3.ARRAYS), se3.ARRAYS)
        found = np.stack(np.broadcast_arrays(*pose, known)[:7], axis=-1)
        found[~np.isfinite(found).all(axis=1)] = np.nan
        poses[valid] = found
        valid[valid] = ~np.isnan(found[:, 0])
        return poses, valid

    def stale(self, stamp: int | None, age_s: float, max_age_s: float) -> Stale:
        """The error for an answer that is too old, naming the edge that is most behind."""
        use = min(self.uses, key=lambda use: coverage(use.track.history.view).newest or 0)
        facts = coverage(use.track.history.view)
        failure = Stale(
            self.target,
            self.source,
            age_s=age_s,
            max_age_s=max_age_s,
            edge=use.edge,
            requested=stamp,
            oldest=facts.oldest,
            newest=facts.newest,
            rate_hz=facts.rate_hz,
            writer=use.track.writer,
        )
        return of_track(failure, use.track)

    def _silent(self, views: Sequence[View]) -> Stale:
        """The error for an edge whose last sample is older than all that another one keeps."""
        number = min(range(len(views)), key=lambda n: views[n].newest)
        other = max(range(len(views)), key=lambda n: views[n].oldest)
        use, facts = self.uses[number], coverage(views[number])
        failure = Stale(
            self.target,
            self.source,
            age_s=(views[other].newest - views[number].newest) * 1e-9,
            other=self.uses[other].edge,
            other_newest=views[other].newest,
            edge=use.edge,
            oldest=facts.oldest,
            newest=facts.newest,
            rate_hz=facts.rate_hz,
            writer=use.track.writer,
        )
        return of_track(failure, use.track)

    def blame(self, at: int, views: Sequence[View], predict_ns: int = 0) -> LookupFailed:
        """Which track cannot answer at ``at``: too young, then empty, then not there yet."""
        numbered = list(enumerate(views))
        too_young = [(view.oldest, n) for n, view in numbered if view.size and at < view.oldest]
        if too_young:
            return self._failure(InPast, max(too_young)[1], views, at)
        empty = [n for n, view in numbered if not view.size]
        if empty:
            return self._failure(NoData, empty[0], views, at)
        newest = [
            (view.newest, n)
            for n, view in numbered
            if at > view.newest and self._ahead(self.uses[n], view, at, predict_ns) is None
        ]
        failure = self._failure(InFuture, min(newest)[1], views, at)
        if predict_ns and at <= min(newest)[0] + predict_ns:
            failure.note = "it cannot be predicted: no velocity is known there"
        return failure

    def _failure(
        self, error: type[LookupFailed], number: int, views: Sequence[View], at: int | None
    ) -> LookupFailed:
        facts = coverage(views[number])
        return self._error(error, number, at, facts.oldest, facts.newest, facts.rate_hz)

    def _error(  # noqa: PLR0917 - what a failed lookup in a control loop costs
        self,
        error: type[LookupFailed],
        number: int,
        requested: int | None,
        oldest: int | None,
        newest: int | None,
        rate_hz: float | None,
    ) -> LookupFailed:
        use = self.uses[number]
        failure = error(
            self.target,
            self.source,
            edge=use.edge,
            requested=requested,
            oldest=oldest,
            newest=newest,
            rate_hz=rate_hz,
            writer=use.track.writer,
        )
        return of_track(failure, use.track)

    def _no_rate(self, views: Sequence[View]) -> LookupFailed:
        lonely = [number for number, view in enumerate(views) if view.size < 2]
        failure = self._failure(NoData, lonely[0] if lonely else 0, views, None)
        failure.note = "a rate of change needs two samples, or published velocities"
        return failure

    def _latest(self, views: Sequence[View]) -> int:
        for number, view in enumerate(views):
            if not view.size:
                raise self._failure(NoData, number, views, None)
        newest = min(view.newest for view in views)
        if any(view.oldest > newest for view in views):
            raise self._silent(views)
        return newest

    def _finite_pose(self, values: Values, at: int | None) -> se3.Pose:
        pose = self._pose(values, se3.SCALARS)
        if not all(map(math.isfinite, pose)):
            raise self.not_finite(values, at)
        return pose

    def not_finite(self, values: Values, at: int | None) -> NotFinite:
        """The error for numbers that are too large, naming the edge with the largest."""
        if not self.uses:
            return NotFinite(self.target, self.source, requested=at)
        sizes = [np.abs(_numbers(cells)).max(initial=0.0) for cells in values]
        views = [use.track.history.view for use in self.uses[: len(sizes)]]
        failure = self._failure(NotFinite, int(np.argmax(sizes)), views, at)
        assert isinstance(failure, NotFinite)
        return failure

    def _pose(self, values: Values, f: se3.Functions) -> se3.Pose:
        target_from_top = chain_pose(self.steps_to_target, values, f)
        source_from_top = chain_pose(self.steps_to_source, values, f)
        if not self.steps_to_target:
            return source_from_top
        return se3.compose(se3.invert(target_from_top), source_from_top)

    @staticmethod
    def _ahead(use: TrackUse, view: View, at: int, predict_ns: int) -> list[se3.Component] | None:
        """The cells' values beyond the newest sample, at their last rates; None where that cannot be."""
        if not view.size or not view.newest < at <= view.newest + predict_ns:
            return None
        now = _last_stretch(view, use)
        rates = [cell.rate(now) for cell in use.cells]
        if np.isnan(_numbers(rates)).any():
            return None
        seconds = (at - view.newest) * 1e-9
        return [
            cell.ahead(now.b, rate, seconds, se3.SCALARS)  # type: ignore[arg-type]
            for cell, rate in zip(use.cells, rates, strict=True)
        ]


def _numbers(cells: Sequence[se3.Component]) -> NDArray[np.float64]:
    """The values or rates of the cells of one track, all in one array; there may be none."""
    return np.concatenate([np.empty(0), *(np.ravel(cell) for cell in cells)])


def _row(view: View, index: int) -> list[float]:
    return view.rows[index].tolist()


def _between(view: View, at: int, *, moving: bool = False) -> Between | None:
    """The rows around ``at``; None outside of them. An exact hit is one row, unless ``moving``
    asks for a stretch of time to measure a rate on."""
    stamps, _, first, end = view
    index = first + int(stamps[first:end].searchsorted(at))
    if index == end:
        return None
    stamp = int(stamps[index])
    if stamp == at and not (moving and view.size > 1):
        row = _row(view, index)
        return Between(row, row, 0.0, 0.0, se3.SCALARS)
    if index == first:
        if stamp != at:
            return None
        index += 1
        stamp = int(stamps[index])
    before = int(stamps[index - 1])
    ratio = (at - before) / (stamp - before)
    return Between(_row(view, index - 1), _row(view, index), ratio, (stamp - before) * 1e-9, se3.SCALARS)


def _last_stretch(view: View, use: TrackUse) -> Between:
    """What the rates of a prediction are measured on: published at the newest row, or the last two."""
    last = _row(view, view.end - 1)
    if isinstance(use.track, JointTrack) or view.size < 2:
        return Between(last, last, 0.0, 0.0, se3.SCALARS)
    span_ns = int(view.stamps[view.end - 1] - view.stamps[view.end - 2])
    return Between(_row(view, view.end - 2), last, 1.0, span_ns * 1e-9, se3.SCALARS)


def _within(view: View, stamps: Stamps) -> NDArray[np.bool_]:
    if not view.size:
        return np.zeros(len(stamps), dtype=np.bool_)
    return (stamps >= view.oldest) & (stamps <= view.newest)


def _between_many(view: View, stamps: Stamps) -> Between:
    """The rows around each of ``stamps``, all of which the view covers; columns come first."""
    kept = view.kept_stamps()
    after = kept.searchsorted(stamps)
    exact = kept[after] == stamps
    before = np.where(exact, after, after - 1)
    span_ns = kept[after] - kept[before]
    ratio = np.where(exact, 0.0, (stamps - kept[before]) / np.where(exact, 1, span_ns))
    rows = view.kept_rows()
    return Between(rows[before].T, rows[after].T, ratio, span_ns * 1e-9, se3.ARRAYS)
