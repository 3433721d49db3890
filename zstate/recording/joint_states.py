"""Joint states of a recording as arrays, in batches, by the rules of a buffer.

``Recording.buffer`` inserts samples one by one. Here the records of a channel that differ only in numbers are
decoded together, in a fraction of the time; the samples kept are the same, and efforts are kept too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.clock import SET_BACK_NS
from zstate.errors import MessageError, ModelError
from zstate.ingest.joint_parts import joint_order
from zstate.model.joint_history import JointHistory, concatenate
from zstate.model.joint_transforms import JointTransforms
from zstate.model.robot import RobotModel, coordinate_names, velocity_columns_by_position
from zstate.model.urdf import parse_urdf
from zstate.recording.decode import (
    DecodedRecording,
    UndecodedRecord,
    first_descriptions,
    recorded_model,
)
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, RobotDescription, from_block
from zstate.wire.ros2.decoder import RosJointStates

DELAYED_NS = 10_000_000_000
"""A sample may be this late and still belong to its epoch, as with the history of a listener."""

_ROWS = 4096
"""Samples decoded together: some megabytes for a humanoid."""

Refuse = Callable[[str, str], None]


class JointStateBatch(NamedTuple):
    """Consecutive samples. With ``restarts`` they begin a new history, and earlier batches do not count."""

    trajectory: JointHistory
    restarts: bool


class _GrowingTrajectory:
    """Consecutive trajectories as one, in arrays that grow in place: no sample is in memory twice."""

    def __init__(self, first: JointHistory) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}
        self._count = 0
        self.append(first)

    def append(self, part: JointHistory) -> None:
        """Append a trajectory of the same joints."""
        first, self._count = self._count, self._count + len(part)
        self._newest = part
        for name in ("stamps", "positions", "velocities", "efforts"):
            block: NDArray[Any] | None = getattr(part, name)
            if block is not None and name not in self._arrays:
                unknown = np.nan if first else 0  # none is without a stamp
                self._arrays[name] = np.full((first, *block.shape[1:]), unknown, block.dtype)
            if name in self._arrays:
                array = self._arrays[name]
                if len(array) < self._count:
                    _resize(array, self._count + self._count // 8)
                array[first : self._count] = np.nan if block is None else block

    def trajectory(self) -> JointHistory:
        """All of them. No ``append`` may follow."""
        for array in self._arrays.values():
            _resize(array, self._count)
        return replace(self._newest, **self._arrays)


def _resize(array: NDArray[Any], rows: int) -> None:
    array.resize((rows, *array.shape[1:]), refcheck=False)  # there is no other reference


class _Batch(NamedTuple):
    """Joint states of one session with their sequence numbers."""

    states: RosJointStates
    session: int
    seqs: NDArray[np.int64]


class RecordedJointReader:
    """Reads the joint states of ``robot`` once, in the order of its model, or else of its first message.

    Samples that a buffer would refuse are left out, and ``refuse(reason, text)`` is called for each.
    """

    def __init__(self, recording: DecodedRecording, robot: str, refuse: Refuse) -> None:
        self.robot = robot
        self._recording = recording
        self._refuse = refuse
        described = first_descriptions(recording, (robot,)).get(robot)
        self._model = None if described is None else recorded_model(recording, described, refuse)
        names = self._first_names() if self._model is None else ()
        self._layout = JointLayout(names) if self._model is None else JointLayout.of_model(self._model)
        self._epoch = _Epoch()
        self._records: list[UndecodedRecord] = []
        """Of one channel and length, to decode together."""
        self._description = b""
        self._is_new = self._restarts = False
        self._pending: JointHistory | None = None

    @property
    def model(self) -> RobotModel | None:
        """The model in the recording that fits the joint states, if there is one."""
        return self._model

    @property
    def count(self) -> int:
        """The number of recorded samples, usable or not."""
        writers = self._recording.writers.items()
        return sum(count for one, count in writers if (one.robot, one.stream) == (self.robot, "joint_states"))

    def _first_names(self) -> tuple[str, ...]:
        for decoded in self._recording.messages((self.robot,), ("joint_states",)):
            assert isinstance(decoded.message, JointState)
            return decoded.message.names or ()
        return ()

    def all(self) -> JointHistory:
        """All samples."""
        whole: _GrowingTrajectory | None = None
        for trajectory, restarts in self.batches():
            if whole is None or restarts:
                whole = _GrowingTrajectory(trajectory)
            else:
                whole.append(trajectory)
        return self._layout.empty() if whole is None else whole.trajectory()

    def batches(self) -> Iterator[JointStateBatch]:
        """All samples in order of their stamps, which ascend across batches too.

        A sample is passed on once another is 10 s newer. If two samples have one stamp, the later one counts.
        """
        for undecoded in self._recording.records((self.robot,), ("joint_states", "robot_description")):
            yield from self.add(undecoded)
        yield from self.finish()

    def add(self, undecoded: UndecodedRecord) -> Iterable[JointStateBatch]:
        """The next record of joint states or of a description, and the batches that ``batches`` has then.

        For callers that read the recording themselves; call ``finish`` after the last one.
        """
        records = self._records
        if undecoded.channel.writer.stream == "robot_description":
            if undecoded.record.payload == self._description:
                return ()  # it is written again every 10 s
            self._description, self._records = undecoded.record.payload, []
            return self._settled(chain(self._decode(records), self._described(undecoded)))
        if records and (len(records) == _ROWS or not _is_alike(undecoded, records[0])):
            self._records = [undecoded]
            return self._settled(self._decode(records))
        records.append(undecoded)
        return ()

    def flush(self) -> Iterator[JointStateBatch]:
        """The batches of what was added, whose records are not kept any longer."""
        records, self._records = self._records, []
        return self._settled(self._decode(records))

    def finish(self) -> Iterator[JointStateBatch]:
        """The last batches."""
        yield from self.flush()
        if self._pending is not None:
            yield JointStateBatch(self._pending, self._restarts)
            self._pending = None

    def _settled(self, found: Iterable[_Batch | RobotDescription]) -> Iterator[JointStateBatch]:
        """The next samples that are older than 10 s."""
        for trajectory, is_new in self._as_recorded(found):
            before = self._pending
            pending = concatenate((trajectory,) if before is None or is_new else (before, trajectory))
            self._restarts |= is_new
            settled = np.count_nonzero(pending.stamps < pending.stamps[-1] - DELAYED_NS)
            self._pending = pending.select(slice(settled, None)) if settled else pending
            if settled:
                restarts, self._restarts = self._restarts, False
                yield JointStateBatch(pending.select(slice(settled)), restarts)

    def _as_recorded(self, found: Iterable[_Batch | RobotDescription]) -> Iterator[JointStateBatch]:
        """The samples that a buffer keeps, as they were recorded: stamps may go back."""
        for batch in found:
            if isinstance(batch, RobotDescription):
                self._is_new |= self._replace_model(batch)
                continue
            trajectory, usable = self._layout.read(batch.states, self.robot, self._refuse)
            kept, restarts = self._epoch.keep(batch.session, trajectory.stamps, batch.seqs[usable])
            self._is_new |= restarts
            if len(kept):
                is_new, self._is_new = self._is_new, False
                yield JointStateBatch(trajectory.select(kept), is_new)

    def _replace_model(self, description: RobotDescription) -> bool:
        """Use the model of ``description`` from now on; False if it is the same, or cannot be used."""
        if self._model is None or description.digest == self._model.digest:
            return False
        try:
            self._model = parse_urdf(description.urdf, f"the URDF of {self.robot!r}")
        except ModelError as error:
            self._refuse("robot description", f"{self.robot!r}: {error}")
            return False
        self._layout = JointLayout.of_model(self._model)
        return True

    def _described(self, undecoded: UndecodedRecord) -> Iterator[RobotDescription]:
        messages = (decoded.message for decoded in self._recording.decode(undecoded))
        return (message for message in messages if isinstance(message, RobotDescription))

    def _decode(self, records: Sequence[UndecodedRecord]) -> Iterator[_Batch]:
        """The joint states of records of one channel and length: together, or else one by one."""
        if not records:
            return
        channel = records[0].channel
        states = channel.ros.joint_states([one.record.payload for one in records])
        if states is not None:
            seqs = np.array([one.seq for one in records], dtype=np.int64)
            yield _Batch(states, channel.writer.session, seqs)
            return
        for undecoded in records:
            for decoded in self._recording.decode(undecoded):
                assert isinstance(decoded.message, JointState)
                seqs = np.array([undecoded.seq], dtype=np.int64)
                yield _Batch(_single(decoded.message), channel.writer.session, seqs)


def _is_alike(one: UndecodedRecord, other: UndecodedRecord) -> bool:
    return one.channel is other.channel and len(one.record.payload) == len(other.record.payload)


def _single(state: JointState) -> RosJointStates:
    """One joint state as arrays of one row."""
    positions, velocities, efforts = (
        None if block is None else from_block(block)[None]
        for block in (state.positions, state.velocities, state.efforts)
    )
    assert positions is not None
    stamps = np.array([state.stamp], dtype=np.int64)
    return RosJointStates(stamps, state.names or (), positions, velocities, efforts)


class JointLayout:
    """The columns of a robot's trajectories, by its joint ``names`` or its model."""

    def __init__(
        self,
        names: tuple[str, ...],
        coordinates: tuple[str, ...] = (),
        slots: Sequence[int] = (),
        order: JointOrder | None = None,
        transforms: JointTransforms | None = None,
    ) -> None:
        self._names = names
        self._coordinates = coordinates or names
        self._velocity_coordinates = tuple(coordinates[slot] for slot in slots) or names
        self._order = order or JointOrder(names)
        self._transforms = transforms

    @classmethod
    def of_model(cls, model: RobotModel) -> JointLayout:
        """The columns of a robot with this model."""
        slots, transforms = velocity_columns_by_position(model), JointTransforms(model)
        return cls(model.joint_names, coordinate_names(model), slots, joint_order(model), transforms)

    def empty(self) -> JointHistory:
        """A trajectory without samples."""
        no_stamps, no_positions = np.empty(0, np.int64), np.empty((0, len(self._coordinates)))
        return self._trajectory(no_stamps, no_positions, None, None)

    def read(
        self, states: RosJointStates, robot: str, refuse: Refuse
    ) -> tuple[JointHistory, NDArray[np.intp]]:
        """The trajectory of the usable ``states``, and their rows. ``refuse`` is called for the others."""
        try:
            columns, rate_columns = self._order.columns_by_name(states.names)
        except MessageError as error:
            for _ in range(len(states.stamps)):
                refuse(error.reason, f"{robot!r}: {error}")
            return self.empty(), np.empty(0, np.intp)
        positions = states.positions[:, columns]
        is_usable = np.isfinite(positions).all(axis=1)
        if self._transforms is not None:
            is_usable &= self._transforms.has_unit_quaternions(positions)
        for row in np.flatnonzero(~is_usable).tolist():
            refuse("bad numbers", f"{robot!r}: the positions at {states.stamps[row]} are {positions[row]}")
        rows = np.flatnonzero(is_usable)
        positions = positions[rows]
        if self._transforms is not None:
            positions = self._transforms.normalised(positions)
        velocities, efforts = (
            None if block is None else _known(block[np.ix_(rows, rate_columns)])
            for block in (states.velocities, states.efforts)
        )
        return self._trajectory(states.stamps[rows], positions, velocities, efforts), rows

    def _trajectory(
        self,
        stamps: NDArray[np.int64],
        positions: NDArray[np.float64],
        velocities: NDArray[np.float64] | None,
        efforts: NDArray[np.float64] | None,
    ) -> JointHistory:
        names = self._names, self._coordinates, self._velocity_coordinates
        return JointHistory(*names, stamps, positions, velocities, efforts)


def _known(block: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """``block``; None if all of its numbers are NaN, which is ROS for unknown."""
    return None if np.isnan(block).all() else block


class _Epoch:
    """The samples that a buffer keeps: ``RecordedJointStateIngest`` states the same rules for one sample."""

    def __init__(self) -> None:
        self._session: int | None = None
        self._ended_sessions: set[int] = set()
        self._newest: int | None = None
        self._next_seq = 0
        self._last_late: tuple[int, int] | None = None

    def keep(
        self, session: int, stamps: NDArray[np.int64], seqs: NDArray[np.int64]
    ) -> tuple[NDArray[np.intp], bool]:
        """The rows to keep of samples in the order of the recording; and whether they begin a new history."""
        newest = self._newest
        is_next = session == self._session and newest is not None and len(stamps) > 0
        if is_next and stamps[0] >= newest and (np.diff(stamps) >= 0).all():
            self._newest = int(stamps[-1])
            self._next_seq = max(self._next_seq, int(seqs.max()) + 1)
            return np.arange(len(stamps)), False
        kept: list[int] = []
        is_new = False
        for row, (stamp, seq) in enumerate(zip(stamps.tolist(), seqs.tolist(), strict=True)):
            is_kept, restarts = self._add(session, stamp, seq)
            if restarts:
                kept, is_new = [], True
            if is_kept:
                kept.append(row)
        return np.array(kept, dtype=np.intp), is_new

    def _add(self, session: int, stamp: int, seq: int) -> tuple[bool, bool]:
        """Whether a sample is kept, and whether it begins a new history."""
        restarts = False
        if session != self._session:
            if session in self._ended_sessions:
                return False, False
            if self._session is not None:
                self._ended_sessions.add(self._session)
                restarts = self._newest is not None and stamp <= self._newest
            self._session, self._newest, self._next_seq, self._last_late = session, None, 0, None
        is_in_order = seq >= self._next_seq - 1
        self._next_seq = max(self._next_seq, seq + 1)
        if self._newest is None or stamp >= self._newest:
            self._newest = stamp
            return True, restarts
        is_kept = stamp >= self._newest - DELAYED_NS
        if not is_kept or (is_in_order and stamp < self._newest - SET_BACK_NS):
            # One old sample may have been delayed; two in a row show that the clock was set back.
            before, self._last_late = self._last_late, (seq, stamp)
            if before is not None and seq == before[0] + 1 and before[1] < stamp:
                self._newest, self._last_late = stamp, None
                return True, True
        return is_kept, False
