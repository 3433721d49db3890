"""Capture of the state of robots at one instant: their models, newest joint states and static edges."""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from typing import Any, cast

from zstate import __version__
from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.cli.output.console import fail, print_status
from zstate.cli.output.wire_text import messages_for
from zstate.cli.session import SessionOptions
from zstate.cli.waiting import ConditionWaiter
from zstate.errors import InvalidInput, MessageError
from zstate.model.robot import POSITION_COUNTS, VELOCITY_COUNTS, JointType, RobotModel
from zstate.net.discovery import RobotInfo, discover
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.recording.cli.snapshot_file import (
    FORMAT,
    Configuration,
    Numbers,
    RobotSnapshot,
    Snapshot,
    StaticTransformSnapshot,
)
from zstate.sources.joint_state_listener import MAX_AGE_S, DescriptionSubscriber, JointStateReader
from zstate.streams import StreamName
from zstate.wire.keys import ANY, MODEL_WRITER
from zstate.wire.messages import StaticTransforms, poses_from_block
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire


def capture(
    session: Session, network: SessionOptions, robots: Sequence[str], wire: str, timeout_s: float
) -> Snapshot:
    """Capture the named robots, or all announced ones, as soon as everything announced has arrived.

    Fails if a robot is not announced; logs what does not arrive within ``timeout_s``.
    """
    messages = messages_for(wire)
    announced = discover(session, wire=wire)
    selected = [info for info in announced if info.name in robots or not robots]
    for name in robots:
        if name not in [info.name for info in selected]:
            fail(messages.unknown(name, announced))
    if not selected:
        fail(messages.announced(announced))
    waiter = ConditionWaiter()
    captures = [_RobotCapture(info, wire) for info in selected]
    with _CaptureSubscriptions(session, robots or ANY, captures, wire, waiter):
        waiter.wait_for(lambda: not any(one.missing() for one in captures), timeout_s)
        for one in captures:
            for text in one.missing():
                print_status(f"{one.info.name}: {text} within {timeout_s:g} s", robot=one.info.name)
        saved = datetime.now(UTC).isoformat(timespec="milliseconds")
        config = network.config if isinstance(network.config, str) else None
        endpoints = (network.connect, network.listen, config)
        return Snapshot(
            FORMAT,
            saved,
            Configuration(__version__, socket.gethostname(), network.joins_as, wire, *endpoints),
            tuple(robot for one in captures if (robot := one.robot()) is not None),
            tuple(edge for one in captures for edge in one.static_edges()),
        )


class _CaptureSubscriptions(Closeable):
    """Passes the data of ``robots`` on to their ``captures``; any number of robots share its threads."""

    def __init__(
        self,
        session: Session,
        robots: str | Sequence[str],
        captures: Sequence[_RobotCapture],
        wire: str,
        waiter: ConditionWaiter,
    ) -> None:
        self._captures = {one.info.name: one for one in captures}
        self._waiter = waiter
        self._wire = get_wire(wire)
        streams: tuple[StreamName, ...] = tuple(
            dict.fromkeys(("joint_states", self._wire.partial_joint_states))
        )
        with ExitStack() as opening:
            opening.enter_context(DescriptionSubscriber(session, robots, self._on_model, wire))
            names = (robots,) if isinstance(robots, str) else robots
            keys = [self._wire.expression(name, "tf_static") for name in names]
            opening.enter_context(LatchedSubscriber(session, keys, self._on_statics))
            for stream in streams:
                opening.enter_context(subscribe(session, self._wire, robots, stream, self._on_joint_states))
            for name in names:
                for announcement in announce_reader(session, self._wire, name, streams):
                    opening.enter_context(announcement)
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def _on_model(self, robot: str, model: RobotModel) -> None:
        if capture := self._captures.get(robot):
            capture.set_model(model)
            self._waiter.notify()

    def _on_joint_states(self, received: list[Received]) -> None:
        for one in received:
            if capture := self._captures.get(one.robot):
                capture.add_joint_state(one)
        self._waiter.notify()

    def _on_statics(self, arrival: SerializedSample) -> None:
        try:
            if capture := self._captures.get(self._robot(arrival.key)):
                capture.add_statics(arrival)
        except (InvalidInput, MessageError) as error:
            print_status(f"{arrival.key}: {error}")
        self._waiter.notify()

    def _robot(self, key: str) -> str:
        return next(iter(self._captures)) if len(self._captures) == 1 else self._wire.robot_from_key(key)


class _RobotCapture:
    """The model, the newest joint state and the static edges of one robot, as they arrive."""

    def __init__(self, info: RobotInfo, wire: str) -> None:
        self.info = info
        self._wire = get_wire(wire)
        self._joints: JointStateReader | None = None
        self._statics: dict[str, StaticTransforms] = {}

    def set_model(self, model: RobotModel) -> None:
        """Use ``model`` for joint states that arrive from now on."""
        refusals = Refusals("joint_states")
        self._joints = JointStateReader(self.info.name, model, self._wire, MAX_AGE_S, refusals.count)

    def add_joint_state(self, received: Received) -> None:
        """Keep the reading of ``received`` if the model is known."""
        if self._joints is not None:
            self._joints.readings([received])

    def add_statics(self, arrival: SerializedSample) -> None:
        """Keep the static edges of one writer. Raises MessageError and InvalidInput."""
        writer = self._wire.edge_writer_name(arrival.key) or arrival.key
        if not arrival.payload or writer == MODEL_WRITER:
            self._statics.pop(writer, None)  # the model has the same edges
            return
        for message in self._wire.decode("tf_static", arrival, self.info.name):
            if isinstance(message, StaticTransforms):
                name = f"{writer}.{message.session:08x}" if self._wire.shared else writer
                self._statics[name] = message

    def missing(self) -> list[str]:
        """What is announced and has not arrived."""
        streams = {stream for stream, _ in self.info.writers}
        static_names = {name for name, _ in self.info.named("tf_static")} - {MODEL_WRITER}
        joints = self._joints
        conditions = {
            "its model has not arrived": "robot_description" in streams and joints is None,
            "no joint states have arrived": "joint_states" in streams and not (joints and joints.newest),
            "not all of its static edges have arrived": bool(static_names - self._statics.keys()),
        }
        return [text for text, is_missing in conditions.items() if is_missing]

    def robot(self) -> RobotSnapshot | None:
        joints = self._joints
        if joints is None:
            return None
        model, reading = joints.model, joints.newest
        writers = tuple(sorted(f"{stream}: {writer}" for stream, writer in self.info.writers))
        if reading is None:
            return RobotSnapshot(name=self.info.name, urdf=model.urdf, writers=writers)
        return RobotSnapshot(
            name=self.info.name,
            urdf=model.urdf,
            writers=writers,
            stamp=reading.stamp,
            positions=_by_joint(model, reading.positions, POSITION_COUNTS),
            velocities=_by_joint(model, reading.velocities, VELOCITY_COUNTS),
            efforts=_by_joint(model, reading.efforts, VELOCITY_COUNTS),
        )

    def static_edges(self) -> list[StaticTransformSnapshot]:
        """The static edges that are not in the model."""
        links = set[str]() if self._joints is None else set(self._joints.model.links)
        return [
            StaticTransformSnapshot(
                self.info.name,
                writer,
                target,
                source,
                cast("tuple[float, float, float]", tuple(pose[:3].tolist())),
                cast("tuple[float, float, float, float]", tuple(pose[3:].tolist())),
            )
            for writer, message in sorted(self._statics.items())
            for (target, source), pose in zip(message.edges, poses_from_block(message.poses), strict=True)
            if source not in links
        ]


def _by_joint(model: RobotModel, numbers: Any, counts: Mapping[JointType, int]) -> Numbers:
    named: Numbers = {}
    if numbers is not None:
        rest = [float(number) for number in numbers]
        for joint in model.driven_joints:
            values, rest = rest[: counts[joint.type]], rest[counts[joint.type] :]
            named[joint.name] = values[0] if len(values) == 1 else tuple(values)
    return named
