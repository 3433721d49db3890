"""Publisher of a robot's state: joint positions in, joint states and transforms on Zenoh out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

from numpy.typing import ArrayLike

from zstate._util.fork_safe import fork_safe
from zstate.clock import Clock, SystemClock, check_stamp
from zstate.errors import InvalidInput
from zstate.extension import kernel
from zstate.model.joint_forms import edge_forms
from zstate.model.joint_limits import JointLimits
from zstate.model.robot import RobotModel, coordinate_names, velocity_columns_by_position
from zstate.net.session import Session
from zstate.net.writer import SampleWriter, write_all
from zstate.nodes.lookup_service import LookupService, RecentBuffer
from zstate.nodes.moving_edges import MovingEdgesOnDemand, open_moving_edges
from zstate.nodes.publisher_status import LimitWatch, PublisherStats
from zstate.nodes.sample_publisher import SamplePublisher
from zstate.rate import RateReport
from zstate.streams import StreamName
from zstate.wire.joint_order import SampleLayout
from zstate.wire.keys import MODEL_WRITER, wire_name
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    from_block,
    order_digest,
    to_block,
)
from zstate.wire.native import decode_joint_state, encode, joint_positions

if TYPE_CHECKING:
    from zstate.sources.joint_source import JointReading, JointSource

if TYPE_CHECKING or kernel == "c":
    from zstate._kernel import JointStateEncoder, PublishPath

Positions: TypeAlias = ArrayLike | Mapping[str, float | Sequence[float]]

STREAMS: tuple[StreamName, ...] = ("joint_states", "tf", "tf_static", "robot_description")
"""The streams of a robot's state."""

_SAMPLED: tuple[StreamName, ...] = ("joint_states", "tf")


def positions_block(model: RobotModel, positions: Positions) -> bytes:
    """``positions`` as in messages. Raises InvalidInput unless they are a configuration of the robot."""
    is_named = isinstance(positions, Mapping)
    return to_block(model.positions(positions) if is_named else model.check_positions(positions))


class RobotEncoder:
    """Checks and encodes the samples that one ``session`` publishes of a model, under the name ``robot``.

    ``names`` are the moving edges (parent, child) in the order of a transform sample's poses, with the
    frame names of the wire; ``order`` is their digest.
    """

    def __init__(self, model: RobotModel, robot: str, session: int) -> None:
        self._model, self._session = model, session
        forms = edge_forms(model)
        names = [(wire_name(robot, form.parent), wire_name(robot, form.child)) for form in forms]
        fixed = [form.kind == "fixed" for form in forms]
        self.names = tuple(name for name, is_fixed in zip(names, fixed, strict=True) if not is_fixed)
        self.order = order_digest(self.names)
        self._fixed_names = tuple(name for name, is_fixed in zip(names, fixed, strict=True) if is_fixed)
        self._fixed_poses = [form.origin for form in forms if form.kind == "fixed"]
        self._joint_order = order_digest(model.joint_names)
        quaternions = tuple(form.column + 3 for form in forms if form.kind == "floating")
        counts = (model.position_count, model.velocity_count)
        self.compiled = (
            JointStateEncoder(session, self._joint_order, *counts, quaternions) if kernel == "c" else None
        )
        """The same for flat arrays of doubles, lists and tuples, in the extension."""

    def encode(
        self,
        positions: Positions,
        velocities: ArrayLike | None,
        efforts: ArrayLike | None,
        stamp: int,
        seq: int,
    ) -> bytes:
        """The payload of a JointState on the native wire.

        Raises InvalidInput unless ``positions`` are a configuration of the robot, and the others fit it.
        """
        if self.compiled is not None:
            payload = self.compiled.encode(positions, velocities, efforts, stamp, seq)
            if payload is not None:
                return payload
        model = self._model
        block = positions_block(model, positions)
        rates = None if velocities is None else to_block(model.check_velocities(velocities))
        forces = None if efforts is None else to_block(model.check_efforts(efforts))
        return encode(JointState(stamp, seq, self._session, self._joint_order, block, rates, forces))

    def statics(self) -> StaticTransforms:
        """The fixed edges of the model."""
        return StaticTransforms(self._session, self._fixed_names, to_block(self._fixed_poses))


class StatePublisher(SamplePublisher):
    """Publishes the state of one robot: each sample is the whole robot at one instant.

    Samples go out on ``joint_states``; the moving edges also on ``tf``, while that stream has a reader.
    The model (``robot_description``) and its fixed edges (``tf_static``) are latched, so that listeners
    receive them whenever they join. Transforms are computed by Pinocchio, whose model is built on opening and
    compared with zstate's closed forms; these serve, with a warning, if Pinocchio cannot be loaded
    (``stats.kinematics``). Without the stream ``tf`` it is not loaded.

    - ``robot``: the name on the network; default: the model's name.
    - ``wires``: what it publishes on, "native", "ros2" with options, or several.
    - ``streams``: what this publisher writes, if another program writes the rest.
    - ``clock``: gives the stamps of samples without one, and its domain is that of the robot; default: the
      system's. A ``SimulatedClock`` for robots of a simulation.
    - ``program``: the writer's name for others; default: the script's name.
    - ``takeover``: publish even if another writer is active; listeners use the newest writer.
    - ``cache_s``: the last seconds of samples that joining listeners of the native wire receive
      (``zstate.net.sample_history``); 0 for none.
    - ``pinocchio_on_demand``: load Pinocchio with the first reader of ``tf``, in a thread; the closed forms
      serve until it is loaded. Saves 48 MB and 0.1 s at the start, for a process without a control loop: the
      interpreter pauses for up to 20 ms then.

    Raises SecondWriter, which names the first writer, if another writer of one of its streams is active on
    the native wire. If two open at once, ``publish`` of the later one raises it and closes that publisher.
    Neither with ``takeover``. Raises ModelError, which names the joint, if Pinocchio and the closed forms
    differ.

    On the native wire it publishes its status once a second while that has a reader (``zstate.net.status``),
    and answers lookups of its own frames on ``zstate/<robot>/lookup`` from the cache, or from the newest
    sample without one (``zstate.nodes.lookup_service``). A context manager; safe from any thread.
    """

    def __init__(
        self,
        session: Session,
        model: RobotModel,
        robot: str | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        streams: Sequence[StreamName] = STREAMS,
        clock: Clock | None = None,
        program: str = "",
        takeover: bool = False,
        cache_s: float = 2.0,
        pinocchio_on_demand: bool = False,
    ) -> None:
        super().__init__(session, robot or model.name, wires, clock, program)
        self.model = model
        self._session = session
        self._publish_path: PublishPath | None = None
        out = self._out
        self._encoder = RobotEncoder(model, self.robot, out.session_id)
        for stream in streams:
            if stream not in STREAMS:
                raise InvalidInput(f"{stream!r} is not one of the streams {', '.join(map(repr, STREAMS))}")
        open_edges = MovingEdgesOnDemand if pinocchio_on_demand else open_moving_edges
        self._edges = open_edges(model) if "tf" in streams and out.wires else None
        limits = JointLimits(model)
        self._limits = LimitWatch(limits, self.robot, joint_positions) if limits and out.wires else None
        sample_names = SampleLayout(
            coordinate_names(model), velocity_columns_by_position(model), self._encoder.names
        )
        # ROS topics may have several writers, so ownership is checked on the native wire only.
        claimed = [
            out.announcement(stream, MODEL_WRITER if stream == "tf_static" else "") for stream in streams
        ]
        with out.opening():
            out.own([] if takeover else claimed)
            for wire, wire_writer in out.open_wires(sample_names).items():
                with wire_writer.announced_together():
                    if "robot_description" in streams:
                        description = wire_writer.open_latched("robot_description", MODEL_WRITER)
                        write_all([description], self.description())
                    if "tf_static" in streams:
                        write_all([wire_writer.open_latched("tf_static", MODEL_WRITER)], self.statics())
                    for stream in _SAMPLED:
                        if stream in streams:
                            out.open_stream(wire, stream)
            self._native = out.streams.get(("native", "joint_states"))
            joints = [one for (_, stream), one in out.streams.items() if stream == "joint_states"]
            self._ros_joints = [one for one in joints if one is not self._native]
            self._transforms = [one for (_, stream), one in out.streams.items() if stream == "tf"]
            if out.streams:
                out.report_status(lambda: self.stats)
            self._open_cache(cache_s)
            self._publish_path = self._open_path(joints)
            out.opened.callback(self._stop_path)

    def __repr__(self) -> str:
        wires, closed = ", ".join(self._out.wires), ", closed" if self._out.is_closed else ""
        return f"<StatePublisher of {self.robot!r} on {wires}: {self._sent} samples{closed}>"

    def _open_path(self, joints: Sequence[SampleWriter]) -> PublishPath | None:
        """The extension's publisher of usual samples; None without the extension, or with several wires."""
        out, encoder = self._out, self._encoder.compiled
        if encoder is None or len(joints) != 1:
            return None
        ros = joints[0].encoder.compile_joint_states()
        if ros is None and self._native is None:
            return None
        path = PublishPath(
            encoder,
            ros,
            None if out.cache is None else out.cache.ring,
            joints[0].zenoh_put,
            *JointLimits(self.model).bounds(self.model.position_count),
            None if self._limits is None else self._limits.add_outside,
            type(self._clock) is SystemClock,
        )
        joints[0].publish_path = path
        if out.claim is not None:
            out.claim.on_change = path.pause
        for writer in self._transforms:
            writer.on_readers = path.pause
        fork_safe(self)
        return path

    def _at_fork_reinit(self) -> None:
        self._publish_path = None  # another thread may have been in it, and the session is closed here

    def _open_cache(self, cache_s: float) -> None:
        """Open the cache, and what is answered from it."""
        out, model = self._out, self.model
        out.open_cache(cache_s, model.position_count + 2 * model.velocity_count)
        self.cache = out.cache if cache_s else None
        if self.cache is not None and self._native is not None:
            out.serve_history("joint_states")
        if self.cache is not None and (transforms := out.streams.get(("native", "tf"))):

            def convert(payload: bytes) -> bytes:
                return transforms.encoder.encode(self._transform_sample(decode_joint_state(payload)))

            out.serve_history("tf", convert=convert)
        if out.cache is not None and out.streams:
            recent = RecentBuffer(model, self.robot, out.cache)
            out.opened.enter_context(LookupService(self._session, recent.buffer, self.robot))

    def description(self) -> RobotDescription:
        """The robot's model and conventions, latched for listeners."""
        model, names, domain = self.model, self._encoder.names, self._clock.domain
        return RobotDescription(
            self._out.session_id, model.urdf, model.digest, model.joint_names, names, domain
        )

    def statics(self) -> StaticTransforms:
        """The robot's fixed edges, latched for listeners without its model."""
        return self._encoder.statics()

    @property
    def stats(self) -> PublisherStats:
        """Counts of published, suppressed and refused samples, and what computes transforms."""
        engine = "" if self._edges is None else self._edges.engine.name
        return replace(super().stats, kinematics=engine)

    def publish(
        self,
        positions: Positions,
        velocities: ArrayLike | None = None,
        efforts: ArrayLike | None = None,
        stamp: int | None = None,
    ) -> None:
        """Publish one sample: the robot at ``stamp`` [ns]; default: now.

        ``positions`` [rad] or [m] are in the order of ``model.joint_names``, or a mapping from all joint
        names; ``velocities`` per second and ``efforts`` [Nm] or [N], if known, are in the same order.
        Positions outside joint limits are published, counted in ``stats``, and logged once. Raises
        InvalidInput for wrong counts, unknown or missing names, NaN and infinity, a floating joint without
        a unit quaternion, and a stamp that a wire cannot represent; SecondWriter; and Closed. If it raises,
        nothing was sent.
        """
        path = self._publish_path
        if (
            path is not None
            and self._session.is_usable
            and path.publish(positions, velocities, efforts, stamp)
        ):
            return
        out = self._out
        with self._refusals:
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            with out.lock:
                out.check()
                out.seq = self._stop_path()
                # Encode for all wires before sending on any: a wire may be unable to represent the stamp.
                payload = self._encoder.encode(positions, velocities, efforts, stamp, out.seq)
                payloads = [] if self._native is None else [(self._native, payload)]
                readable = [writer for writer in self._transforms if writer.has_readers]
                if readable or self._ros_joints:
                    payloads += self._encode_derived(payload, readable)
                out.write(stamp, payload, payloads)
                if not readable:
                    self._resume_path()
        if self._limits is not None:
            self._limits.add(stamp, payload)

    def _stop_path(self) -> int:
        """Wait for the end of a call of the path in another thread. Returns the next sequence number."""
        return self._out.seq if self._publish_path is None else max(self._out.seq, self._publish_path.stop())

    def _resume_path(self) -> None:
        """Publish the next samples in one call each, while joint states are all that is sent."""
        if self._publish_path is None:
            return
        self._publish_path.resume(self._out.seq)
        # Checked after that: what changes now pauses the path.
        is_alone = False
        try:
            claim = self._out.claim
            is_owner = claim is None or claim.is_settled
            is_alone = is_owner and not any(writer.has_readers for writer in self._transforms)
        finally:
            if not is_alone:
                self._publish_path.pause()

    @property
    def _sent(self) -> int:
        return self._out.seq if self._publish_path is None else max(self._out.seq, self._publish_path.seq)

    def _encode_derived(
        self, payload: bytes, readable: Sequence[SampleWriter]
    ) -> list[tuple[SampleWriter, bytes]]:
        """The joint state in ``payload`` for the ROS wires, and its transforms for ``readable`` streams."""
        state = decode_joint_state(payload)
        payloads = [(writer, writer.encoder.encode(state)) for writer in self._ros_joints]
        if readable:
            sample = self._transform_sample(state)
            payloads += [(writer, writer.encoder.encode(sample)) for writer in readable]
        return payloads

    def _transform_sample(self, state: JointState) -> TransformSample:
        """The pose of each moving edge, ``parent_from_child``, in ``state``."""
        assert self._edges is not None, "the stream tf is published"
        poses = to_block(self._edges.poses(from_block(state.positions)))
        return TransformSample(state.stamp, state.seq, state.session, self._encoder.order, poses)

    def run(self, source: JointSource, rate_hz: float = 100.0, *, seconds: float | None = None) -> RateReport:
        """Publish the readings of ``source`` at exactly ``rate_hz``, for ``seconds`` or until ``close()``.

        Each tick has an absolute deadline: a late one does not delay the next. After a delay of more than
        0.1 s, ticks in the past are skipped and counted. If the source has no new reading, the tick
        publishes nothing. Raises SecondWriter.
        """

        def publish(reading: JointReading, now: int) -> None:
            stamp = now if reading.stamp is None else reading.stamp
            self.publish(reading.positions, reading.velocities, reading.efforts, stamp)

        return self._publish_at(rate_hz, seconds, source.read, publish)
