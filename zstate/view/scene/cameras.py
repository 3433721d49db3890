"""Cameras: the newest picture of each, and a frustum with it at the frame of the camera."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import viser

from zstate import se3
from zstate.buffer.buffer import TransformBuffer
from zstate.cameras.camera import Camera
from zstate.errors import LookupFailed, NoData
from zstate.view.pictures import Packet, PictureReader, StillPicture
from zstate.view.scene.model_overlay import ModelOverlay
from zstate.view.scene.robot_meshes import RobotKind
from zstate.view.scene.world import STALE_COLOR, DrawnFrames, move_node
from zstate.view.world_source import Sensor, WorldData, WriterName

_PERIOD_S = 0.1
"""Pictures are sent to browsers so often: at 30 Hz each would need 4 MB/s."""
_VIDEO_PACKETS = 300
"""The most packets from a key frame on: ten seconds at 30 Hz."""
_COLOR = 20, 20, 20
_SIZE_M = 0.25
_LINE_M = 0.004
_WIDEST = math.radians(140.0)


class ShownPicture(NamedTuple):
    """The picture of one camera on display; ``camera`` is None if its calibration is not known.

    It is old if its camera has missed its deadline, or if newer packets could not be decoded: ``problem``.
    ``model_problem`` is why the models of robots are not drawn over it, None if they are, or are not wanted.
    """

    picture: StillPicture
    camera: Camera | None
    is_old: bool
    problem: str | None
    model_problem: str | None = None


class Cameras:
    """Reads the newest picture of each camera, and draws it on a frustum if its pose is known.

    ``shown`` are the newest pictures of all cameras. The page changes ``frustums``, and ``models``: whether
    the models of robots are drawn over the pictures; then they are the newest for which there are poses.
    ``missing`` is what is not drawn, with the reason. ``clock`` is a monotonic clock [s]. To be used by one
    thread.
    """

    def __init__(self, scene: viser.SceneApi, clock: Callable[[], float] = time.monotonic) -> None:
        self.frustums = True
        self.models = False
        self.shown: Mapping[WriterName, ShownPicture] = {}
        self.missing: Sequence[tuple[str, str]] = ()
        self._scene = scene
        self._clock = clock
        self._due_s = -math.inf
        self._cameras: dict[WriterName, _CameraNode] = {}
        self._count = 0
        self._overlay = ModelOverlay()

    def show(self, buffer: TransformBuffer, place: DrawnFrames) -> None:
        """Draw the pictures that were read, each where its camera was at its stamp."""
        missing: list[tuple[str, str]] = []
        for name, shown in self.shown.items():
            pose, reason = camera_pose(shown.picture.packet, buffer, place)
            if shown.problem is not None:
                missing.append((f"pictures of {name}", shown.problem))
            if shown.model_problem is not None:
                missing.append((f"model over pictures of {name}", shown.model_problem))
            if shown.camera is None:
                missing.append((f"frustum of {name}", "its calibration, or one of this size, is not known"))
            elif pose is None:
                missing.append((f"frustum of {name}", reason))
            self._cameras[name].show(self._scene, shown, pose if self.frustums else None)
        self.missing = missing

    def read(
        self, source: WorldData, buffer: TransformBuffer, kinds: Mapping[str, RobotKind], at: int | None
    ) -> None:
        """Read the pictures ``at`` a stamp [ns], ten times a second; None: the newest.

        ``kinds`` are the robots whose models may be drawn over them.
        """
        if self._clock() < self._due_s:
            return
        self._due_s = self._clock() + _PERIOD_S
        self._overlay.load(kinds if self.models else {})
        sensors, cameras = source.pictures, source.cameras_at(at)
        for name in self._cameras.keys() - sensors.keys():
            self._cameras.pop(name).remove()
        shown: dict[WriterName, ShownPicture] = {}
        for name, sensor in sensors.items():
            if name not in self._cameras:
                self._cameras[name] = _CameraNode(f"/cameras/{self._count}")
                self._count += 1
            node = self._cameras[name]
            camera = cameras.get(name)
            packets = last_packets(sensor, self._until(sensor, camera, buffer, at))
            picture, problem = node.reader.read(packets), node.reader.problem
            if picture is None:
                continue
            if camera is not None and picture.size != (camera.width, camera.height):
                camera = None
            is_old, model_problem = sensor.is_stale(at) or problem is not None, None
            if self.models and camera is not None:
                picture, model_problem = node.with_models(picture, camera, self._overlay, buffer)
            shown[name] = ShownPicture(picture, camera, is_old, problem, model_problem)
        self.shown = shown

    def _until(
        self, sensor: Sensor[Packet], camera: Camera | None, buffer: TransformBuffer, at: int | None
    ) -> int | None:
        """``at``, or an earlier stamp [ns] with poses if models are drawn over the pictures."""
        newest = sensor.latest(1, at) if self.models else ()
        if not newest or camera is None:
            return at
        return self._overlay.newest(camera, buffer, newest[0].stamp)


def camera_pose(packet: Packet, buffer: TransformBuffer, place: DrawnFrames) -> tuple[se3.Pose | None, str]:
    """The pose of a camera in ``place`` at the stamp of its picture; None with the reason if it is unknown.

    Before the poses of that stamp arrive, it is the newest one before.
    """
    frame, stamp = packet.frame, packet.stamp
    target = place.connected(frame)
    drawn = place.pose(target)
    if drawn is None or place.pose(frame) is None:
        return None, f"its frame {frame!r} has no pose in {place.fixed!r}"
    try:
        with suppress(NoData):  # nothing moves
            stamp = min(stamp, buffer.latest(target, frame))
        return se3.compose(drawn, se3.unstack(buffer.lookup(target, frame, stamp).pose7)), ""
    except LookupFailed as error:
        return None, str(error)


def last_packets(sensor: Sensor[Packet], at: int | None) -> Sequence[Packet]:
    """The last picture until ``at`` [ns]; of a video also the packets before it."""
    packets = sensor.latest(1, at)
    return packets if not packets or packets[0].is_still else sensor.latest(_VIDEO_PACKETS, at)


@dataclass(eq=False)
class _CameraNode:
    """The frustum of one camera, once it has been drawn, and the reader of its pictures."""

    path: str
    reader: PictureReader = field(default_factory=PictureReader)
    _frustum: viser.CameraFrustumHandle | None = None
    _drawn: tuple[StillPicture, Camera] | None = None
    _overlaid: tuple[StillPicture, StillPicture] | None = None
    """The last picture without and with models."""

    def with_models(
        self, picture: StillPicture, camera: Camera, overlay: ModelOverlay, buffer: TransformBuffer
    ) -> tuple[StillPicture, str | None]:
        """``picture`` with models, drawn once if all of them have poses; and why they have not."""
        if self._overlaid is not None and self._overlaid[0] is picture:
            return self._overlaid[1], None
        drawn, problem = overlay.drawn_over(picture, camera, buffer)
        self._overlaid = (picture, drawn) if problem is None else None
        return drawn, problem

    def show(self, scene: viser.SceneApi, shown: ShownPicture, pose: se3.Pose | None) -> None:
        """Draw it at ``pose``, or hide it without one."""
        picture, camera = shown.picture, shown.camera
        if pose is None or camera is None:
            if self._frustum is not None:
                self._frustum.visible = False
            return
        if self._frustum is None:
            self._frustum = scene.add_camera_frustum(
                self.path, 1.0, 1.0, scale=_SIZE_M, thickness=_LINE_M, cast_shadow=False, receive_shadow=False
            )
        frustum = self._frustum
        if self._drawn is None or self._drawn[1] is not camera:
            frustum.fov, frustum.aspect = field_of_view(camera)
        if self._drawn is None or self._drawn[0] is not picture:
            # viser takes arrays, which it encodes; these are the properties behind.
            frustum._format = picture.format  # pyright: ignore[reportPrivateUsage]
            frustum._image_data = picture.data  # pyright: ignore[reportPrivateUsage]
        self._drawn = picture, camera
        frustum.color = STALE_COLOR if shown.is_old else _COLOR
        frustum.visible = True
        move_node(frustum, pose)

    def remove(self) -> None:
        """Remove it from the scene."""
        if self._frustum is not None:
            self._frustum.remove()


def field_of_view(camera: Camera) -> tuple[float, float]:
    """The vertical angle of view [rad], and how many times as wide as high the picture is on the frustum.

    Of a wide lens 140 degrees are drawn: the picture plane of a frustum ends before 180.
    """
    cx, cy = camera.k[2:]
    right, bottom = camera.width - 0.5, camera.height - 0.5
    left_ray, right_ray, top_ray, bottom_ray = camera.ray([[-0.5, cy], [right, cy], [cx, -0.5], [cx, bottom]])
    across, along = (
        min(float(np.nan_to_num(np.arccos(np.clip(one @ other, -1.0, 1.0)), nan=_WIDEST)), _WIDEST)
        for one, other in ((left_ray, right_ray), (top_ray, bottom_ray))
    )
    return along, math.tan(0.5 * across) / math.tan(0.5 * along)
