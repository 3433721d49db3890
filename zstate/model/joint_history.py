"""Joint states of a robot over time, as arrays (ROS trajectory_msgs/JointTrajectory)."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from zstate.checks import Floats


@dataclass(frozen=True, eq=False, slots=True)
class JointHistory:
    """The joints of one robot at T instants: row i of each array is of ``stamps[i]``.

    ``stamps`` (T,) [ns] ascend. ``positions`` (T, nq) [rad] or [m] has a column for each of ``coordinates``:
    the joint's name, or "base.x", "base.y" ... of a joint with several numbers. ``velocities`` (T, nv), per
    second, and ``efforts`` (T, nv) [Nm] or [N] have a column for each of ``velocity_coordinates``; they are
    NaN in rows where they are not known, and None if they are known in no row. ``joint_names`` are the driven
    joints.
    """

    joint_names: tuple[str, ...]
    coordinates: tuple[str, ...]
    velocity_coordinates: tuple[str, ...]
    stamps: NDArray[np.int64]
    positions: Floats
    velocities: Floats | None = None
    efforts: Floats | None = None

    def __len__(self) -> int:
        """T, the number of instants."""
        return len(self.stamps)

    def __repr__(self) -> str:
        joints = len(self.joint_names)
        return f"<JointHistory of {joints} joints: {len(self)} samples in {self.duration_s:.3f} s>"

    @property
    def duration_s(self) -> float:
        """The time from the first instant to the last [s]."""
        return int(self.stamps[-1] - self.stamps[0]) * 1e-9 if len(self) else 0.0

    @property
    def kinds(self) -> set[str]:
        """Of "velocity" and "effort" those that are known in any row."""
        blocks = {"velocity": self.velocities, "effort": self.efforts}
        return {kind for kind, block in blocks.items() if block is not None}

    def with_kinds(self, kinds: Set[str]) -> JointHistory:
        """The same with arrays of these ``kinds`` too: NaN if they are not known."""
        unknown = np.full((len(self), len(self.velocity_coordinates)), np.nan)
        return replace(
            self,
            velocities=unknown if "velocity" in kinds - self.kinds else self.velocities,
            efforts=unknown if "effort" in kinds - self.kinds else self.efforts,
        )

    def select(self, rows: NDArray[np.intp] | slice) -> JointHistory:
        """The instants ``rows``, which ascend; a slice shares the memory of this trajectory."""
        return replace(
            self,
            stamps=self.stamps[rows],
            positions=self.positions[rows],
            velocities=None if self.velocities is None else self.velocities[rows],
            efforts=None if self.efforts is None else self.efforts[rows],
        )


def concatenate(parts: Sequence[JointHistory]) -> JointHistory:
    """The instants of ``parts``, at least one, of the same joints, in ascending order of stamps.

    Of two rows with one stamp the later one counts, as in a buffer.
    """
    stamps = np.concatenate([part.stamps for part in parts])
    first = parts[0]
    whole = JointHistory(
        first.joint_names,
        first.coordinates,
        first.velocity_coordinates,
        stamps,
        np.concatenate([part.positions for part in parts]),
        _stacked([part.velocities for part in parts], stamps, parts),
        _stacked([part.efforts for part in parts], stamps, parts),
    )
    if (np.diff(stamps) > 0).all():
        return whole
    order = np.argsort(stamps, kind="stable")
    is_last = np.append(np.diff(stamps[order]) > 0, True)
    return whole.select(order[is_last])


def _stacked(
    blocks: Sequence[Floats | None], stamps: NDArray[np.int64], parts: Sequence[JointHistory]
) -> Floats | None:
    """Velocities or efforts of all parts, NaN for those that have none."""
    known = next((block for block in blocks if block is not None), None)
    if known is None:
        return None
    stacked = np.full((len(stamps), known.shape[1]), np.nan)
    first = 0
    for block, part in zip(blocks, parts, strict=True):
        if block is not None:
            stacked[first : first + len(part)] = block
        first += len(part)
    return stacked
