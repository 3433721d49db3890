"""StateReader: what joint states say of the joints of a model, if it can be used."""

from __future__ import annotations

from zstate.model.coordinates import coordinate_names, velocity_slots
from zstate.model.edges import EdgeTable
from zstate.model.robot import RobotModel
from zstate.wire.joint_order import JointNumbers, JointOrder
from zstate.wire.messages import JointState


class StateReader:
    """Reads joint states for a robot with ``model``, and refuses all that a StatePublisher would refuse."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        self._table = EdgeTable(model)
        self._order = JointOrder(model.joint_names, coordinate_names(model), velocity_slots(model))

    def read(self, state: JointState) -> JointNumbers:
        """The numbers of a sample. Raises MessageError and InvalidInput for what cannot be used."""
        numbers = self._order.read(state)
        self._table.normalised(self._model.check_positions(numbers.positions))
        if numbers.velocities is not None:
            self._model.check_velocities(numbers.velocities)
        if numbers.efforts is not None:
            self._model.check_efforts(numbers.efforts)
        return numbers
