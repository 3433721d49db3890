"""What a joint source is: whatever can say where the joints are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class JointReading:
    """The joints of a robot at one instant, in the order of its model's ``joint_names``.

    ``positions`` [rad] or [m], ``velocities`` per second, ``efforts`` [Nm] or [N]; the last two are
    None when they are not known. ``stamp`` [ns] is None when the reading is of the instant asked for.
    """

    positions: NDArray[np.float64]
    velocities: NDArray[np.float64] | None = None
    efforts: NDArray[np.float64] | None = None
    stamp: int | None = None


class JointSource(Protocol):
    """The seam to drivers, simulators and test signals."""

    def read(self, stamp: int) -> JointReading | None:
        """Where the joints are at ``stamp`` [ns], which is now; None when there is nothing new."""
        ...
