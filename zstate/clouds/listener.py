"""CloudListener: the clouds of a robot, each point placed by the pose at its own instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.checks import Points
from zstate.clock import Clock
from zstate.clouds.cloud import Cloud, cloud_from_message
from zstate.clouds.messages import PointCloud
from zstate.errors import InvalidInput
from zstate.net.session import Session
from zstate.nodes.placing_listener import ByteLimits, PlacingListener
from zstate.wire.keys import ANY
from zstate.wire.messages import Message
from zstate.wire.registry import get_wire

_LIMITS = ByteLimits(unread=256 * 2**20, waiting=128 * 2**20)
"""Reached before 256 clouds: by 55 and 45 of 130,000 points with intensity, ring and time."""


@dataclass(frozen=True, eq=False)
class PlacedCloud:
    """A cloud whose points stand in ``target``: ``xyz`` (N, 3) [m], NaN where ``valid`` (N,) is False.

    Each point is placed by the pose at its own stamp. It is not valid if its coordinates are not finite, or
    if the history of the buffer begins after it. ``is_rigid`` means that the times of the points are not
    known, and all are placed by the pose at the stamp of the cloud. ``target`` is the frame of the cloud if
    the listener has no target.
    """

    cloud: Cloud
    sensor: str
    target: str
    xyz: Points
    valid: NDArray[np.bool_]

    @property
    def stamp(self) -> int:
        """That of the cloud [ns]."""
        return self.cloud.stamp

    @property
    def is_rigid(self) -> bool:
        """Whether all points are placed by one pose."""
        return self.cloud.is_rigid

    def __repr__(self) -> str:
        rigid = ", rigid" if self.is_rigid else ""
        return f"<PlacedCloud of {self.sensor!r} in {self.target!r}: {self.valid.sum()} points{rigid}>"


def _placed_size(placed: PlacedCloud) -> int:
    return placed.cloud.nbytes + placed.xyz.nbytes + placed.valid.nbytes


class CloudListener(PlacingListener[Cloud, PlacedCloud]):
    """Receives the clouds of ``robot``, and places each point in ``target`` by the pose at its own instant.

    ``for placed in clouds`` and ``async for placed in clouds`` return a PlacedCloud for each cloud, in the
    order in which they became placeable, and end with ``close()``. A cloud waits for the pose of its *last*
    point, at most ``timeout_s`` from its arrival: then it is counted in ``dropped`` by the name of the error,
    and ``last_reason`` names the edge that was too late. Without a ``target`` clouds wait for nothing, and
    their points stay in the frame of the sensor.

    Of more than 256 clouds or 256 MiB that are unread, or 256 clouds or 128 MiB of one sensor that wait, the
    oldest are lost; ``dropped["Overflow"]`` counts them. ``refused`` counts messages that are no cloud, by
    reason; the first of each reason is also logged.

    ``sensor`` selects one sensor of the robot; "*": all of them. On the wire "ros2dds", whose keys have no
    types, it is needed: the name of the topic, as "velodyne_points". Frames come from ``buffer``; without
    one, the listener fills a buffer of its own with the transforms of the robot. Bare frame names are the
    robot's own. A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        target: str | None = None,
        *,
        sensor: str = ANY,
        buffer: TransformBuffer | None = None,
        wire: str = "native",
        timeout_s: float = 1.0,
        clock: Clock | None = None,
    ) -> None:
        if sensor == ANY and get_wire(wire).name == "ros2dds":
            raise InvalidInput(
                "the keys of ros2dds have no types, so that clouds are found by the name of their topic; "
                "pass it: sensor='velodyne_points' for the topic /velodyne_points"
            )
        super().__init__(
            session,
            robot,
            "cloud",
            target,
            sensor=sensor,
            buffer=buffer,
            wire=wire,
            timeout_s=timeout_s,
            clock=clock,
            limits=_LIMITS,
            size_of=_placed_size,
        )
        self.target, self.buffer = self._target, self._buffer

    def __repr__(self) -> str:
        place = "" if self.target is None else f" in {self.target!r}"
        return f"<CloudListener of {self.robot!r}{place}: {len(self)} unread clouds>"

    def _read(self, message: Message, robot: str) -> Cloud:
        assert isinstance(message, PointCloud)
        cloud = cloud_from_message(message, robot)
        _ = cloud.end_stamp  # raises here for impossible times, where the message is refused
        return cloud

    def _place(self, measured: Cloud, sensor: str) -> PlacedCloud:
        cloud = measured
        target, buffer = self._target, self._buffer
        if target is None or buffer is None:
            return PlacedCloud(cloud, sensor, cloud.frame, cloud.xyz, cloud.valid)
        stamps = cloud.stamp if cloud.stamps is None else cloud.stamps
        xyz, valid = buffer.place(cloud.xyz, stamps, cloud.frame, target)
        return PlacedCloud(cloud, sensor, target, xyz, valid)
