"""Joint states of a robot over time, as arrays (ROS trajectory_msgs/JointTrajectory)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class JointTrajectory:
    """The joints of one robot at T instants: row i of each array is of ``stamps[i]``.

    ``stamps`` (T,) [ns] ascend. ``positions`` (T, nq) [rad] or [m] has a column for each of ``coordinates``:
    the joint's name, or "base.x", "base.y", ... of a joint with several numbers. ``velocities`` (T, nv) per
    second and ``efforts`` (T, nv) [Nm] or [N] have a column for each of ``velocity_coordinates``; NaN in rows
    where they are not known, None if no row has them. ``joint_names`` are the driven joints.
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
        count, joints = len(self.stamps), len(self.joint_names)
        lasting = f" over {(int(self.stamps[-1]) - int(self.stamps[0])) * 1e-9:.3f} s" if count else ""
        return f"<JointTrajectory of {joints} joints: {count} samples{lasting}>"

    def select(self, rows: NDArray[np.intp] | slice) -> JointTrajectory:
        """The instants ``rows``, which ascend."""
        return JointTrajectory(
            self.joint_names,
            self.coordinates,
            self.velocity_coordinates,
            self.stamps[rows],
            self.positions[rows],
            None if self.velocities is None else self.velocities[rows],
            None if self.efforts is None else self.efforts[rows],
        )


def concatenated(parts: Sequence[JointTrajectory]) -> JointTrajectory:
    """The instants of ``parts``, at least one, of the same robot, in ascending order of stamps.

    Of two rows with one stamp the later one counts, as in a buffer.
    """
    stamps = np.concatenate([part.stamps for part in parts])
    first = parts[0]
    whole = JointTrajectory(
        first.joint_names,
        first.coordinates,
        first.velocity_coordinates,
        stamps,
        np.concatenate([part.positions for part in parts]),
        _stacked([part.velocities for part in parts], parts),
        _stacked([part.efforts for part in parts], parts),
    )
    if (np.diff(stamps) > 0).all():
        return whole
    order = np.argsort(stamps, kind="stable")
    is_last = np.append(np.diff(stamps[order]) > 0, True)
    return whole.select(order[is_last])


def _stacked(blocks: Sequence[Floats | None], parts: Sequence[JointTrajectory]) -> Floats | None:
    width = next((block.shape[1] for block in blocks if block is not None), None)
    if width is None:
        return None
    missing = [np.full((len(part), width), np.nan) for part in parts]
    return np.concatenate(
        [gap if block is None else block for block, gap in zip(blocks, missing, strict=True)]
    )
