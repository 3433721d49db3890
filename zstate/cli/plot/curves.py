"""Curves: numbers over time, from documents of joint states or from a buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from zstate._util.suggestions import did_you_mean
from zstate.cli.document_text import columns
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.buffer.buffer import TransformBuffer
    from zstate.cli.documents import Document
    from zstate.model.robot import RobotModel

_FEWEST, _MOST, _A_SECOND = 200, 5000, 200

# Whose numbers are one length or one angle.
_UNITS = {"revolute": "rad", "continuous": "rad", "prismatic": "m"}


@dataclass(frozen=True)
class Curves:
    """Column i of ``values`` (T, n) is called ``names[i]`` and has the unit ``units[i]``, empty for several.

    ``stamps`` [ns] ascend, (T,); where there is no value it is NaN.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    stamps: NDArray[np.int64]
    values: NDArray[np.float64]

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Since the first stamp [s]."""
        return (self.stamps - self.stamps[0]) * 1e-9

    def of_unit(self, unit: str) -> Curves:
        """Those with this unit."""
        return self._picked([place for place, own in enumerate(self.units) if own == unit])

    def chosen(self, joints: Sequence[str]) -> Curves:
        """Those of these joints, in that order; all for none. Raises InvalidInput for one there is not."""
        picks: list[int] = []
        for joint in joints:
            own = [n for n, name in enumerate(self.names) if name == joint or name.startswith(f"{joint}.")]
            if not own:
                raise InvalidInput(_no_joint(joint, self.names))
            picks += own
        return self._picked(picks) if joints else self

    def _picked(self, places: Sequence[int]) -> Curves:
        names = tuple(self.names[place] for place in places)
        units = tuple(self.units[place] for place in places)
        return replace(self, names=names, units=units, values=self.values[:, list(places)])


def joint_curves(documents: Sequence[Document], model: RobotModel | None) -> Curves:
    """The positions in ``documents``, of which there is one at least, in the order of their stamps."""
    rows = [(cast(int, one["stamp"]), columns(one["positions"])) for one in documents]
    rows.sort(key=lambda row: row[0])
    names = tuple(dict.fromkeys(name for _, row in rows for name in row))
    values = np.array([[row.get(name, np.nan) for name in names] for _, row in rows])
    types = {} if model is None else {joint.name: joint.type for joint in model.joints}
    units = tuple(_UNITS.get(types.get(name, "revolute" if model is None else ""), "") for name in names)
    return Curves(names, units, np.array([stamp for stamp, _ in rows], dtype=np.int64), values)


def path_curves(
    buffer: TransformBuffer, target: str, source: str, *, start_s: float = 0.0, seconds: float | None = None
) -> Curves:
    """The translation of ``source`` in ``target``, as far back as ``buffer`` knows it.

    From ``start_s`` after the first instant on; ``seconds`` long, or to the end; without a start the last
    ``seconds``. Raises LookupFailed, and InvalidInput when nothing is left of it.
    """
    newest = buffer.latest(target, source)
    oldest = _oldest(buffer, target, source, newest)
    begin = oldest + round(start_s * 1e9)
    end = newest if seconds is None else min(newest, begin + round(seconds * 1e9))
    if end <= begin:
        raise InvalidInput(
            f"of {source!r} in {target!r} there are {(newest - oldest) * 1e-9:.3f} s; nothing is left after "
            f"the first {start_s:g} s"
        )
    count = int(np.clip((end - begin) * 1e-9 * _A_SECOND, _FEWEST, _MOST))
    stamps = np.linspace(begin, end, count).astype(np.int64)
    poses, valid = buffer.lookup_many(target, source, stamps)
    return Curves(("x", "y", "z"), ("m", "m", "m"), stamps[valid], poses[valid, :3])


def _oldest(buffer: TransformBuffer, target: str, source: str, newest: int) -> int:
    """The first instant that every moving edge of the path knows."""
    from zstate.cli.monitor.path import path_between

    _, legs = path_between(buffer.frames(), target, source)
    return max((leg.edge.oldest for leg in legs if leg.edge.oldest is not None), default=newest)


def _no_joint(joint: str, names: Sequence[str]) -> str:
    return f"this robot has no joint {joint!r}{did_you_mean(joint, names)} (joints: {', '.join(names)})"
