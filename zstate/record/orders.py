"""Orders: the names of the numbers in a robot's samples, and the samples that wait for them."""

from __future__ import annotations

from collections.abc import Iterable

from zstate._util.bounded_queue import BoundedQueue
from zstate.model.coordinates import coordinate_names, velocity_slots
from zstate.model.urdf import parse_urdf
from zstate.wire.messages import Clock, JointState, RobotDescription, Sample, TransformSample, order_digest
from zstate.wire.sample_names import SampleNames

EARLY = 1024
"""So many samples of a robot wait for the description that names their numbers."""
EARLY_BYTES = 1 << 22
"""So many bytes of them, if that is less."""

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


class EarlySamples:
    """Samples that came before the description that names their numbers, the newest of each robot.

    ``given_up`` counts those that were dropped for newer ones.
    """

    def __init__(self) -> None:
        self.given_up = 0
        self._robots: dict[str, BoundedQueue[tuple[Sample | Clock, int]]] = {}

    @property
    def waiting(self) -> int:
        """How many wait."""
        return sum(len(early) for early in list(self._robots.values()))

    def keep(self, robot: str, sample: Sample | Clock, log_time: int) -> None:
        """Keep a sample that was heard at ``log_time``, unless it is too large by itself."""
        early = self._robots.setdefault(robot, BoundedQueue(EARLY, EARLY_BYTES))
        self.given_up += early.append((sample, log_time), _size(sample))

    def pop(self, robot: str) -> Iterable[tuple[Sample | Clock, int]]:
        """Those of ``robot`` with their log times, which are kept no longer."""
        return self._robots.pop(robot, ())


def _size(sample: Sample | Clock) -> int:
    if isinstance(sample, JointState):
        return sum(len(block or b"") for block in (sample.positions, sample.velocities, sample.efforts))
    return len(sample.poses) if isinstance(sample, TransformSample) else 0
