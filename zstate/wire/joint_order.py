"""Joint order: reading JointState messages into a model's order, and the names behind their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.checks import Floats
from zstate.errors import MessageError
from zstate.wire.messages import Edges, JointState, from_block, order_digest

_Indices = NDArray[np.intp]


class JointNumbers(NamedTuple):
    """The numbers of one message, in the reader's joint order; None if not sent."""

    positions: Floats
    velocities: Floats | None
    efforts: Floats | None


class JointOrder:
    """The joints that a reader expects, by name, and their place in the samples of writers.

    A writer with the same order of joint ``names`` is read as it is. A writer that sends all names may use
    any order and send further joints; each of the reader's ``coordinates`` (default: ``names``) must be among
    them. ``velocity_slots`` is the coordinate of each velocity. In ROS, NaN marks velocities or efforts of
    such a writer as unknown; a block with a NaN is read as None.
    """

    def __init__(
        self, names: Sequence[str], coordinates: Sequence[str] = (), velocity_slots: Sequence[int] = ()
    ) -> None:
        self.digest = order_digest(tuple(names))
        self._coordinates = tuple(coordinates or names)
        self._slots = np.array(velocity_slots or range(len(self._coordinates)), dtype=np.intp)
        self._plain = np.arange(len(self._coordinates)), np.arange(len(self._slots))
        self._permutations: dict[tuple[str, ...], tuple[_Indices, _Indices]] = {}

    def read(self, state: JointState) -> JointNumbers:
        """The numbers of ``state`` in the reader's order. Raises MessageError if any is missing."""
        positions = from_block(state.positions)
        velocities = None if state.velocities is None else from_block(state.velocities)
        efforts = None if state.efforts is None else from_block(state.efforts)
        if state.order != self.digest:
            order, rate_order = self.columns(state)
            positions = positions[order]
            velocities = None if velocities is None else velocities[rate_order]
            efforts = None if efforts is None else efforts[rate_order]
        if state.names is not None:
            velocities, efforts = _none_if_nan(velocities), _none_if_nan(efforts)
        return JointNumbers(positions, velocities, efforts)

    def columns(self, state: JointState) -> tuple[_Indices, _Indices]:
        """The index in ``state`` of each position, and of each velocity or effort, of the reader's.

        Raises MessageError if any is missing.
        """
        if state.order == self.digest:
            return self._plain
        names = state.names
        if names is None:
            raise MessageError(
                "a joint state in an order of another model; do both sides use the same URDF?",
                reason="other joint order",
            )
        return self.columns_by_name(names)

    def columns_by_name(self, names: tuple[str, ...]) -> tuple[_Indices, _Indices]:
        """``columns`` of states with these ``names``. Raises MessageError if any is missing."""
        found = self._permutations.get(names)
        if found is None:
            missing = [name for name in self._coordinates if name not in names]
            if missing:
                raise MessageError(
                    f"a joint state without {', '.join(map(repr, missing))}", reason="missing joints"
                )
            # One order per writer is usual; a writer that shuffles must not fill the memory.
            positions = np.array([names.index(name) for name in self._coordinates], dtype=np.intp)
            found = positions, positions[self._slots]
            self._permutations = {names: found}
        return found


def _none_if_nan(numbers: Floats | None) -> Floats | None:
    return None if numbers is None or np.isnan(numbers).any() else numbers


@dataclass(frozen=True, slots=True)
class SampleLayout:
    """The names behind the numbers of a writer's samples, for wires that name each of them.

    ``coordinates`` names each number of a position vector; ``velocity_slots`` is the coordinate of each
    number of a velocity or effort vector; ``moving_edges`` is the order of poses.
    """

    coordinates: tuple[str, ...] = ()
    velocity_slots: tuple[int, ...] = ()
    moving_edges: Edges = ()
