"""Plan: a question asked over and over. Compiled once, and again when the tree has changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate import se3
from zstate.buffer.cells import Cell, Line, Pose7, Turn
from zstate.buffer.compiled import make_path
from zstate.buffer.edge import Edge
from zstate.buffer.path import Path, TrackUse, ViewTaker
from zstate.buffer.steps import Fixed, Given, Hinge, Planar, Slide, Step
from zstate.buffer.tracks import JointTrack, PoseTrack, Track
from zstate.buffer.tree import Tree
from zstate.clock import check_stamp, check_stamps
from zstate.errors import ClockMismatch, InvalidInput
from zstate.transform import Transform


class Plan:
    """``target_from_source`` at any instant: what ``buffer.lookup`` does, without looking names up.

    Made by ``TransformBuffer.plan``; follows the buffer when frames are added or withdrawn.
    """

    def __init__(self, target: str, source: str, tree: Tree, current_path: Callable[[], Path]) -> None:
        self.target = target
        self.source = source
        self._tree = tree
        self._current_path = current_path
        self._known = tree.version, current_path()

    def __repr__(self) -> str:
        return f"<plan of {self.source!r} in {self.target!r}>"

    def at(self, stamp: int | None = None) -> Transform:
        """The transform at ``stamp`` [ns], or at the newest common instant. Never predicts.

        Raises LookupFailed as ``TransformBuffer.lookup`` does.
        """
        version, path = self._known
        if version != self._tree.version:
            # The version is asked first: a path that is newer than it says is made again, never kept.
            self._known = self._tree.version, self._current_path()
            path = self._known[1]
        transform = path.at(stamp)
        if transform is not None:
            return transform
        return transform_of(path, None if stamp is None else check_stamp(stamp))

    def poses(self, stamps: ArrayLike, out: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """pose7 at each of ``stamps``: (T, 7), written into ``out`` when given.

        Raises LookupFailed for the first stamp that has no answer; ``out`` is then left alone.
        """
        instants = check_stamps(stamps)
        if out is not None and (out.shape != (len(instants), 7) or out.dtype != np.float64):
            raise InvalidInput(f"out must be ({len(instants)}, 7) float64; got {out.shape} {out.dtype}")
        path = self._current_path()
        poses, valid = path.poses(instants)
        while not valid.all():
            # Asked alone, the first stamp without an answer raises its own reason, unless that has
            # arrived meanwhile.
            path.answer(int(instants[valid.argmin()]))
            poses, valid = path.poses(instants)
        if out is None:
            return poses
        out[...] = poses
        return out


def transform_of(path: Path, at: int | None, predict_ns: int = 0) -> Transform:
    """A path's answer, with the names it was asked by."""
    transform = path.at(at)
    if transform is not None:
        return transform
    answer = path.answer(at, predict_ns)
    return Transform.trusted(path.target, path.source, *answer)


def compile_path(tree: Tree, target: str, source: str, take_views: ViewTaker) -> Path:
    """The way between two frames as steps, static edges multiplied out. Raises LookupFailed."""
    to_target, to_source = tree.path(target, source)
    uses = _Uses()
    steps_to_target = _steps(to_target, uses)
    steps_to_source = _steps(to_source, uses)
    domain = _common_domain(tree, target, source, [*to_target, *to_source])
    path = make_path((target, source), steps_to_target, steps_to_source, uses.done(), take_views)
    path.domain = domain
    return path


def _common_domain(tree: Tree, target: str, source: str, edges: Sequence[Edge]) -> str:
    """The clock domain of all moving edges; empty if none is known. Raises ClockMismatch for two."""
    first: Edge | None = None
    for edge in edges:
        if edge.track is not None and (domain := tree.domain.of_edge(edge)):
            if first is None:
                first = edge
            elif domain != (known := tree.domain.of_edge(first)):
                raise ClockMismatch(
                    target,
                    source,
                    edges=(first.names, edge.names),
                    robots=(tree.domain.robot_of(first), tree.domain.robot_of(edge)),
                    domains=(known or "", domain),
                )
    return "" if first is None else tree.domain.of_edge(first) or ""


def joints_path(track: JointTrack, take_views: ViewTaker) -> Path:
    """A path of no steps that reads every joint of a robot, for questions about all of it."""
    joints = list(enumerate(track.model.joints))
    cells = [cell for index, joint in joints if joint.driven for cell in _joint_cells(track, index)]
    edge = next((track.edge(track.forms[index]) for index, joint in joints if joint.driven), None)
    root = track.frame(track.model.root)
    return Path((root, root), (), (), [TrackUse(track, tuple(cells), edge or (root, root))], take_views)


class _Uses:
    """The tracks of a path and the cells it reads of each, in the order they are met."""

    def __init__(self) -> None:
        self._tracks: list[Track] = []
        self._edges: list[tuple[str, str]] = []
        self._cells: list[list[Cell]] = []

    def add(self, edge: Edge, track: Track, cells: Sequence[Cell]) -> tuple[int, int]:
        """Where the first of ``cells`` is found: index of the track, index among its cells."""
        if track not in self._tracks:
            self._tracks.append(track)
            self._edges.append(edge.names)
            self._cells.append([])
        use = self._tracks.index(track)
        known = self._cells[use]
        if cells[0] not in known:
            known.extend(cells)
        return use, known.index(cells[0])

    def done(self) -> list[TrackUse]:
        parts = zip(self._tracks, self._cells, self._edges, strict=True)
        return [TrackUse(track, tuple(cells), edge) for track, cells, edge in parts]


def _steps(edges: Sequence[Edge], uses: _Uses) -> list[Step]:
    steps: list[Step] = []
    for edge in edges:
        step = _step(edge, uses)
        last = steps[-1] if steps else None
        if isinstance(step, Fixed) and isinstance(last, Fixed):
            steps[-1] = Fixed(se3.compose(last.constant, step.constant))
        else:
            steps.append(step)
    return steps


def _step(edge: Edge, uses: _Uses) -> Step:
    if edge.track is None:
        return Fixed(edge.pose)
    if isinstance(edge.track, PoseTrack):
        return Given(se3.IDENTITY, *uses.add(edge, edge.track, [Pose7(7 * edge.index)]))
    form = edge.track.forms[edge.index]
    place = uses.add(edge, edge.track, _joint_cells(edge.track, edge.index))
    if form.kind == "hinge":
        return Hinge(form, *place)
    if form.kind == "slide":
        return Slide(form, *place)
    if form.kind == "planar":
        return Planar(form, *place)
    return Given(form.origin, *place)


def _joint_cells(track: JointTrack, index: int) -> list[Cell]:
    form = track.forms[index]
    column, velocity = form.column, -1
    if track.has_velocities:
        velocity = track.model.position_count + form.velocity_column
    cubic = track.interpolation == "hermite"
    if form.kind == "floating":
        return [Pose7(column, velocity)]
    if form.kind == "planar":
        ahead = (0, 1, 2) if velocity >= 0 else (0, 0, 0)
        x, y, yaw = ((column + n, velocity + ahead[n], cubic) for n in range(3))
        return [Line(*x), Line(*y), Turn(*yaw)]
    return [(Turn if track.turns(index) else Line)(column, velocity, cubic)]
