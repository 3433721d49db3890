"""What is around the robots: laser scans as point clouds, and maps as images on the floor."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.snapshot import FrameTable, Poses
from zstate.errors import LookupFailed
from zstate.scans.grid import Grid
from zstate.scans.scan import Scan
from zstate.view.world_source import Sensor, WorldData, WriterName

_SCAN_POINT_M = 0.03
SENSOR_COLORS = ((224, 49, 49), (25, 113, 194), (47, 158, 68), (174, 62, 201), (232, 89, 12), (12, 133, 153))
STALE_COLOR = 140, 145, 153
_BACKGROUND = 255.0
_OLDEST_FADE = 0.75
"""How much of the background's white is in the colour of the oldest scan."""
_SMALLEST_MOVE = 1e-5  # the precision of a browser
_MAP_SINK_M = 0.005
"""Maps are drawn so far below their plane, so that lines on the floor stay visible."""


@dataclass(frozen=True)
class DrawnFrames:
    """Where the frames are drawn: ``placed`` (N, 7) are the poses of the frames of ``tree`` in ``fixed``.

    Trees that are not connected to ``fixed`` have poses, too.
    """

    tree: FrameTable
    placed: Poses
    fixed: str

    def pose(self, frame: str) -> se3.Pose | None:
        """``fixed_from_frame``, None if it is unknown."""
        if frame == self.fixed:
            return se3.IDENTITY
        row = self.tree.index.get(frame)
        if row is None or np.isnan(self.placed[row, 0]):
            return None
        return se3.unstack(self.placed[row])

    def connected(self, frame: str) -> str:
        """The fixed frame if it is connected to ``frame``, else the root of that frame's tree."""
        index, roots = self.tree.index, self.tree.roots
        if frame not in index or self.fixed not in index:
            return self.fixed
        root = int(roots[index[frame]])
        return self.fixed if root == int(roots[index[self.fixed]]) else self.tree.names[root]


class World:
    """Draws scans and maps. ``show`` uses ``scans``, ``maps`` and ``scan_count``, which the page changes.

    ``missing`` are the sensors and maps that cannot be drawn, with the reason. The world is ``busy`` while a
    map is being encoded. To be used by one thread.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self.scans = True
        self.maps = True
        self.scan_count = 5
        self.missing: Sequence[tuple[str, str]] = ()
        self._scene = scene
        self._clouds: dict[WriterName, ScanClouds] = {}
        self._cloud_count = 0
        self._images = MapImages(scene)

    @property
    def busy(self) -> bool:
        """Whether a map is still being encoded."""
        return self._images.busy

    @property
    def version(self) -> int:
        """Grows when a map appears."""
        return self._images.version

    def show(self, source: WorldData, buffer: TransformBuffer, place: DrawnFrames, at: int | None) -> None:
        """Draw the maps and the last scans ``at`` a stamp [ns]; None: the newest."""
        missing: list[tuple[str, str]] = []
        sensors = source.sensors
        for name in self._clouds.keys() - sensors.keys():
            self._clouds.pop(name).remove()
        for name, sensor in sensors.items():
            clouds = self._clouds.get(name)
            if clouds is None:
                color = SENSOR_COLORS[self._cloud_count % len(SENSOR_COLORS)]
                clouds = self._clouds[name] = ScanClouds(
                    self._scene, buffer, f"/scans/{self._cloud_count}", color
                )
                self._cloud_count += 1
            clouds.show(sensor, place, self.scan_count if self.scans else 0, at)
            if sensor.problem is not None:
                missing.append((f"scans of {name}", sensor.problem))
        missing += source.problems
        missing += self._images.show(source.maps_at(at), place, is_on=self.maps)
        self.missing = missing

    def corners(self, place: DrawnFrames) -> NDArray[np.float64]:
        """The corners of all drawn maps in the fixed frame: (N, 3) [m]."""
        return self._images.corners(place)


class ScanClouds:
    """The last scans of one sensor, a point cloud for each.

    Older ones are paler, those of a stale sensor grey. Each ray is placed by the pose at its own stamp, once:
    a cloud does not move afterwards, unless its tree is not connected to the fixed frame.
    """

    def __init__(
        self, scene: viser.SceneApi, buffer: TransformBuffer, path: str, color: tuple[int, int, int]
    ) -> None:
        self._buffer = buffer
        self._color = color
        self._target = ""
        self._nodes = PointNodes(scene, path, _SCAN_POINT_M)
        self._drawn: dict[Scan, viser.PointCloudHandle] = {}
        self._state: tuple[Sequence[Scan], str, int, bool] | None = None

    def show(self, sensor: Sensor[Scan], place: DrawnFrames, count: int, at: int | None) -> None:
        """Draw the last ``count`` scans of ``sensor`` until ``at`` [ns]."""
        frame = sensor.frame
        if frame is None:
            return
        target = place.connected(frame)
        sensor.settle(self._buffer, target, at)
        pose = place.pose(target)
        if pose is None or frame not in place.tree.index:
            count = 0
        else:
            self._nodes.move(pose)
        state = sensor.latest(count, at), target, count, sensor.is_stale(at)
        if state != self._state:
            self._state = state
            self._update(*state)

    def remove(self) -> None:
        """Remove the clouds from the scene."""
        self._nodes.remove()

    def _update(self, scans: Sequence[Scan], target: str, count: int, is_stale: bool) -> None:
        is_moved, self._target = target != self._target, target
        for scan in [scan for scan in self._drawn if is_moved or scan not in scans]:
            self._nodes.hide(self._drawn.pop(scan))
        color = STALE_COLOR if is_stale else self._color
        for age, scan in enumerate(reversed(scans)):
            shade = _faded(color, age, count)
            if scan in self._drawn:
                self._drawn[scan].colors = shade
            else:
                self._drawn[scan] = self._nodes.add(place_scan(self._buffer, scan, self._target), shade)


class PointNodes:
    """Point clouds of one sensor, below a node at ``path`` that moves all of them.

    A node that is hidden is used again for the next points: a server keeps a message of each name that it has
    used. ``size`` is that of a point [m].
    """

    def __init__(self, scene: viser.SceneApi, path: str, size: float) -> None:
        self._scene = scene
        self._path = path
        self._size = size
        self._root = scene.add_frame(path, show_axes=False)
        self._free: list[viser.PointCloudHandle] = []
        self._count = 0

    def move(self, pose: se3.Pose) -> None:
        """Move all of them to ``pose``."""
        move_node(self._root, pose)

    def add(self, points: NDArray[np.float32], colors: NDArray[np.uint8]) -> viser.PointCloudHandle:
        """Draw ``points`` (N, 3) [m] in ``colors``, (N, 3) or (3,)."""
        if self._free:
            node = self._free.pop()
            node.points, node.colors, node.visible = points, colors, True
            return node
        self._count += 1
        return self._scene.add_point_cloud(
            f"{self._path}/{self._count}",
            points,
            colors,
            point_size=self._size,
            point_shape="circle",
            point_shading="flat",
            precision="float32",  # of float16 the steps are 8 mm at a distance of 10 m
        )

    def hide(self, node: viser.PointCloudHandle) -> None:
        """Hide what ``add`` returned."""
        node.visible = False
        self._free.append(node)

    def remove(self) -> None:
        """Remove all of them from the scene."""
        self._root.remove()


def place_scan(buffer: TransformBuffer, scan: Scan, target: str) -> NDArray[np.float32]:
    """The measured points of a scan in ``target``, each by the pose at its own stamp: (N, 3).

    Without those that have no pose, which are before the buffer's history.
    """
    measured = scan.valid
    points, stamps = scan.points()[measured], scan.stamps()[measured]
    try:
        placed, valid = buffer.place(points, stamps, scan.frame, target)
    except LookupFailed:  # the tree has changed since
        return np.empty((0, 3), dtype=np.float32)
    return placed[valid].astype(np.float32, copy=False)


@dataclass(eq=False)
class _MapImage:
    """A drawn map; ``handle`` is None until it is encoded."""

    grid: Grid
    handle: viser.ImageHandle | None = None
    error: str | None = None


class MapImages:
    """Draws each map as one image, at the pose of its origin; unknown cells are transparent.

    A map is encoded once for each change, in a thread: that of 4000 x 4000 cells takes a second. Until then
    the one before remains. ``version`` grows when a map appears.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._drawn: dict[WriterName, _MapImage] = {}
        self.version = 0
        self._encoding: tuple[WriterName, _MapImage, threading.Thread] | None = None
        self._number = 0

    @property
    def busy(self) -> bool:
        """Whether a map is being encoded."""
        return self._encoding is not None

    def show(
        self, maps: Mapping[WriterName, Grid], place: DrawnFrames, *, is_on: bool
    ) -> list[tuple[str, str]]:
        """Draw ``maps``. Returns those that cannot be drawn, with the reason."""
        self._take_encoded()
        for name in self._drawn.keys() - maps.keys():
            _remove_image(self._drawn.pop(name))
        missing: list[tuple[str, str]] = []
        for name, grid in maps.items():
            drawn = self._drawn.get(name)
            if is_on and (drawn is None or drawn.grid is not grid) and self._encoding is None:
                self._encode(name, grid)
            if drawn is not None:
                _place_image(drawn, place, is_on=is_on)
            if drawn is not None and drawn.error is not None:
                missing.append((f"map {name}", drawn.error))
            elif place.pose(grid.frame) is None:
                missing.append((f"map {name}", f"its frame {grid.frame!r} has no pose in {place.fixed!r}"))
        return missing

    def corners(self, place: DrawnFrames) -> NDArray[np.float64]:
        """The corners of all drawn maps: (N, 3) [m]."""
        corners: list[se3.Vector] = []
        for image in self._drawn.values():
            pose = place.pose(image.grid.frame)
            if pose is not None and image.handle is not None:
                origin = se3.compose(pose, se3.unstack(image.grid.origin.pose7))
                width, height = image.grid.size
                for x, y in ((0.0, 0.0), (width, 0.0), (0.0, height), (width, height)):
                    corners.append(se3.compose(origin, (x, y, 0.0, 0.0, 0.0, 0.0, 1.0))[:3])
        return np.array(corners, dtype=np.float64).reshape(-1, 3)

    def _encode(self, name: WriterName, grid: Grid) -> None:
        self._number += 1
        image = _MapImage(grid)
        thread = threading.Thread(
            target=self._add_image, args=(image, f"/maps/{self._number}"), name="zstate-maps", daemon=True
        )
        self._encoding = name, image, thread
        thread.start()

    def _add_image(self, image: _MapImage, path: str) -> None:
        """Add a hidden node for a map. The first row of viser's images has the smallest y."""
        width, height = image.grid.size
        try:
            image.handle = self._scene.add_image(
                path,
                image.grid.to_image()[::-1],
                width,
                height,
                format="png",
                cast_shadow=False,
                receive_shadow=False,
                visible=False,
            )
        except Exception as error:  # of the encoder or of memory: the other maps are still drawn
            image.error = f"it cannot be drawn: {type(error).__name__}: {error}"

    def _take_encoded(self) -> None:
        """Replace a drawn map by the one that has been encoded."""
        if self._encoding is None or self._encoding[2].is_alive():
            return
        name, image, _ = self._encoding
        self._encoding = None
        if name in self._drawn:
            _remove_image(self._drawn[name])
        else:
            self.version += 1
        self._drawn[name] = image


def _place_image(image: _MapImage, place: DrawnFrames, *, is_on: bool) -> None:
    if image.handle is None:
        return
    pose = place.pose(image.grid.frame)
    image.handle.visible = is_on and pose is not None
    if pose is not None:
        move_node(image.handle, se3.compose(pose, _middle(image.grid)))


def _remove_image(image: _MapImage) -> None:
    if image.handle is not None:
        image.handle.remove()


def _middle(grid: Grid) -> se3.Pose:
    """The pose of a map's middle in its frame."""
    width, height = grid.size
    return se3.compose(
        se3.unstack(grid.origin.pose7), (0.5 * width, 0.5 * height, -_MAP_SINK_M, 0.0, 0.0, 0.0, 1.0)
    )


def move_node(node: viser.SceneNodeHandle, pose: se3.Pose) -> None:
    """Move a node, if it is not there already."""
    x, y, z, qx, qy, qz, qw = pose
    if np.abs(node.position - (x, y, z)).max() > _SMALLEST_MOVE:
        node.position = (x, y, z)
    if np.abs(node.wxyz - (qw, qx, qy, qz)).max() > _SMALLEST_MOVE:
        node.wxyz = (qw, qx, qy, qz)


def _faded(color: tuple[int, int, int], age: int, count: int) -> NDArray[np.uint8]:
    """The colour of the scan before ``age`` newer ones, if ``count`` are drawn."""
    fade = _OLDEST_FADE * age / max(count - 1, 1)
    return np.rint((1.0 - fade) * np.array(color) + fade * _BACKGROUND).astype(np.uint8)
