"""Joint states of a recording as arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from zstate.errors import MessageError
from zstate.model.joint_trajectory import JointTrajectory
from zstate.model.robot import coordinate_names, velocity_columns_by_position
from zstate.recording.decode import DecodedRecording, first_descriptions, joint_order, recorded_model
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, from_block

_ROWS = 8192
"""Samples of one part: some megabytes for a humanoid."""


class JointStateReader:
    """Reads the joint states of ``robot`` in the order of its model, or of its first message without one.

    Samples that do not have all joints are left out, and ``refuse(reason, text)`` is called for each.
    """

    def __init__(self, recording: DecodedRecording, robot: str, refuse: Callable[[str, str], None]) -> None:
        self._recording = recording
        self._robot = robot
        self._refuse = refuse
        described = first_descriptions(recording, (robot,)).get(robot)
        model = None if described is None else recorded_model(recording, described, refuse)
        if model is not None:
            self.joint_names = tuple(model.joint_names)
            self.coordinates = coordinate_names(model)
            slots = velocity_columns_by_position(model)
            self._order = joint_order(model)
        else:
            messages = recording.messages((robot,), ("joint_states",))
            first = next((one.message for one in islice(messages, 1)), None)
            names = first.names or () if isinstance(first, JointState) else ()
            self.joint_names = self.coordinates = names
            slots = tuple(range(len(names)))
            self._order = JointOrder(names)
        self.velocity_coordinates = tuple(self.coordinates[slot] for slot in slots)

    def parts(self, begin: int | None = None, end: int | None = None) -> Iterator[JointTrajectory]:
        """The samples recorded in [begin, end) [ns], as recorded: at most 8192 in each part.

        Stamps may go back, within a part and between parts.
        """
        part: list[JointState] = []
        for decoded in self._recording.messages((self._robot,), ("joint_states",), begin, end):
            state = decoded.message
            assert isinstance(state, JointState)
            if part and (len(part) == _ROWS or not _has_same_columns(state, part[0])):
                yield from self._trajectory(part)
                part = []
            part.append(state)
        if part:
            yield from self._trajectory(part)

    def _trajectory(self, states: Sequence[JointState]) -> Iterator[JointTrajectory]:
        """The trajectory of samples with the same columns; none if a joint is missing in them."""
        try:
            columns, rate_columns = self._order.columns(states[0])
        except MessageError as error:
            for _ in states:
                self._refuse(error.reason, f"{self._robot!r}: {error}")
            return
        velocities = _rows([state.velocities for state in states], rate_columns)
        efforts = _rows([state.efforts for state in states], rate_columns)
        yield JointTrajectory(
            self.joint_names,
            self.coordinates,
            self.velocity_coordinates,
            np.array([state.stamp for state in states], dtype=np.int64),
            _stacked([state.positions for state in states], columns),
            velocities,
            efforts,
        )


def _rows(blocks: Sequence[bytes | None], columns: NDArray[np.intp]) -> NDArray[np.float64] | None:
    """One row for each block; None if they are None, or if no number is known."""
    known = [block for block in blocks if block is not None]
    rows = _stacked(known, columns) if known else None
    return None if rows is None or np.isnan(rows).all() else rows


def _stacked(blocks: Sequence[bytes], columns: NDArray[np.intp]) -> NDArray[np.float64]:
    return from_block(b"".join(blocks)).reshape(len(blocks), -1)[:, columns]


def _has_same_columns(one: JointState, other: JointState) -> bool:
    return (
        one.order == other.order
        and (one.velocities is None) == (other.velocities is None)
        and (one.efforts is None) == (other.efforts is None)
    )
