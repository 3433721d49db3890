"""SensorListener: the inertial measurements, velocities and poses of a robot, handed to callbacks."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.errors import InvalidInput
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.wire.keys import Stream, check_robot, shortened
from zstate.wire.messages import Imu, Pose, Velocity, with_full_names
from zstate.wire.registry import get_wire


class SensorListener(Closeable):
    """Calls ``on_imu``, ``on_velocity`` or ``on_pose`` with the sensor's name and each message of a robot.

    The frames of a message have their full names; the child of a pose is empty for the base of the robot.
    Each callback has a thread of its own, and gets the messages in the order of their arrival; a stream
    without a callback is not subscribed. If a callback is slow, the oldest messages are lost. ``refused``
    counts, by reason, messages that cannot be used and those that a callback refuses by raising InvalidInput;
    the first of each reason is also logged. A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        *,
        on_imu: Callable[[str, Imu], object] | None = None,
        on_velocity: Callable[[str, Velocity], object] | None = None,
        on_pose: Callable[[str, Pose], object] | None = None,
        wire: str = "native",
    ) -> None:
        self.robot = check_robot(robot)
        self._wire = get_wire(wire)
        self._refusals = Refusals("measurement")
        self.refused: dict[str, int] = self._refusals.counts
        callbacks: dict[Stream, Callable[..., object]] = {}
        if on_imu is not None:
            callbacks["imu"] = on_imu
        if on_velocity is not None:
            callbacks["velocity"] = on_velocity
        if on_pose is not None:
            callbacks["pose"] = on_pose
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
            assert isinstance(message, Imu | Velocity | Pose)
            try:
                callback(self._wire.edge_writer_name(key) or "", with_full_names(message, robot))
            except InvalidInput as error:
                self._refusals.count("refused", f"{shortened(key)}: {error}")

    def close(self) -> None:
        """Stop listening. A second call does nothing."""
        self._opened.close()
