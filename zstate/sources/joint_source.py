"""What a joint source is: whatever can say where the joints are.

StateReader: what joint states say of the joints of a model, if it can be used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from zstate.model.joint_transforms import JointTransforms
from zstate.model.robot import RobotModel, coordinate_names, velocity_columns_by_position
from zstate.wire.joint_order import JointNumbers, JointOrder
from zstate.wire.messages import JointState


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


class JointStateValidator:
    """Reads joint states for a robot with ``model``, and refuses all that a StatePublisher would refuse."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        self._table = JointTransforms(model)
        self._order = JointOrder(
            model.joint_names, coordinate_names(model), velocity_columns_by_position(model)
        )

    def read(self, state: JointState) -> JointNumbers:
        """The numbers of a sample. Raises MessageError and InvalidInput for what cannot be used."""
        numbers = self._order.read(state)
        self._table.normalised(self._model.check_positions(numbers.positions))
        if numbers.velocities is not None:
            self._model.check_velocities(numbers.velocities)
        if numbers.efforts is not None:
            self._model.check_efforts(numbers.efforts)
        return numbers
