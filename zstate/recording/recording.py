"""Recording: lookups in a recorded file, which is loaded into a transform buffer.

For a single writer this gives the same buffer as listening live. A listener drops the history of a writer
that is replaced; a recording keeps it:

==========================================  ============================================================
the recording holds                         the buffer gets
==========================================  ============================================================
a writer ends, a new one continues later    one history, interpolated between the two as elsewhere
a new writer with an earlier clock          a new history, which begins with this writer
two samples in a row more than 0.1 s back   a new history: the clock was set back
drivers of some joints each                 a history for each set of joints, by the same rules; of two with a
                                            joint in common the one that appears later moves their joints
another model (URDF) of a robot             a new history of the robot
a withdrawn static edge                     the edge, until another writer places the frame
==========================================  ============================================================
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.buffer.buffer import RECORDING_HISTORY_S, TransformBuffer, feed_of
from zstate.checks import Points, check_points
from zstate.clock import check_stamps, check_stamps_of_points
from zstate.errors import InvalidInput
from zstate.ingest.base import StreamIngest
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.transforms import StaticTransformIngest
from zstate.model.joint_history import JointHistory
from zstate.model.robot import RobotModel
from zstate.recording.decode import (
    STREAMS,
    DecodedMessage,
    DecodedRecording,
    LatchedState,
    RecordedWriter,
    check_has_robot,
    first_descriptions,
    further_streams,
    recorded_model,
    robot_with_joint_states,
)
from zstate.recording.info import RecordingInfo, read_info
from zstate.recording.joint_parts import MergedJointStateReader, RecordedJoints, has_parts
from zstate.recording.joint_states import RecordedJointReader
from zstate.recording.model_edges import ModelEdgeFilter
from zstate.recording.reader import RecordingReader
from zstate.recording.transforms import EdgeEpochs, RecordedTransformIngest, children_of
from zstate.stream_registry import stream_named
from zstate.streams import JOINT_STREAMS, StreamName
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.messages import (
    Edges,
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
)

if TYPE_CHECKING:
    from zstate.driving.messages import DriverState, JointCommand, Stop
    from zstate.odometry.messages import (
        Fix,
        Imu,
        MagneticField,
        Odometry,
        Pose,
        Pressure,
        SensorMessage,
        Velocity,
    )
    from zstate.scans.grid import Grid
    from zstate.scans.messages import LaserScan, OccupancyGrid
    from zstate.scans.scan import Scan

# The buffer drops unneeded samples after every so many messages, at least.
_BATCH = 4096
_UNNAMED = "a ROS node"


class Recording(Closeable):
    """A recorded MCAP file or bag, restricted to ``robot`` if one is given.

    ``robots`` are the names of the robots in it, ``info`` describes the file. Raises RecordingError if it
    cannot be read, and InvalidInput if it has no ``robot``. A context manager. Copies and pickles open the
    file again, by the same path.
    """

    def __init__(self, path: str | Path, robot: str | None = None) -> None:
        self.info: RecordingInfo = read_info(path)
        self.robot = robot
        self._reader = RecordingReader(path)
        recording = DecodedRecording(self._reader, Refusals().count)
        self.robots = recording.robots
        try:
            if robot is not None:
                check_has_robot(recording, robot)
        except BaseException:
            self.close()
            raise

    def __repr__(self) -> str:
        robots = ", ".join(map(repr, self.robots)) or "none"
        return f"<Recording {str(self.info.path)!r}: {self.info.duration_s:g} s, robots {robots}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return Recording, (self.info.path, self.robot)

    def joint_states(self, robot: str | None = None) -> JointHistory:
        """All joint states of ``robot``, by default of the only one: those of its last history.

        Of samples with one stamp the later one counts. Samples without a finite position of every joint
        are left out; the first of each reason is logged. If drivers published some of the joints each, the
        rows are those of ``TransformBuffer.joint_states``, without efforts. Raises InvalidInput for another
        robot, and without ``robot`` if several have joint states.
        """
        return self.joint_state_reader(robot).all()

    def joint_state_reader(
        self, robot: str | None = None, refuse: Callable[[str, str], None] | None = None
    ) -> RecordedJointReader | MergedJointStateReader:
        """Reader of ``joint_states(robot)`` in parts, for a recording that does not fit into memory.

        ``refuse(reason, text)`` is called for each sample left out; by default the first of each reason is
        logged.
        """
        refuse = refuse or Refusals("recorded joint_states").count
        decoded = DecodedRecording(self._reader, refuse)
        robot = robot_with_joint_states(decoded, robot or self.robot, JOINT_STREAMS)
        reader = RecordedJointReader(decoded, robot, refuse)
        if reader.model is None or not has_parts(decoded, robot, reader.model):
            return reader
        return MergedJointStateReader(
            decoded, robot, reader.model, partial(self._buffer_of_joints, robot, refuse)
        )

    def _buffer_of_joints(self, robot: str, refuse: Callable[[str, str], None]) -> TransformBuffer:
        """A buffer with the model and all joint states of ``robot`` alone."""
        buffer, counters = TransformBuffer(RECORDING_HISTORY_S), Counters()
        for _ in self._fill(buffer, counters, (robot,), (*JOINT_STREAMS, "robot_description")):
            pass
        texts = counters.refusals()
        for reason, count in counters.stats().refused.items():
            for _ in range(count):
                refuse(reason, texts[reason])
        return buffer

    def buffer(self, around: ArrayLike | None = None) -> TransformBuffer:
        """A buffer with all of the recording, or with all of ``robot``.

        With ``around``, stamps [ns] in any order, only with the samples that lookups there need: memory
        grows with their number, not with the recording. Reads the recording once from beginning to end.
        """
        stamps = None if around is None else np.unique(check_stamps(around))
        buffer = TransformBuffer(RECORDING_HISTORY_S)
        batch = _BATCH if stamps is None else max(_BATCH, len(stamps))
        for count, _ in enumerate(self.fill(buffer), 1):
            if stamps is not None and not count % batch:
                buffer.keep_only_around(stamps)
        return buffer

    def fill(
        self, buffer: TransformBuffer, streams: Collection[StreamName] = STREAMS
    ) -> Iterator[DecodedMessage]:
        """Insert all of the recording into an empty ``buffer``; each message is returned when it is in.

        Scans, maps, IMUs and so on, which no buffer has, are returned if they are among ``streams``.
        """
        return self._fill(buffer, Counters(), None if self.robot is None else (self.robot,), streams)

    def _fill(
        self,
        buffer: TransformBuffer,
        counters: Counters,
        robots: Collection[str] | None,
        streams: Collection[StreamName],
    ) -> Iterator[DecodedMessage]:
        recording = DecodedRecording(self._reader, counters.count_refusal)
        loader = RecordingLoader.of(recording, buffer, counters, robots)
        for decoded in recording.messages(robots, streams):
            loader.insert(decoded)
            yield decoded

    def lookup_many(
        self, target: str, source: str, stamps: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """``buffer(around=stamps).lookup_many``: pose7 at each stamp, (T, 7), and which are valid, (T,).

        Raises UnknownFrame, AmbiguousFrame and Disconnected.
        """
        return self.buffer(stamps).lookup_many(target, source, stamps)

    def place(
        self, points: ArrayLike, stamps: ArrayLike, source: str, target: str
    ) -> tuple[Points, NDArray[np.bool_]]:
        """``buffer(around=stamps).place(points, stamps, source, target)``: (N, 3), and which are valid, (N,).

        Reads the file in each call; place many scans by one ``buffer()``.
        Raises UnknownFrame, AmbiguousFrame and Disconnected, and InvalidInput as the buffer does.
        """
        instants = check_stamps_of_points(stamps, len(check_points(points)))
        return self.buffer(instants).place(points, stamps, source, target)

    def scans(self, robot: str | None = None, sensor: str | None = None) -> Iterator[Scan]:
        """The scans of ``robot``, by default of all robots, or of one ``sensor``, in the order of recording.

        They are read one after the other, and their frames have full names. Place many of them by one
        ``buffer()``: ``Recording.place`` reads the file in each call. Messages that are no scan are left
        out; the first of each reason is logged. Raises InvalidInput for a robot that is not in the recording.
        """
        from zstate.scans.scan import scan_from_message  # noqa: PLC0415 - scans are a plugin

        refusals = Refusals("recorded scans")
        for writer, message, _ in self._messages(robot, "scan", refusals.count):
            if sensor in (None, writer.edge_writer):
                try:
                    yield scan_from_message(cast("LaserScan", message), writer.robot)
                except InvalidInput as error:
                    refusals.count("malformed", f"{writer.edge_writer!r} of {writer.robot!r}: {error}")

    def imu(self, robot: str | None = None, sensor: str | None = None) -> Iterator[Imu]:
        """The readings of the IMUs of ``robot``, by default of all robots, or of one ``sensor``.

        They are in the order of recording and read one after the other; their frames have full names.
        Messages that cannot be used are left out; the first of each reason is logged. Raises InvalidInput
        for a robot that is not in the recording.
        """
        return self.sensor_messages("imu", robot, sensor)

    def velocities(self, robot: str | None = None, sensor: str | None = None) -> Iterator[Velocity]:
        """The measured velocities of ``robot``, likewise."""
        return self.sensor_messages("velocity", robot, sensor)

    def poses(self, robot: str | None = None, sensor: str | None = None) -> Iterator[Pose]:
        """The measured poses of ``robot``, likewise. The child is empty for its base, as in ROS."""
        return self.sensor_messages("pose", robot, sensor)

    def fixes(self, robot: str | None = None, sensor: str | None = None) -> Iterator[Fix]:
        """The fixes of the satellite receivers of ``robot``, likewise, also those without a position."""
        return self.sensor_messages("fix", robot, sensor)

    def pressures(self, robot: str | None = None, sensor: str | None = None) -> Iterator[Pressure]:
        """The readings of the barometers of ``robot``, likewise."""
        return self.sensor_messages("pressure", robot, sensor)

    def magnetic_fields(self, robot: str | None = None, sensor: str | None = None) -> Iterator[MagneticField]:
        """The magnetic fields at the sensors of ``robot``, likewise."""
        return self.sensor_messages("magnetic_field", robot, sensor)

    def odometry(self, robot: str | None = None, writer: str | None = None) -> Iterator[Odometry]:
        """The odometry of ``robot``, by default of all robots, or of one ``writer``, likewise.

        Its frames are named as in the message.
        """
        refusals = Refusals("recorded odometry")
        for recorded, message, _ in self._messages(robot, "odometry", refusals.count):
            if writer in (None, recorded.edge_writer):
                yield cast("Odometry", message)

    def sensor_messages(
        self, stream: StreamName, robot: str | None = None, sensor: str | None = None
    ) -> Iterator[Any]:
        """The messages of ``stream``, one of those that ``SensorListener`` takes, as those of ``imu``."""
        from zstate.odometry.messages import with_full_names  # noqa: PLC0415 - odometry is a plugin

        refusals = Refusals(f"recorded {stream}")
        for writer, message, _ in self._messages(robot, stream, refusals.count):
            if sensor in (None, writer.edge_writer):
                try:
                    yield with_full_names(cast("SensorMessage", message), writer.robot)
                except InvalidInput as error:
                    refusals.count("malformed", f"{writer.edge_writer!r} of {writer.robot!r}: {error}")

    def maps(self, robot: str | None = None) -> Iterator[Grid]:
        """The maps of ``robot``, by default of all robots, in the order of recording, each when it changes.

        They are read one after the other, and their frames have full names. Messages that are no map are
        left out; the first of each reason is logged. Raises InvalidInput for a robot that is not in the
        recording.
        """
        from zstate.scans.grid import grid_from_message  # noqa: PLC0415 - scans are a plugin

        refusals = Refusals("recorded maps")
        latched = LatchedState()
        for decoded in self._messages(robot, "map", refusals.count):
            writer, message, _ = decoded
            # Repeated for readers that start in the middle; without cells when it was withdrawn.
            grid = cast("OccupancyGrid", message)
            if latched.update(decoded) and grid.cells:
                try:
                    yield grid_from_message(grid, writer.robot)
                except InvalidInput as error:
                    refusals.count("malformed", f"{writer.edge_writer!r} of {writer.robot!r}: {error}")

    def commands(self, robot: str | None = None) -> Iterator[JointCommand]:
        """The commands that were sent to the driver of ``robot``, by default of all robots, one by one.

        Each has the ``names`` of its joints, their numbers in blocks (``from_block``), and its ``ttl``. They
        are all that arrived at the recorder, also those that the driver has refused. Raises InvalidInput for
        a robot that is not in the recording.
        """
        for _, message, _ in self._messages(
            robot, "joint_commands", Refusals("recorded joint_commands").count
        ):
            yield cast("JointCommand", message)

    def driver_states(self, robot: str | None = None) -> Iterator[DriverState]:
        """The states of the driver of ``robot``, by default of all robots, one by one.

        A driver publishes its state at each change and ten times a second: with the commander, the motion
        under way and the outcomes of the last ones, the stops that it obeys and why, and the commands that
        it has refused. Raises InvalidInput for a robot that is not in the recording.
        """
        for _, message, _ in self._messages(robot, "driver", Refusals("recorded states of drivers").count):
            yield cast("DriverState", message)

    def stops(self, robot: str | None = None) -> Iterator[tuple[str, Stop]]:
        """The stops sent to the driver of ``robot``, by default of all robots, each after its program.

        They are all that arrived at the recorder while it ran, whether or not a driver has obeyed them: that
        is in ``driver_states``, and so are releases. Raises InvalidInput for a robot that is not in the
        recording.
        """
        for writer, message, _ in self._messages(robot, "stop", Refusals("recorded stops").count):
            yield writer.program or "", cast("Stop", message)

    def measurements(
        self,
        stream: str,
        robot: str | None = None,
        *,
        refuse: Callable[[str, str], None] | None = None,
    ) -> Iterator[DecodedMessage]:
        """The messages of ``stream``, one of a plugin, of ``robot``, by default of all robots.

        They are of its class (``Stream.type``), in the order of recording, read one after the other; each
        has its writer and the time of its recording [ns]. Messages that cannot be decoded are left out:
        ``refuse(reason, text)`` is called for each, by default the first of each reason is logged. Raises
        InvalidInput for a stream that no plugin brings, and for a robot that is not in the recording.
        """
        if stream_named(stream).name not in further_streams():
            known = ", ".join(further_streams())
            raise InvalidInput(f"{stream!r} is no stream of measurements, maps or odometry: {known}")
        return self._messages(robot, stream, refuse or Refusals(f"recorded {stream}").count)

    def _messages(
        self, robot: str | None, stream: StreamName, refuse: Callable[[str, str], None]
    ) -> Iterator[DecodedMessage]:
        recording = DecodedRecording(self._reader, refuse)
        robot = robot or self.robot
        robots = None if robot is None else (check_has_robot(recording, robot),)
        return recording.messages(robots, (stream,))

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        self._reader.close()


class RecordingLoader:
    """Inserts recorded messages into ``buffer``, in the order of the recording.

    Frames of ``robots`` are owned as in a listener, see ``FrameOwnership``; without any, all writers share
    all frames.
    """

    def __init__(self, buffer: TransformBuffer, counters: Counters, robots: Collection[str]) -> None:
        self._counters = counters
        self._ownership = FrameOwnership(buffer, counters, is_shared=not robots)
        for robot in robots:
            self._ownership.add_robot(robot)
        self._joints: dict[str, RecordedJoints] = {}
        self._transforms: dict[tuple[str, int], RecordedTransformIngest] = {}
        self._statics: dict[tuple[str, str | int], StaticTransformIngest] = {}
        self._static_messages: dict[tuple[str, str | int], StaticTransforms] = {}
        self._withdrawn: set[str] = set()
        self._named: set[RecordedWriter] = set()
        self._filter = ModelEdgeFilter()
        self._epochs = EdgeEpochs()

    @classmethod
    def of(
        cls,
        recording: DecodedRecording,
        buffer: TransformBuffer,
        counters: Counters,
        robots: Collection[str] | None,
    ) -> RecordingLoader:
        """A loader into an empty ``buffer``, with the first models of ``robots`` (None: of all)."""
        feed_of(buffer).set_recording()
        shares_frames = any(
            writer.foreign or (writer.stream == "tf_static" and writer.edge_writer is None)  # of ROS
            for writer in recording.writers
        )
        loader = cls(buffer, counters, () if shares_frames else recording.robots)
        for description in first_descriptions(recording, robots).values():
            model = recorded_model(recording, description, counters.count_refusal)
            if model is not None:
                loader.add_model(description, model)
        return loader

    def add_model(self, description: DecodedMessage, model: RobotModel) -> None:
        """Insert the joint states of a robot with this ``model``. Call it before the first ``insert``."""
        robot = description.writer.robot
        self._filter.set_model(robot, model)
        self._joints[robot] = RecordedJoints(robot, self._ownership, self._filter)
        self.insert(description)

    def leaves_out(self, robot: str, edges: Edges) -> bool:
        """Whether models define all of the moving ``edges`` of ``robot``, and no sample of them counts."""
        return bool(edges) and self._filter.removes_all(robot, edges)

    def insert(self, decoded: DecodedMessage) -> None:
        """Insert the next message."""
        writer, message, _ = decoded
        if isinstance(message, JointState):
            joints = self._joints.get(writer.robot)
            if joints is None:
                text = f"{writer.robot!r}: no robot_description fits its joint states"
                self._counters.count_refusal("no description", text)
            else:
                self._set_name(joints.whole, writer)
                joints.insert(writer, message)
        elif isinstance(message, TransformSample) and writer.stream in ("tf", "transforms"):
            self._insert_transforms(writer, message)
        elif isinstance(message, StaticTransforms):
            self._insert_statics(writer, message)
        elif isinstance(message, RobotDescription) and writer.robot in self._joints:
            self._set_name(self._joints[writer.robot].whole, writer)
            self._joints[writer.robot].describe(message)

    def _insert_transforms(self, writer: RecordedWriter, sample: TransformSample) -> None:
        rest = self._filter.filter_sample(writer.robot, sample)
        if rest is None or rest.edges is None:
            return
        self._remove_withdrawn(writer.robot, rest.edges)
        key = writer.robot, writer.session
        ingest = self._transforms.get(key)
        if ingest is None:
            ingest = RecordedTransformIngest(writer.robot, self._ownership, self._epochs)
            self._transforms[key] = ingest
        self._set_name(ingest, writer)
        ingest.insert_sample(rest, overflowed=False)

    def _insert_statics(self, writer: RecordedWriter, statics: StaticTransforms) -> None:
        robot, edge_writer = writer.robot, writer.edge_writer
        if edge_writer == MODEL_WRITER and robot in self._joints:
            return  # the model has the same edges
        key = robot, writer.session if edge_writer is None else edge_writer
        before = self._static_messages.get(key)
        if before is not None and (before.edges, before.poses) == (statics.edges, statics.poses):
            return  # repeated for readers that start in the middle
        self._static_messages[key] = statics
        rest = self._filter.filter_statics(robot, statics)
        self._remove_withdrawn(robot, rest.edges)
        if before is not None and edge_writer is not None:
            self._withdrawn |= children_of(robot, before.edges) - children_of(robot, statics.edges)
        name = edge_writer or writer.program or _UNNAMED
        ingest = StaticTransformIngest(robot, name, self._ownership)
        self._statics.setdefault(key, ingest).add(rest)

    def _set_name(self, ingest: StreamIngest, writer: RecordedWriter) -> None:
        if writer not in self._named and writer.program is not None:
            ingest.name_writer(writer.session, writer.program)
            self._named.add(writer)

    def _remove_withdrawn(self, robot: str, edges: Edges) -> None:
        """Remove withdrawn edges whose child is placed again."""
        if self._withdrawn:
            for child in self._withdrawn & children_of(robot, edges):
                self._withdrawn.discard(child)
                self._ownership.remove_child(child)
