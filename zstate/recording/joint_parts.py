"""Joint states of a recording from several drivers of one robot, each with some of the joints.

Each set of joints has one history, as if one driver were restarted: its writers are joined by the rules of
``Recording``. Writers of a recording are not announced, so sets with joints in common are ordered by the
first samples of their writers in the file:

1. the set of the writer that appears later moves the joints, as live the driver that started later,
2. of the sets of one writer, or of the nodes of one topic in a bag of ROS, the larger one,
3. a set that another one replaces keeps its samples of the other joints, and further ones are refused: they
   would be those of half a driver. A writer of all joints keeps those that no other set has.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import MessageError
from zstate.ingest.base import StreamIngest
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_parts import JointNames, PartialJointStateIngest, RobotParts
from zstate.ingest.joint_states import JointStateIngest
from zstate.model.joint_history import JointHistory
from zstate.model.robot import RobotModel
from zstate.recording.decode import DecodedRecording, RecordedWriter
from zstate.recording.joint_states import DELAYED_NS, JointStateBatch
from zstate.recording.model_edges import ModelEdgeFilter
from zstate.streams import JOINT_STREAMS
from zstate.wire.messages import JointState, RobotDescription, Sample

_MAX_SETS = 64
"""Sets of joints of one robot; there is one for each driver."""

_ROWS = 4096


class RecordedJoints:
    """Inserts the recorded joint states of one ``robot``, of all joints or of drivers of some."""

    def __init__(self, robot: str, ownership: FrameOwnership, model_filter: ModelEdgeFilter) -> None:
        self.whole = RecordedJointStateIngest(robot, ownership, model_filter)
        self._robot = robot
        self._ownership = ownership
        self._drivers: dict[frozenset[str], RecordedPartIngest] = {}
        self._ingests: dict[tuple[int, bytes], StreamIngest] = {}
        self._writers: dict[int, int] = {}
        self._orders: dict[StreamIngest, int] = {}
        self._replaced: set[StreamIngest] = set()
        self._counts: Counter[StreamIngest] = Counter()

    def describe(self, description: RobotDescription) -> None:
        """Use this description from now on."""
        self.whole.describe(description)
        self._ingests.clear()
        for driver in self._drivers.values():
            driver.describe(description)

    def insert(self, writer: RecordedWriter, state: JointState) -> None:
        """Insert the next joint state."""
        counters = self._ownership.counters.for_robot(self._robot)
        ingest = self._ingests.get((state.session, state.order))
        if ingest is None:
            try:
                ingest = self._ingests[state.session, state.order] = self._ingest(writer, state)
            except MessageError as error:
                counters.count_refusal(error.reason, f"{self._robot!r}: {error}")
                return
        if ingest in self._replaced:
            text = f"{self._robot!r}: {', '.join(map(repr, state.names or ()))} have a later writer"
            counters.count_refusal("second writer", text)
            return
        if writer.foreign:  # its number counts the messages of all nodes of the topic
            state = _renumbered(state, state.session, self._counts[ingest])
            self._counts[ingest] += 1
        ingest.insert_sample(state, overflowed=False)

    def _ingest(self, writer: RecordedWriter, state: JointState) -> StreamIngest:
        """The ingest of a writer's set of joints. Raises MessageError if they cannot be used."""
        model = self.whole.model
        if model is None or not model.joint_names:
            return self.whole
        names = JointNames(model).joints(state.names or (), others=writer.edge_writer is None)
        position = self._writers.setdefault(state.session, len(self._writers))
        # The later one of two writers counts, and the larger one of a writer's sets.
        order = position * (len(model.joint_names) + 1) + len(names)
        if len(names) == len(model.joint_names):
            self.whole.parts.add_writer(state.session, order)
            return self.whole
        driver = self._drivers.get(frozenset(names))
        if driver is None:
            if len(self._drivers) >= _MAX_SETS:
                text = f"more than {_MAX_SETS} sets of joints; now {', '.join(map(repr, names))}"
                raise MessageError(text, reason="too many sets of joints")
            number = -1 - len(self._drivers)  # no writer's session
            driver = RecordedPartIngest(self._robot, self._ownership, self.whole.parts, number)
            self._drivers[frozenset(names)] = driver
        name = writer.program or writer.edge_writer
        if name is not None:
            self._ownership.live[self._robot, driver.number] = name
        self.whole.parts.add_writer(driver.number, order)
        self._orders[driver] = order
        self._replaced.discard(driver)
        for joints, other in self._drivers.items():
            if joints.intersection(names) and self._orders[other] < order:
                self._replaced.add(other)
                self.whole.parts.remove_writer(other.number)
        return driver


class RecordedJointStateIngest(JointStateIngest):
    """Keeps the samples of earlier writers while stamps increase."""

    def __init__(self, robot: str, ownership: FrameOwnership, model_filter: ModelEdgeFilter) -> None:
        super().__init__(robot, ownership)
        self._filter = model_filter

    @property
    def model(self) -> RobotModel | None:
        """The model in effect."""
        return None if self._track is None else self._track.model

    def _replace_model(self, model: RobotModel) -> None:
        super()._replace_model(model)
        self._filter.set_model(self.robot, model)

    def _insert(self, sample: Sample) -> bool | None:
        is_described = self._track is not None
        if is_described and self._newest is not None and sample.stamp < self._newest - DELAYED_NS:
            return False
        return super()._insert(sample)

    def _replace_session(self, sample: Sample) -> None:
        if self._newest is not None and sample.stamp <= self._newest:
            self._drop_history()


class RecordedPartIngest(PartialJointStateIngest):
    """The same for one set of joints; ``number`` identifies it among ``parts``, for all of its writers."""

    def __init__(self, robot: str, ownership: FrameOwnership, parts: RobotParts, number: int) -> None:
        super().__init__(robot, ownership, parts, others=True)
        self.number = number

    def drop(self) -> None:
        self._parts.drop(self.number)

    def _insert(self, sample: Sample) -> bool | None:
        if self._newest is not None and sample.stamp < self._newest - DELAYED_NS:
            return False
        assert isinstance(sample, JointState)
        return super()._insert(_renumbered(sample, self.number, sample.seq))

    def _drop_history(self) -> None:
        self._parts.restart(self.number)

    def _replace_session(self, sample: Sample) -> None:
        if self._newest is not None and sample.stamp <= self._newest:
            self._drop_history()


def _renumbered(state: JointState, session: int, seq: int) -> JointState:
    numbers = state.positions, state.velocities, state.efforts
    return JointState(state.stamp, seq, session, state.order, *numbers, state.names)


def has_parts(recording: DecodedRecording, robot: str, model: RobotModel) -> bool:
    """Whether joint states of ``robot`` come in parts: the first of one of its writers lacks joints."""
    writers = {writer for writer in recording.writers if writer.robot == robot}
    if any(writer.stream == "partial_joint_states" for writer in writers):
        return True
    waiting = {writer for writer in writers if writer.stream == "joint_states"}
    names = JointNames(model)
    for undecoded in recording.records((robot,), ("joint_states",)):
        if undecoded.channel.writer not in waiting:
            continue
        for decoded in recording.decode(undecoded):
            assert isinstance(decoded.message, JointState)
            try:
                joints = names.joints(decoded.message.names or (), others=True)
            except MessageError:
                continue  # it is refused
            if len(joints) < len(model.joint_names):
                return True
            waiting.discard(decoded.writer)
        if not waiting:
            break
    return False


class MergedJointStateReader:
    """Reads the joint states of several drivers of ``robot`` as rows of all joints, from one buffer.

    Rows are those of ``TransformBuffer.joint_states``: one for each sample of a driver that all drivers
    cover. ``read_buffer`` returns a buffer with all samples, which are then in memory.
    """

    def __init__(
        self,
        recording: DecodedRecording,
        robot: str,
        model: RobotModel,
        read_buffer: Callable[[], TransformBuffer],
    ) -> None:
        self.robot = robot
        self.model = model
        """The first model of the robot in the recording."""
        self._recording = recording
        self._read_buffer = read_buffer

    @property
    def count(self) -> int:
        """The number of recorded samples of all drivers, usable or not."""
        writers = self._recording.writers.items()
        return sum(count for one, count in writers if one.robot == self.robot and one.stream in JOINT_STREAMS)

    def all(self) -> JointHistory:
        """All rows."""
        return self._read_buffer().joint_states(self.robot)

    def batches(self) -> Iterator[JointStateBatch]:
        """All rows in order of their stamps."""
        trajectory = self.all()
        for first in range(0, len(trajectory), _ROWS):
            yield JointStateBatch(trajectory.select(slice(first, first + _ROWS)), restarts=False)
