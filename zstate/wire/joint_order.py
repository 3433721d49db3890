"""JointOrder: reading JointState messages into the order of a model.

SampleNames: what the numbers in the samples of one robot are called.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.errors import MessageError
from zstate.wire.messages import Edges, JointState, from_block, order_digest

Floats = NDArray[np.float64]


class JointNumbers(NamedTuple):
    """The numbers of one message, in the reader's joint order; None for what was not sent."""

    positions: Floats
    velocities: Floats | None
    efforts: Floats | None


class JointOrder:
    """The joints a reader expects, by name, and how to find them in what writers send.

    A writer with the same order of joint ``names`` is read as it is. One that names its numbers in full
    may have any order and others besides; each of our ``coordinates`` must be among them, which are the
    names unless given. ``velocity_slots`` says which coordinate each velocity stands under. NaN among the
    velocities or efforts of such a writer is how ROS says of a joint that they are not known: then they
    are not taken for any.
    """

    def __init__(
        self, names: Sequence[str], coordinates: Sequence[str] = (), velocity_slots: Sequence[int] = ()
    ) -> None:
        self.digest = order_digest(tuple(names))
        self._coordinates = tuple(coordinates or names)
        self._slots = np.array(velocity_slots or range(len(self._coordinates)), dtype=np.intp)
        self._picks: dict[tuple[str, ...], _Permutation] = {}

    def is_plain(self, state: JointState) -> bool:
        """Whether ``state`` is a block of positions in our order and nothing else, as nearly always."""
        return state.order == self.digest and state.names is state.velocities is state.efforts is None

    def read(self, state: JointState) -> JointNumbers:
        """The numbers of ``state`` in our order. Raises MessageError when they are not all there."""
        pick = None if state.order == self.digest else self._pick(state.names)
        numbers = JointNumbers(
            from_block(state.positions), _numbers(state.velocities), _numbers(state.efforts)
        )
        if pick is not None:
            numbers = pick.apply(numbers)
        return numbers if state.names is None else _known(numbers)

    def _pick(self, names: tuple[str, ...] | None) -> _Permutation:
        if names is None:
            raise MessageError(
                "a joint state in an order of another model; do both sides use the same URDF?",
                reason="other joint order",
            )
        pick = self._picks.get(names)
        if pick is None:
            missing = [name for name in self._coordinates if name not in names]
            if missing:
                raise MessageError(
                    f"a joint state without {', '.join(map(repr, missing))}", reason="missing joints"
                )
            # One order per writer is usual; a writer that shuffles must not fill the memory.
            positions = np.array([names.index(name) for name in self._coordinates], dtype=np.intp)
            pick = _Permutation(positions, positions[self._slots])
            self._picks = {names: pick}
        return pick


class _Permutation(NamedTuple):
    """Where our numbers stand in what a writer sends."""

    positions: NDArray[np.intp]
    velocities: NDArray[np.intp]

    def apply(self, numbers: JointNumbers) -> JointNumbers:
        positions, velocities, efforts = numbers
        return JointNumbers(
            positions[self.positions],
            None if velocities is None else velocities[self.velocities],
            None if efforts is None else efforts[self.velocities],
        )


def _known(numbers: JointNumbers) -> JointNumbers:
    positions, velocities, efforts = numbers
    return JointNumbers(positions, _without_nan(velocities), _without_nan(efforts))


def _without_nan(numbers: Floats | None) -> Floats | None:
    return None if numbers is None or np.isnan(numbers).any() else numbers


def _numbers(block: bytes | None) -> Floats | None:
    return None if block is None else from_block(block)


@dataclass(frozen=True, slots=True)
class SampleLayout:
    """The names behind the numbers of a writer's samples, for wires that name each of them.

    ``coordinates`` names each number of a position vector; ``velocity_slots`` says under which of them
    each number of a velocity or effort vector stands; ``moving_edges`` is the order of poses.
    """

    coordinates: tuple[str, ...] = ()
    velocity_slots: tuple[int, ...] = ()
    moving_edges: Edges = ()
