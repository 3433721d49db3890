"""Robots on the network to a Snapshot: waits as long as tells all that is announced, and not longer."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import datetime, timezone
from typing import Any

from zstate import __version__
from zstate.cli.network import Network
from zstate.cli.output.console import fail, print_status
from zstate.cli.snapshot.snapshot import FORMAT, Configuration, RobotShot, Snapshot, StaticShot
from zstate.cli.waiting import ConditionWaiter
from zstate.cli.words import words_of
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.model.robot import POSITION_COUNTS, VELOCITY_COUNTS, RobotModel
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import RobotInfo, discover
from zstate.net.session import Session
from zstate.net.wires import wire_named
from zstate.sources import JointReading, SubscribedSource
from zstate.sources.descriptions import Descriptions
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.messages import StaticTransforms, poses_from_block
from zstate.wire.protocol import SerializedSample


def taken(session: Session, network: Network, robots: Sequence[str], wire: str, timeout_s: float) -> Snapshot:
    """The named robots, or all that are announced. Fails where there is none, and notes what did not come."""
    words = words_of(wire)
    announced = discover(session, wire=wire)
    wanted = [info for info in announced if info.name in robots or not robots]
    for name in robots:
        if name not in [info.name for info in wanted]:
            fail(words.unknown(name, announced))
    if not wanted:
        fail(words.announced(announced))
    with ExitStack() as sitters:
        waiter = ConditionWaiter()
        sittings = [sitters.enter_context(_Sitting(session, info, wire, waiter)) for info in wanted]
        waiter.wait_for(lambda: not any(sitting.lacking() for sitting in sittings), timeout_s)
        for sitting in sittings:
            for text in sitting.lacking():
                print_status(f"{sitting.info.name}: {text} within {timeout_s:g} s", robot=sitting.info.name)
        return Snapshot(
            FORMAT,
            datetime.now(timezone.utc).isoformat(timespec="milliseconds"),
            Configuration(
                __version__,
                socket.gethostname(),
                network.joins_as,
                wire,
                network.connect,
                network.listen,
                network.config if isinstance(network.config, str) else None,
            ),
            tuple(shot for sitting in sittings if (shot := sitting.robot_shot()) is not None),
            tuple(shot for sitting in sittings for shot in sitting.static_shots()),
        )


class _Sitting(Closing):
    """What has been heard of one robot so far."""

    def __init__(self, session: Session, info: RobotInfo, wire: str, waiter: ConditionWaiter) -> None:
        self.info = info
        self._waiter = waiter
        self._session = session
        self._wire_name = wire
        self._wire = wire_named(wire)
        self._model: RobotModel | None = None
        self._source: SubscribedSource | None = None
        self._reading: JointReading | None = None
        self._statics: dict[str, StaticTransforms] = {}
        self._opened = ExitStack()
        self._opened.enter_context(Descriptions(session, info.name, self._describe, wire))
        key = self._wire.expression(info.name, "tf_static")
        self._opened.enter_context(LatchedSubscriber(session, key, self._take_statics))

    def close(self) -> None:
        self._opened.close()
        if self._source is not None:
            self._source.close()

    def _describe(self, _: str, model: RobotModel) -> None:
        if self._source is not None:
            self._source.close()
        self._model = model
        self._source = SubscribedSource(
            self._session, model, self.info.name, wire=self._wire_name, on_readings=self._waiter.notify
        )
        self._waiter.notify()

    def _take_statics(self, arrival: SerializedSample) -> None:
        self._insert_statics(arrival)
        self._waiter.notify()

    def _insert_statics(self, arrival: SerializedSample) -> None:
        try:
            writer = self._wire.statics_writer(arrival.key) or arrival.key
        except InvalidInput as error:
            print_status(f"{arrival.key}: {error}")
            return
        if not arrival.payload or writer == MODEL_WRITER:
            self._statics.pop(writer, None)  # the model says the same
            return
        try:
            for message in self._wire.decode("tf_static", arrival, self.info.name):
                if isinstance(message, StaticTransforms):
                    self._statics[f"{writer}.{message.session:08x}" if self._wire.shared else writer] = (
                        message
                    )
        except MessageError as error:
            print_status(f"{arrival.key}: {error}")

    def lacking(self) -> list[str]:
        """What is announced and has not come."""
        streams = {stream for stream, _ in self.info.writers}
        self._reading = self._newest() or self._reading
        static_names = {name for name, _ in self.info.static_names} - {MODEL_WRITER}
        lacks = {
            "its model has not arrived": "robot_description" in streams and self._model is None,
            "no joint states came": "joint_states" in streams and self._reading is None,
            "not all of its static edges arrived": bool(static_names - self._statics.keys()),
        }
        return [text for text, is_so in lacks.items() if is_so]

    def _newest(self) -> JointReading | None:
        return None if self._source is None else self._source.read(0)

    def robot_shot(self) -> RobotShot | None:
        """None for a robot that nobody describes."""
        model, reading = self._model, self._reading
        if model is None:
            return None
        writers = tuple(sorted(f"{stream}: {writer}" for stream, writer in self.info.writers))
        if reading is None:
            return RobotShot(name=self.info.name, urdf=model.urdf, writers=writers)
        return RobotShot(
            name=self.info.name,
            urdf=model.urdf,
            writers=writers,
            stamp=reading.stamp,
            positions=_by_joint(model, reading.positions, POSITION_COUNTS),
            velocities=_by_joint(model, reading.velocities, VELOCITY_COUNTS),
            efforts=_by_joint(model, reading.efforts, VELOCITY_COUNTS),
        )

    def static_shots(self) -> list[StaticShot]:
        """The edges that others than the model place."""
        links = set[str]() if self._model is None else set(self._model.links)
        return [
            StaticShot(self.info.name, writer, target, source, _three(pose), _four(pose))
            for writer, message in sorted(self._statics.items())
            for (target, source), pose in zip(message.edges, poses_from_block(message.poses), strict=True)
            if source not in links
        ]


def _three(pose: Any) -> tuple[float, float, float]:
    return float(pose[0]), float(pose[1]), float(pose[2])


def _four(pose: Any) -> tuple[float, float, float, float]:
    return float(pose[3]), float(pose[4]), float(pose[5]), float(pose[6])


def _by_joint(model: RobotModel, numbers: Any, counts: Any) -> dict[str, float | tuple[float, ...]]:
    named: dict[str, float | tuple[float, ...]] = {}
    if numbers is not None:
        rest = [float(number) for number in numbers]
        for joint in model.driven_joints:
            own, rest = rest[: counts[joint.type]], rest[counts[joint.type] :]
            named[joint.name] = own[0] if len(own) == 1 else tuple(own)
    return named
