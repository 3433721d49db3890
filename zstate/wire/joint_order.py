"""JointOrder: reading JointState messages into the order of a model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.errors import MessageError
from zstate.wire.messages import JointState, from_block, order_digest

Floats = NDArray[np.float64]


class JointNumbers(NamedTuple):
    """The numbers of one message, in the reader's joint order; None for what was not sent."""

    positions: Floats
    velocities: Floats | None
    efforts: Floats | None


class JointOrder:
    """The joints a reader expects, by name, and how to find them in what writers send.

    A writer with the same order is read as it is. One that names its joints in full may have any
    order and joints of its own besides (one number each); every joint of ours must be among them.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.digest = order_digest(self.names)
        self._picks: dict[tuple[str, ...], NDArray[np.intp]] = {}

    def read(self, state: JointState) -> JointNumbers:
        """The numbers of ``state`` in our order. Raises MessageError when they are not all there."""
        blocks = (state.positions, state.velocities, state.efforts)
        numbers = [None if block is None else from_block(block) for block in blocks]
        if state.order != self.digest:
            pick = self._pick(state.names)
            numbers = [None if block is None else block[pick] for block in numbers]
        positions, velocities, efforts = numbers
        assert positions is not None
        return JointNumbers(positions, velocities, efforts)

    def _pick(self, names: tuple[str, ...] | None) -> NDArray[np.intp]:
        if names is None:
            raise MessageError(
                "a joint state in an order of another model; do both sides use the same URDF?",
                reason="other joint order",
            )
        pick = self._picks.get(names)
        if pick is None:
            missing = [name for name in self.names if name not in names]
            if missing:
                raise MessageError(
                    f"a joint state without {', '.join(map(repr, missing))}", reason="missing joints"
                )
            # One order per writer is usual; a writer that shuffles must not fill the memory.
            pick = np.array([names.index(name) for name in self.names], dtype=np.intp)
            self._picks = {names: pick}
        return pick
