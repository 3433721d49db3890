"""Orders: what the numbers in a robot's samples are called, as its descriptions tell."""

from __future__ import annotations

from zstate.model.coordinates import coordinate_names, velocity_slots
from zstate.model.urdf import parse_urdf
from zstate.wire.messages import Clock, JointState, RobotDescription, Sample, TransformSample, order_digest
from zstate.wire.sample_names import SampleNames

_NAMED = SampleNames()


class Orders:
    """The joint and edge orders of one robot, each known by its digest; older ones stay known."""

    def __init__(self) -> None:
        self._joints: dict[bytes, SampleNames] = {}
        self._edges: dict[bytes, SampleNames] = {}

    def learn(self, description: RobotDescription, robot: str) -> None:
        """Take in the orders of a description. Raises ModelError when its joints cannot be understood."""
        edges = description.moving_edges
        self._edges.setdefault(order_digest(edges), SampleNames(moving_edges=edges))
        order = order_digest(description.joint_names)
        if description.joint_names and order not in self._joints:
            model = parse_urdf(description.urdf, f"the description of {robot!r}")
            self._joints[order] = SampleNames(coordinate_names(model), velocity_slots(model))

    def sample_names(self, sample: Sample | Clock) -> SampleNames | None:
        """The names behind the numbers of ``sample``, or None while no description told them."""
        if isinstance(sample, JointState):
            return self._joints.get(sample.order) if sample.names is None else _NAMED
        if isinstance(sample, TransformSample):
            return self._edges.get(sample.order) if sample.edges is None else _NAMED
        return _NAMED
