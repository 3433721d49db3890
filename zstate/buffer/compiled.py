"""CompiledPath: a path whose answers come from the C extension, and whose errors cost little.

What the extension has no formula for (cubic interpolation, prediction, velocities) stays with ``Path``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.cells import Turn
from zstate.buffer.path import Answer, Path, Stamps, TrackUse, ViewTaker
from zstate.buffer.steps import Fixed, Given, Hinge, Planar, Slide, Step
from zstate.errors import InFuture, InPast, LookupFailed, NoData
from zstate.extension import kernel
from zstate.transform import Transform

if TYPE_CHECKING or kernel == "c":
    from zstate import _kernel

# In the order of the extension's StepKind and Failure.
_KINDS = (Fixed, Hinge, Slide, Planar, Given)
_FAILURES: tuple[type[LookupFailed], ...] = (InPast, NoData, InFuture)

Numbers: TypeAlias = tuple[float, ...]
Description: TypeAlias = tuple[int, int, int, bool, Numbers]
"""A step as the extension wants it: kind, track, column, whether a continuous joint turns, numbers."""


def make_path(
    names: tuple[str, str],
    steps_to_target: Sequence[Step],
    steps_to_source: Sequence[Step],
    uses: Sequence[TrackUse],
    take_views: ViewTaker,
) -> Path:
    """A compiled path where there can be one, else the reference."""
    cubic = any(getattr(cell, "cubic", False) for use in uses for cell in use.cells)
    kind = Path if cubic or kernel == "reference" else CompiledPath
    return kind(names, steps_to_target, steps_to_source, uses, take_views)


class CompiledPath(Path):
    """The same answers as ``Path``, in a hundredth of the time."""

    def __init__(
        self,
        names: tuple[str, str],
        steps_to_target: Sequence[Step],
        steps_to_source: Sequence[Step],
        uses: Sequence[TrackUse],
        take_views: ViewTaker,
    ) -> None:
        super().__init__(names, steps_to_target, steps_to_source, uses, take_views)
        self._compiled = _kernel.Path(
            Transform,
            *names,
            _descriptions(steps_to_target, self.uses),
            _descriptions(steps_to_source, self.uses),
            tuple(use.track.history for use in uses),
        )
        # An attribute of the instance: a method in between would cost a third of the whole answer.
        self.at = self._compiled.at

    def answer(self, stamp: int | None, predict_ns: int = 0) -> Answer:
        if not predict_ns:
            self.refuse(stamp)
        return super().answer(stamp, predict_ns)

    def refuse(self, stamp: object, /) -> None:
        blamed = self._compiled.blame(stamp)
        if blamed is not None:
            raise self._error(_FAILURES[blamed[0]], *blamed[1:])

    def poses(self, stamps: Stamps) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        poses, valid = np.empty((len(stamps), 7)), np.empty(len(stamps), np.bool_)
        self._compiled.poses(stamps, poses, valid)
        if not valid.all():
            # Its order of operations may overflow where that of the reference, which raises, does not.
            poses[~valid], valid[~valid] = super().poses(stamps[~valid])
        return poses, valid


def _descriptions(steps: Sequence[Step], uses: Sequence[TrackUse]) -> tuple[Description, ...]:
    """The steps, with each static pose multiplied into the moving step behind it."""
    descriptions: list[Description] = []
    before = se3.IDENTITY
    for step in steps:
        if isinstance(step, Fixed):
            before = se3.compose(before, step.constant)
        else:
            descriptions.append(_description(step, before, uses))
            before = se3.IDENTITY
    if before != se3.IDENTITY or not descriptions:
        descriptions.append((0, 0, 0, False, before))
    return tuple(descriptions)


def _description(
    step: Hinge | Slide | Planar | Given, before: se3.Pose, uses: Sequence[TrackUse]
) -> Description:
    cells = uses[step.use].cells
    cell = cells[step.cell]
    return (_KINDS.index(type(step)), step.use, cell.column, isinstance(cell, Turn), _numbers(step, before))


def _numbers(step: Hinge | Slide | Planar | Given, before: se3.Pose) -> Numbers:
    if isinstance(step, Planar):
        return se3.compose(before, step.form.origin)
    if isinstance(step, Given):
        return se3.compose(before, step.origin)
    form = step.form
    placed = se3.compose(before, (*form.t0, *form.q_cos))
    if isinstance(step, Hinge):
        along = se3.multiply(before[3:], form.q_sin)
    else:
        along = se3.rotate(before[3:], form.t1)
    return (form.scale, form.shift, *placed[3:], *placed[:3], *along)
