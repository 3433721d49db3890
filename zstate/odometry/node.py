"""From the streams of a robot to its odometry: SensorListener, and OdometryNode.

``add_joints`` also serves recordings; ``sensors.py`` has the functions for messages of sensors.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe
from zstate._util.format import did_you_mean, format_duration
from zstate._util.refusals import Refusals
from zstate.checks import Floats
from zstate.clock import SYSTEM, Clock
from zstate.errors import Closed, InPast, InvalidInput, NoData, SecondWriter
from zstate.model.robot import POSITION_COUNTS, RobotModel
from zstate.net.latched import cached_values
from zstate.net.presence import announce_reader
from zstate.net.queryable import Reply
from zstate.net.request_queryable import ExactQueryable
from zstate.net.session import Session
from zstate.net.subscription import Received, decode_samples, subscribe
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry.estimator import BaseEstimator, BaseState
from zstate.odometry.health import SourceHealth
from zstate.odometry.map_estimator import MapEstimator
from zstate.odometry.messages import Imu, MapDatum, SensorMessage, with_full_names
from zstate.odometry.planar import in_plane, map_in_plane
from zstate.odometry.publishers import DatumPublisher, OdometryPublisher, PosePublisher
from zstate.odometry.requests import apply_request
from zstate.odometry.sensors import SENSOR_STREAMS, Estimators, Sensor, add_imu, sensor
from zstate.odometry.source_noise import SensorNoise
from zstate.sources import JointReading, JointStateListener
from zstate.streams import StreamName
from zstate.transform import Transform
from zstate.wire.keys import ANY, ODOMETRY_REQUEST, check_robot, frame_owner, full_name, shortened
from zstate.wire.registry import get_wire

_SILENT_NS = 100_000_000
"""After this time without its IMU, a node publishes at the stamps of other sources."""

_AHEAD_NS = 500_000_000
"""Clocks of one robot differ by less, and the way of a reading takes more than none."""

MAP_WRITER = "map"
"""The name under which map -> odom, the pose in the map and its datum are published."""

_CACHED_WITHIN_S = 2.0
"""A node waits so long for the datums that other robots have published."""

_LONG_AGO = -(2**63)

_LOG = logging.getLogger("zstate")

_LOGGED_NS = 60_000_000_000
"""A sentence of each source is logged once in this time."""

_HEALTH_NS = 500_000_000
"""The interval at which the health of the sources is assessed, by stamps."""


def add_joints(base: BaseEstimator, model: RobotModel, reading: JointReading) -> None:
    """Pass the joints of ``model`` that have one position each to ``base``, with what is known of them."""
    assert reading.stamp is not None
    names = [joint.name for joint in model.driven_joints if POSITION_COUNTS[joint.type] == 1]
    base.joints(
        reading.stamp,
        _by_name(names, model.columns, reading.positions),
        velocities=_by_name_if_known(names, model.velocity_columns, reading.velocities),
        efforts=_by_name_if_known(names, model.velocity_columns, reading.efforts),
    )


def _by_name(names: Sequence[str], columns: Mapping[str, int], vector: Floats) -> dict[str, float]:
    values = vector.tolist()
    return {name: values[columns[name]] for name in names}


def _by_name_if_known(
    names: Sequence[str], columns: Mapping[str, int], vector: Floats | None
) -> dict[str, float] | None:
    return None if vector is None else _by_name(names, columns, vector)


class SensorListener(Closeable):
    """Calls ``callbacks[stream](sensor, message)`` for each message of the sensors of a robot, as of "imu".

    The arguments are the sensor's name and the message, whose frames have their full names; the child of a
    pose is empty for the base of the robot. Each callback has a thread of its own, and gets the messages in
    the order of their arrival; a stream without a callback is not subscribed. If a callback is slow, the
    oldest messages are lost. ``refused`` counts, by reason, messages that cannot be used, those that a
    callback refuses by raising InvalidInput, and its other exceptions, which do not end the thread; the first
    of each reason is also logged. Raises InvalidInput for other streams. A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        callbacks: Mapping[StreamName, Callable[[str, Any], object]],
        *,
        wire: str = "native",
    ) -> None:
        self.robot = check_robot(robot)
        self._wire = get_wire(wire)
        self._refusals = Refusals("measurement")
        self.refused: dict[str, int] = self._refusals.counts
        if unknown := [stream for stream in callbacks if stream not in SENSOR_STREAMS]:
            known = ", ".join(SENSOR_STREAMS)
            raise InvalidInput(
                f"{unknown[0]!r} is no stream of sensors: {known}{did_you_mean(unknown[0], SENSOR_STREAMS)}"
            )
        with ExitStack() as opening:
            for stream, callback in callbacks.items():
                on_messages = partial(self._on_messages, callback)
                on_error = self._refusals.count
                opening.enter_context(
                    subscribe(session, self._wire, robot, stream, on_messages, on_error=on_error)
                )
            for announcement in announce_reader(session, self._wire, robot, tuple(callbacks)):
                opening.enter_context(announcement)
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        return f"<SensorListener of {self.robot!r}>"

    def _on_messages(self, callback: Callable[[str, Any], object], received: list[Received]) -> None:
        for robot, key, message in received:
            try:
                callback(self._wire.edge_writer_name(key) or "", with_full_names(message, robot))  # pyright: ignore[reportArgumentType] - of a stream of sensors
            except InvalidInput as error:
                self._refusals.count("refused", f"{shortened(key)}: {error}")
            except Exception as error:  # the next message may be good
                self._refusals.count(*_failure(error, shortened(key)))

    def close(self) -> None:
        """Stop listening. A second call does nothing."""
        self._opened.close()


def _failure(error: Exception, place: str) -> tuple[str, str]:
    """The reason and the text of an exception that no message should cause."""
    kind = type(error).__name__
    return f"failed with {kind}", f"{place}: {kind}: {error}"


class _MapPublishers(NamedTuple):
    """Publishers of map -> odom, of the pose of the base in the map, and of its datum."""

    edge: TransformPublisher
    pose: PosePublisher
    datum: DatumPublisher

    @classmethod
    def open(
        cls, opening: ExitStack, session: Session, robot: str, map: str, *, wires: Sequence[str], program: str
    ) -> _MapPublishers:
        """Open them in ``opening``. Raises SecondWriter. ROS has no form for a datum."""
        return cls(
            opening.enter_context(TransformPublisher(session, robot, MAP_WRITER, wires, program=program)),
            opening.enter_context(PosePublisher(session, robot, MAP_WRITER, wires, program=program)),
            opening.enter_context(DatumPublisher(session, robot, map, writer=MAP_WRITER, program=program)),
        )


def _check_sensors(sensors: Sequence[Sensor], wire: str, writer: str, *, has_map: bool) -> None:
    """Raise InvalidInput for a sensor that is there twice, or is published by this odometry itself."""
    own = {("odometry", writer), *([("pose", MAP_WRITER)] if has_map else ())}
    for place, one in enumerate(sensors):
        if (one.stream, one.writer) in own:
            raise InvalidInput(
                f"the {one.stream} {one.writer!r} is no source of itself; name one of the two otherwise"
            )
        if any((one.kind, one.name) == (other.kind, other.name) for other in sensors[:place]):
            raise InvalidInput(f"the {one.kind.name} {one.name!r} is given twice; state its noise once")
        one.check_live(wire)


class OdometryNode(Closeable):
    """Feeds ``base`` with the sensors of ``robot``, and publishes its odometry as ``writer``.

    ``program`` is the writer's name for others, by default the script's name.

    ``base`` gets the readings of the IMU ``imu`` and of the further ``sensors``, each by its name and with
    what is stated of its noise, whose class tells the kind: ``[("wheels", VelocityNoise(sigma=0.05))]``; and
    with ``has_joints`` the joint states, from the threads of their subscriptions.
    Each reading of the IMU publishes the state at its stamp, at most ``rate_hz`` of them a second. If the IMU
    is silent for 0.1 s, readings of the other sources do; if all are silent, nothing is published. The
    sentences of ``base.health()`` are the warning in the status of the writer.

    ``in_map`` gets the fixes of satellite receivers, and has ``base`` as its odometry. As soon as it
    knows the pose in the map, the writer ``map`` publishes map -> odom at the stamps of the odometry, so that
    ``lookup("map", "base_link")`` is exact there, and the stream ``pose/map`` has the pose of the base in the
    map with its covariance. (That of such a lookup would add the covariance of the odometry.) The stream
    ``datum/map`` has the datum, latched. For a map that is no frame of the robot itself, that of other robots
    is taken, if ``in_map`` has none yet; if it has another one, InvalidInput is raised, or, for one that is
    published later, a sentence in the health of the receivers says so.

    The sensors and joints are read on the first of ``wires``, and what comes of them is published on all; the
    datum, and requests, are on the native wire.

    ``planar``: z, roll and pitch of what is published, and of ``state``, are zero (``in_plane``).

    Readings that are stamped more than 0.5 s after the time of ``clock`` are refused; without ``clock``, the
    clock of this host, or none if that of the buffer of ``base`` is simulated. If time goes back, the node
    publishes from there on, which is a new epoch for listeners. It also obeys ``request_odometry``.

    Raises InvalidInput for a sensor that is given twice, that has no such noise, or that it publishes itself,
    and SecondWriter as ``OdometryPublisher``. While it runs, that becomes its ``failure``, and
    ``has_failed`` is set. A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        base: BaseEstimator,
        *,
        imu: str = "imu",
        sensors: Iterable[tuple[str, SensorNoise]] = (),
        in_map: MapEstimator | None = None,
        has_joints: bool = False,
        planar: bool = False,
        writer: str = "odometry",
        wires: str | Sequence[str] = ("native",),
        rate_hz: float | None = None,
        program: str = "",
        clock: Clock | None = None,
    ) -> None:
        wires = (wires,) if isinstance(wires, str) else tuple(wires)
        self.base = base
        self._clock = base.clock if clock is None else clock
        self.failure: Exception | None = None
        self.has_failed = fork_safe(threading.Event())
        self._refusals = Refusals("joint states")
        self._imu, self._in_map, self._is_planar = imu, in_map, planar
        self._estimators = Estimators(base, in_map)
        self._sensors = tuple(sensor(name, noise) for name, noise in sensors)
        self._contradictions: dict[str, str] = {}
        """Against the datum of the map, by the key of that of another robot."""
        _check_sensors(self._sensors, wires[0], writer, has_map=in_map is not None)
        self._period_ns = 0 if rate_hz is None else round(1e9 / rate_hz)
        self._lock = fork_safe(threading.Lock())
        self._restart()
        self._joints: JointStateListener | None = None
        with ExitStack() as opening:
            self._publisher = opening.enter_context(
                OdometryPublisher(session, robot, writer, wires, program=program)
            )
            self._map_publishers = (
                None
                if in_map is None
                else _MapPublishers.open(opening, session, robot, in_map.map, wires=wires, program=program)
            )
            if in_map is not None and frame_owner(in_map.map) != robot:
                self._share_datum(opening, session)
            self._publish_datum()
            request_key = ODOMETRY_REQUEST.key(robot, self._publisher.writer)
            opening.enter_context(ExactQueryable(session, request_key, self._on_request))
            if has_joints:
                joints = JointStateListener(session, robot, on_reading=self._on_joints, wire=wires[0])
                self._joints = opening.enter_context(joints)
            self._listener = opening.enter_context(
                SensorListener(
                    session,
                    robot,
                    {
                        stream: partial(self._on_message, stream)
                        for stream in ("imu", *(one.stream for one in self._sensors))
                    },
                    wire=wires[0],
                )
            )
            self._opened = opening.pop_all()

    def _restart(self) -> None:
        """Publish from the next stamp on, whatever it is; the estimator has restarted."""
        self._imu_stamp = self._due = self._newest = self._assessed = _LONG_AGO
        self._epoch = self.base.epoch
        self._logged: dict[str, int] = {}

    def __repr__(self) -> str:
        return f"<OdometryNode of {self._publisher.robot!r}: {self.published} samples>"

    @property
    def refused(self) -> dict[str, int]:
        """Counts of messages that could not be used, by reason; the first of each is also logged."""
        return dict(Counter(self._listener.refused) + self._refusals.counts)

    @property
    def published(self) -> int:
        """How many samples of odometry were published."""
        return self._publisher.stats.sent

    def health(self) -> tuple[SourceHealth, ...]:
        """That of each source, with a sentence where something is wrong."""
        with self._lock:
            return self._health()

    def _health(self) -> tuple[SourceHealth, ...]:
        in_map = () if self._in_map is None else self._in_map.health()
        return (*self.base.health(), *in_map)

    def state(self) -> BaseState:
        """The newest state. Raises NoData before the first alignment."""
        with self._lock:
            return self._state()

    def _state(self, at: int | None = None) -> BaseState:
        state = self.base.state(at)
        return in_plane(state) if self._is_planar else state

    def reset(self, odom_from_base: Transform | None = None) -> None:
        """Restart, as ``BaseEstimator.reset``."""
        with self._lock:
            self.base.reset(odom_from_base)

    def set_pose(self, odom_from_base: Transform) -> None:
        """Place the base, as ``BaseEstimator.set_pose``."""
        with self._lock:
            self.base.set_pose(odom_from_base)

    def close(self) -> None:
        """Stop. A second call does nothing."""
        self._opened.close()

    def _share_datum(self, opening: ExitStack, session: Session) -> None:
        """Agree with others on the datum of a map that is not the robot's own. Raises InvalidInput."""
        wire = get_wire("native")
        cached = cached_values(session, wire.expression(ANY, "datum"), _CACHED_WITHIN_S)
        for received in decode_samples(wire, ANY, "datum", tuple(cached), on_error=self._refusals.count):
            self._agree(received)
        opening.enter_context(
            subscribe(
                *(session, wire, ANY, "datum", self._on_datums),
                on_error=self._refusals.count,
                on_withdrawn=self._on_datum_withdrawn,
            )
        )

    def _agree(self, received: Received) -> None:
        """Raises InvalidInput if another robot has another datum for the map."""
        robot, _, message = received
        assert isinstance(message, MapDatum)
        assert self._in_map is not None
        if robot != self._publisher.robot and full_name(robot, message.frame) == self._in_map.map:
            self._in_map.agree(message.datum, robot)

    def _publish_datum(self) -> None:
        if self._in_map is not None and self._map_publishers is not None:
            publisher, datum = self._map_publishers.datum, self._in_map.datum
            if datum is not None and datum != publisher.datum:
                publisher.set(datum)

    # In the threads of the subscriptions

    def _on_message(self, stream: StreamName, name: str, message: SensorMessage) -> None:
        is_imu = (stream, name) == ("imu", self._imu)
        sensors = [one for one in self._sensors if (one.stream, one.writer) == (stream, name)]
        if not is_imu and not sensors:
            return
        with self._lock:
            self._check_stamp(message.stamp)
            if is_imu:
                assert isinstance(message, Imu)
                self._add_imu(message)
            for one in sensors:
                one.add(self._estimators, message)
                self._publish_without_imu()
            self._publish_datum()

    def _add_imu(self, message: Imu) -> None:
        add_imu(self.base, message)
        self._check_epoch()
        if message.stamp <= self.base.newest:  # else it is of another time
            self._imu_stamp = max(self._imu_stamp, message.stamp)
            # Not the newest of all data: wheels may be ahead, and what the IMU did since is not known.
            self._publish(message.stamp, at=self._imu_stamp)

    def _on_datums(self, received: list[Received]) -> None:
        with self._lock:
            for one in received:
                self._contradictions.pop(one.key, None)
                try:
                    self._agree(one)
                except InvalidInput as error:
                    self._contradictions[one.key] = str(error)
            self._tell_contradictions()
            self._publish_datum()

    def _on_datum_withdrawn(self, key: str) -> None:
        with self._lock:
            self._contradictions.pop(key, None)
            self._tell_contradictions()

    def _tell_contradictions(self) -> None:
        if self._in_map is not None:
            self._in_map.contradiction = "; ".join(self._contradictions.values())

    def _on_joints(self, reading: JointReading) -> None:
        if self._joints is None:  # a reading during its opening
            return
        assert self._joints.model is not None
        assert reading.stamp is not None
        try:
            with self._lock:
                self._check_stamp(reading.stamp)
                add_joints(self.base, self._joints.model, reading)
                self._publish_without_imu()
        except InvalidInput as error:
            self._refusals.count("refused joints", error)
        except Exception as error:  # the next reading may be good
            self._refusals.count(*_failure(error, "joints"))

    def _on_request(self, parameters: Mapping[str, str]) -> Reply:
        try:
            with self._lock:
                apply_request(self.base, parameters)
        except (InvalidInput, NoData) as error:
            return Reply(str(error).encode(), "text/plain", is_error=True)
        return Reply(b"", "text/plain")

    def _check_stamp(self, stamp: int) -> None:
        """Raises InvalidInput for a stamp of the future."""
        if self._clock.domain != SYSTEM:
            return
        ahead_ns = stamp - self._clock.now()
        if ahead_ns > _AHEAD_NS:
            raise InvalidInput(
                f"it is stamped {format_duration(ahead_ns)} after the time of this host: one of the two "
                "clocks is wrong; synchronise them (NTP, PTP)"
            )

    def _check_epoch(self) -> None:
        if self.base.epoch != self._epoch:
            self._restart()

    def _publish_without_imu(self) -> None:
        self._check_epoch()
        newest = self.base.newest  # readings of another time are not among it
        if newest - self._imu_stamp > _SILENT_NS:
            self._publish(newest)

    def _publish(self, stamp: int, at: int | None = None) -> None:
        """Publish the state ``at`` a stamp, or the newest one, if that is due at ``stamp``; with the lock."""
        if stamp < self._due or self.failure is not None:
            return
        try:
            state = self._state(at)
        except (NoData, InPast):  # not aligned yet, or at a reading that came too late
            return
        if state.stamp <= self._newest:
            return
        self._newest = state.stamp
        # On the grid of the rate, unless the stamps have left it behind.
        following = self._due + self._period_ns
        self._due = following if following > stamp else stamp + self._period_ns
        self._assess(stamp)
        linear, angular = state.twist
        try:
            self._publisher.publish(
                state.odom_from_base, linear, angular, state.stamp, twist_covariance=state.covariance.twist
            )
            self._publish_in_map(state.stamp)
        except Closed:
            pass
        except SecondWriter as error:
            self.failure = error
            self.has_failed.set()

    def _publish_in_map(self, stamp: int) -> None:
        if self._in_map is None or self._map_publishers is None:
            return
        try:
            state = self._in_map.state(stamp)
        except (NoData, InPast):  # not aligned yet, or not then
            return
        if self._is_planar:
            state = map_in_plane(state)
        edge, pose, _ = self._map_publishers
        edge.publish([state.map_from_odom], stamp)
        pose.publish(state.map_from_base.with_covariance(state.covariance), stamp)

    def _assess(self, stamp: int) -> None:
        if stamp - self._assessed >= _HEALTH_NS:
            self._assessed = stamp
            sentences = {one.name: one.sentence for one in self._health() if one.sentence}
            self._publisher.warning = "; ".join(sentences.values())
            for name, sentence in sentences.items():
                if stamp - self._logged.get(name, _LONG_AGO) > _LOGGED_NS:
                    self._logged[name] = stamp
                    _LOG.warning("odometry of %r: %s", self._publisher.robot, sentence)
