"""Merges the joint states of several drivers of one robot into whole readings."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zstate._util.bounded import BoundedDict
from zstate.errors import MessageError, format_duration
from zstate.ingest.joint_parts import JointNames
from zstate.model.robot import POSITION_COUNTS, VELOCITY_COUNTS, JointType, RobotModel
from zstate.sources.joint_source import JointReading, JointStateValidator
from zstate.wire.messages import JointState

_MAX_PARTS = 64


@dataclass(eq=False, slots=True)
class _Part:
    """The joints that one writer publishes together, and their places among those of the robot."""

    writer: str
    session: int
    joints: tuple[str, ...]
    validator: JointStateValidator
    columns: NDArray[np.intp]
    rate_columns: NDArray[np.intp]
    stamp: int = 0
    received_s: float = 0.0
    has_velocities: bool = False
    has_efforts: bool = False


class JointStateMerger:
    """The newest values of all joints of a robot with ``model``, from drivers of some of them each.

    A reading is complete if each joint has a value at most ``max_age_s`` [s] older than the newest, by
    their stamps. A joint has one writer: another one is refused for ``max_age_s`` after the last sample of
    the first. With ``others`` messages may name joints that are not of the model, as in ROS. Not thread-safe.
    """

    def __init__(self, model: RobotModel, max_age_s: float, *, others: bool = False) -> None:
        self.incomplete = 0
        """How many samples gave no reading, because of other joints."""
        self._model = model
        self._names = JointNames(model)
        self._max_age_s, self._max_age_ns = max_age_s, round(max_age_s * 1e9)
        self._others = others
        self._parts: dict[tuple[int, bytes], _Part] = {}
        self._owners: dict[str, _Part] = {}
        self._are_whole: BoundedDict[bytes, bool] = BoundedDict()
        self._positions = np.zeros(model.position_count)
        self._velocities = np.zeros(model.velocity_count)
        self._efforts = np.zeros(model.velocity_count)
        self._incomplete_since: int | None = None

    def has_all_joints(self, state: JointState) -> bool:
        """Whether ``state`` has all joints. Raises MessageError if its joints cannot be used."""
        known = self._are_whole.get(state.order)
        if known is None:
            joints = self._names.joints(state.names or (), others=self._others)
            known = self._are_whole[state.order] = len(joints) == len(self._model.joint_names)
        return known

    def add(self, state: JointState, writer: str) -> JointReading | None:
        """The reading with the joints of ``state``; None if it is incomplete.

        Its stamp is that of its newest part. Velocities and efforts are None unless all drivers send them.
        Raises MessageError or InvalidInput for a state that cannot be used, or has another writer's joint.
        """
        part = self._parts.get((state.session, state.order)) or self._add_part(state, writer)
        numbers = part.validator.read(state)
        self._own(part)
        part.stamp = state.stamp
        part.has_velocities, part.has_efforts = numbers.velocities is not None, numbers.efforts is not None
        self._positions[part.columns] = numbers.positions
        if numbers.velocities is not None:
            self._velocities[part.rate_columns] = numbers.velocities
        if numbers.efforts is not None:
            self._efforts[part.rate_columns] = numbers.efforts
        parts = set(self._owners.values())
        newest, oldest = max(one.stamp for one in parts), min(one.stamp for one in parts)
        if len(self._owners) < len(self._model.joint_names) or newest - oldest > self._max_age_ns:
            self.incomplete += 1
            if self._incomplete_since is None:
                self._incomplete_since = newest
            return None
        self._incomplete_since = None
        velocities = self._velocities.copy() if all(one.has_velocities for one in parts) else None
        efforts = self._efforts.copy() if all(one.has_efforts for one in parts) else None
        return JointReading(self._positions.copy(), velocities, efforts, newest, oldest)

    def missing_joints(self) -> tuple[str, ...]:
        """The joints without a value, or with too old a one; none until that lasts for ``max_age_s``."""
        newest, since = self._newest(), self._incomplete_since
        if since is None or newest - since < self._max_age_ns:
            return ()
        return tuple(
            name
            for name in self._model.joint_names
            if (owner := self._owners.get(name)) is None or newest - owner.stamp > self._max_age_ns
        )

    def explanation(self) -> str:
        """The missing joints with their writers, for the log."""
        newest, missing = self._newest(), self.missing_joints()
        unknown = [name for name in missing if name not in self._owners]
        texts = [f"{', '.join(map(repr, unknown))} without a writer"] if unknown else []
        for part in dict.fromkeys(self._owners[name] for name in missing if name in self._owners):
            joints = ", ".join(repr(name) for name in missing if self._owners.get(name) is part)
            age, limit = format_duration(newest - part.stamp), format_duration(self._max_age_ns)
            texts.append(f"{joints} of {part.writer} {age} older than the newest, more than {limit}")
        return "; ".join(texts)

    def _newest(self) -> int:
        return max((part.stamp for part in self._owners.values()), default=0)

    def _own(self, part: _Part) -> None:
        """Make ``part`` the owner of its joints. Raises MessageError if another writer is."""
        part.received_s = now_s = time.monotonic()
        for joint in part.joints:
            owner = self._owners.get(joint)
            if owner is part:
                continue
            is_other = owner is not None and owner.session != part.session
            if owner is not None and is_other and now_s - owner.received_s <= self._max_age_s:
                raise MessageError(
                    f"joint {joint!r} is published by {owner.writer}; refused: {part.writer}; "
                    "one joint has one writer",
                    reason="second writer",
                )
            self._owners[joint] = part

    def _add_part(self, state: JointState, writer: str) -> _Part:
        if state.names is None:
            raise MessageError("a partial joint state without the names of its joints", reason="no names")
        joints = self._names.joints(state.names, others=self._others)
        if len(self._parts) >= _MAX_PARTS:
            used = set(self._owners.values())
            self._parts = {key: part for key, part in self._parts.items() if part in used}
        part = self._parts[state.session, state.order] = _Part(
            writer,
            state.session,
            joints,
            JointStateValidator(self._model.part(joints)),
            _columns(self._model, joints, self._model.columns, POSITION_COUNTS),
            _columns(self._model, joints, self._model.velocity_columns, VELOCITY_COUNTS),
        )
        return part


def _columns(
    model: RobotModel, joints: tuple[str, ...], firsts: dict[str, int], counts: dict[JointType, int]
) -> NDArray[np.intp]:
    """The places of the numbers of ``joints`` among those of the whole robot."""
    sizes = {joint.name: counts[joint.type] for joint in model.driven_joints}
    return np.array([firsts[name] + place for name in joints for place in range(sizes[name])], dtype=np.intp)
