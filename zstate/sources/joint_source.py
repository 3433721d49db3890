"""Interface of joint sources, and the check of joint states against a model."""

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
    None when they are not known. ``stamp`` [ns] is None if the reading is of the requested instant.
    """

    positions: NDArray[np.float64]
    velocities: NDArray[np.float64] | None = None
    efforts: NDArray[np.float64] | None = None
    stamp: int | None = None


class JointSource(Protocol):
    """Interface of drivers, simulators and test signals."""

    def read(self, stamp: int) -> JointReading | None:
        """The joints at ``stamp`` [ns], the present instant; None when there is nothing new."""
        ...


class JointStateValidator:
    """Reads joint states of a robot with ``model``, with the checks of a StatePublisher."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        self._table = JointTransforms(model)
        self._order = JointOrder(
            model.joint_names, coordinate_names(model), velocity_columns_by_position(model)
        )

    def read(self, state: JointState) -> JointNumbers:
        """The numbers of a sample. Raises MessageError or InvalidInput if they cannot be used."""
        numbers = self._order.read(state)
        self._table.normalised(self._model.check_positions(numbers.positions))
        if numbers.velocities is not None:
            self._model.check_velocities(numbers.velocities)
        if numbers.efforts is not None:
            self._model.check_efforts(numbers.efforts)
        return numbers
