"""Joint states as documents: numbers beside the names of their joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeAlias, cast

from zstate.errors import ModelError
from zstate.model.urdf import parse_urdf
from zstate.wire.messages import JointState, RobotDescription, from_block, order_digest

if TYPE_CHECKING:
    from zstate.model.robot import RobotModel

Numbers: TypeAlias = "dict[str, float | list[float]] | list[float]"
Document: TypeAlias = "dict[str, int | Numbers]"

BLOCKS = ("positions", "velocities", "efforts")


class DocumentWriter:
    """Turns joint states into documents.

    A document has "stamp" [ns], "seq", and those of "positions", "velocities" and "efforts" that were
    sent: by joint name, a list where a joint has several numbers. Where the names are not known, each is
    a bare list.
    """

    def __init__(self) -> None:
        self._model: RobotModel | None = None
        self._names: tuple[str, ...] = ()
        self._order = b""

    @property
    def model(self) -> RobotModel | None:
        """What was described last, if its URDF can be read."""
        return self._model

    def describe(self, description: RobotDescription) -> None:
        """Learn the names of the joints."""
        self._names = description.joint_names
        self._order = order_digest(self._names)
        try:
            # Text and nothing else: what comes over the network opens no files and runs no xacro.
            self._model = parse_urdf(description.urdf, "its URDF")
        except ModelError:
            self._model = None  # the names alone serve joints of one number

    def knows(self, state: JointState) -> bool:
        """Whether the joints of ``state`` have names."""
        return state.names is not None or state.order == self._order

    def document(self, state: JointState) -> Document:
        """What ``state`` says."""
        document: Document = {"stamp": state.stamp, "seq": state.seq}
        for what in BLOCKS:
            block = cast("bytes | None", getattr(state, what))
            if block is not None:
                document[what] = self._labelled(state, what, from_block(block).tolist())
        return document

    def _labelled(self, state: JointState, what: str, numbers: list[float]) -> Numbers:
        names = state.names if state.names is not None else self._names if self.knows(state) else ()
        if len(names) == len(numbers):
            return dict(zip(names, numbers, strict=True))
        model = self._model
        if state.names is not None or model is None or model.joint_names != names:
            return numbers
        count = model.position_count if what == "positions" else model.velocity_count
        if len(numbers) != count:
            return numbers
        starts = model.columns if what == "positions" else model.velocity_columns
        return {name: _one_or_all(numbers[start:end]) for name, start, end in _spans(starts, count)}


def _spans(starts: Mapping[str, int], count: int) -> list[tuple[str, int, int]]:
    ends = [*list(starts.values())[1:], count]
    return [(name, start, end) for (name, start), end in zip(starts.items(), ends, strict=True)]


def _one_or_all(numbers: list[float]) -> float | list[float]:
    return numbers[0] if len(numbers) == 1 else numbers
