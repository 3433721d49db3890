"""Pictures without a camera: surfaces drawn by the painter's algorithm, on a robot too.

Faces are projected by the lens, far ones are drawn first, and near ones over them (Newell, Newell and Sancha,
"A solution to the hidden surface problem", 1972, without its splitting). Nothing else is needed than numpy
and Pillow: no graphics card, no OpenGL and no browser. Edges are straight between the corners of a face.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate import se3
from zstate.buffer.buffer import TransformBuffer
from zstate.cameras.camera import Camera, Flags
from zstate.cameras.codecs import Pixels
from zstate.cameras.publishers import StampedPicture
from zstate.cameras.surfaces import Floats, Surface, floor_surface
from zstate.checks import real_numbers
from zstate.errors import InvalidInput, LibraryMissing, LookupFailed
from zstate.model.robot import RobotModel
from zstate.nodes.mounted_sensor import MountedSensor

_SKY = (172, 196, 220)
_LAMP = np.array([-0.37, -0.74, -0.56])
"""The direction to the light in the frame of the camera, a unit vector: from above, from the left."""
_DARKEST = 0.45
_NEAR_M = 0.01
_WIDEST = math.tan(math.radians(80.0))
_MARGIN = 0.02
_FLOOR = (-5.0, 5.0), (-5.0, 5.0)
_WORLD = ""
"""The name of the body that is the floor: no frame has it."""


class SimulatedCamera:
    """A camera that sees ``surfaces``, each in the frame of its body, by the names of the bodies.

    Its lens is that of ``camera``, with its distortion. What is more than 80 degrees to the side, above or
    below is not seen. All rows of a picture have one instant: raises InvalidInput for a rolling shutter.
    Raises LibraryMissing without Pillow.
    """

    def __init__(self, camera: Camera, surfaces: Mapping[str, Surface]) -> None:
        if camera.line_time_ns:
            raise InvalidInput(
                f"a simulated camera has a global shutter; got line_time_ns={camera.line_time_ns}"
            )
        self.camera = camera
        self.bodies = tuple(surfaces)
        self._draw = _pillow()
        self._corners = np.concatenate(
            [np.zeros((0, 4, 3), np.float32), *(one.corners for one in surfaces.values())]
        ).astype(np.float64)
        self._colors = np.concatenate(
            [np.zeros((0, 3), np.uint8), *(one.colors for one in surfaces.values())]
        ).astype(np.float64)
        self._counts = [len(one) for one in surfaces.values()]
        self._is_above = np.repeat([not one.is_ground for one in surfaces.values()], self._counts)
        self._planes = _view_planes(camera)

    def picture(self, poses: Mapping[str, ArrayLike]) -> Pixels:
        """The picture, RGB (H, W, 3); ``poses`` are those of all bodies in the frame of the camera.

        A pose is x y z [m], qx qy qz qw, ``camera_from_body``. Raises InvalidInput without one of them.
        """
        missing = [body for body in self.bodies if body not in poses]
        if missing:
            raise InvalidInput(f"the picture needs the poses of all bodies; missing are {', '.join(missing)}")
        corners = self._seen_from([real_numbers(poses[body], "poses") for body in self.bodies])
        normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        rows, is_cut = self._visible(corners, normals)
        outlines = [
            *self._outlines(corners[rows[~is_cut]]),
            *self._outlines(_clipped(corners[rows[is_cut]], self._planes)),
        ]
        order = np.argsort(np.concatenate([np.flatnonzero(~is_cut), np.flatnonzero(is_cut)]))
        return self._painted([outlines[place] for place in order.tolist()], self._shaded(normals[rows], rows))

    def _visible(self, corners: Floats, normals: Floats) -> tuple[NDArray[np.intp], Flags]:
        """The faces that may be seen, the farthest first, and which of them the planes of the view cut."""
        middles = corners.mean(axis=1)
        inside: Flags = corners @ self._planes[:, :3].T >= self._planes[:, 3]  # (N, 4, planes)
        is_seen: Flags = inside.any(axis=1).sum(axis=1) == len(self._planes)
        is_seen &= (normals * middles).sum(axis=1) < 0.0
        rows = np.flatnonzero(is_seen)
        distances = np.linalg.norm(middles[rows], axis=1)
        rows = rows[np.lexsort((-distances, self._is_above[rows]))]
        is_cut: Flags = inside[rows].sum(axis=(1, 2)) < 4 * len(self._planes)
        return rows, is_cut

    def _outlines(self, polygons: Floats) -> list[list[float] | None]:
        """The pixels u v u v ... of polygons (N, K, 3); None for one that the lens does not see."""
        count, corners, _ = polygons.shape
        pixels, valid = self.camera.project(polygons.reshape(-1, 3))
        pixels += 0.5  # Pillow cuts off fractions
        outlines: list[list[float]] = pixels.reshape(count, 2 * corners).tolist()
        seen: list[int] = valid.reshape(count, corners).sum(axis=1).tolist()
        return [outline if n == corners else None for outline, n in zip(outlines, seen, strict=True)]

    def _seen_from(self, poses: list[Floats]) -> Floats:
        """The corners of all faces in the frame of the camera: (N, 4, 3)."""
        seen = np.empty_like(self._corners)
        start = 0
        for pose, count in zip(poses, self._counts, strict=True):
            matrix, part = se3.to_matrix(pose.tolist()), slice(start, start + count)
            seen[part] = self._corners[part] @ matrix[:3, :3].T + matrix[:3, 3]
            start += count
        return seen

    def _shaded(self, normals: Floats, rows: NDArray[np.intp]) -> list[tuple[int, ...]]:
        """The colours of the faces ``rows``, by Lambert's law."""
        cosines = normals @ _LAMP / np.linalg.norm(normals, axis=1)
        light = _DARKEST + (1.0 - _DARKEST) * np.clip(cosines, 0.0, 1.0)
        colors = (self._colors[rows] * light[:, None]).astype(int)
        return list(map(tuple, colors.tolist()))

    def _painted(self, outlines: list[list[float] | None], colors: list[tuple[int, ...]]) -> Pixels:
        """A picture of ``outlines``, the later ones over the earlier ones."""
        image_module, draw_module = self._draw
        image = image_module.new("RGB", (self.camera.width, self.camera.height), _SKY)
        polygon = draw_module.Draw(image).polygon
        for outline, color in zip(outlines, colors, strict=True):
            if outline is not None:
                polygon(outline, fill=color)
        return np.array(image)


class MountedCamera(MountedSensor):
    """A PictureSource: what a simulated ``camera`` sees on a robot whose transforms are in ``buffer``.

    It sees the links of ``robot``, as ``surfaces`` returns them by their names once its model is known; and
    a floor in ``world_frame``, or in the root of the robot, see MountedSensor. ``frame``, a full name, is
    that of its lens. A picture has the newest instant at which all of them can be placed.
    """

    def __init__(
        self,
        camera: Camera,
        buffer: TransformBuffer,
        robot: str,
        frames: tuple[str, str],
        surfaces: Callable[[RobotModel], Mapping[str, Surface]],
    ) -> None:
        frame, world_frame = frames
        super().__init__(buffer, frame, world_frame)
        self._lens, self._robot, self._surfaces = camera, robot, surfaces
        self._model: RobotModel | None = None
        self._camera = self._seeing({})

    def read(self, stamp: int) -> StampedPicture | None:
        """The picture at ``stamp`` [ns] or before; None without newer poses than those of the last."""
        self._look_for_model()
        links = [body for body in self._camera.bodies if body != _WORLD]
        try:
            newest = [self._newest(self._frame, link, stamp) for link in links]
            sweep = self.sweep(min([stamp, *newest]), np.zeros(1, np.int64))
            if sweep is None:
                return None
            poses: dict[str, ArrayLike] = {
                link: self._buffer.lookup(self._frame, link, sweep.stamp).pose7 for link in links
            }
        except LookupFailed:
            return None
        x, y, z, qx, qy, qz, qw = sweep.poses[0].tolist()
        poses[_WORLD] = se3.invert((x, y, z, qx, qy, qz, qw))
        return StampedPicture(sweep.stamp, self._camera.picture(poses))

    def _look_for_model(self) -> None:
        track = self._buffer.frame_table((self._robot,)).robots.get(self._robot)
        if track is not None and track.model is not self._model:
            self._model = track.model
            found = self._surfaces(track.model)
            self._camera = self._seeing({track.frame(link): one for link, one in found.items()})

    def _seeing(self, links: Mapping[str, Surface]) -> SimulatedCamera:
        return SimulatedCamera(self._lens, {_WORLD: floor_surface(*_FLOOR), **links})


def _view_planes(camera: Camera) -> Floats:
    """The planes around what the picture shows: rows a b c d; inside is a x + b y + c z >= d.

    Four go through the rays of its border, the last one is before the camera.
    """
    u, v = np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5
    width, height = camera.width - 0.5, camera.height - 0.5
    border = [(one, edge) for edge in (-0.5, height) for one in u.tolist()]
    border += [(edge, one) for edge in (-0.5, width) for one in v.tolist()]
    rays = camera.ray(border)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.copysign(_WIDEST, rays[:, :2]))
    low = np.fmin.reduce(np.clip(flat, -_WIDEST, _WIDEST))
    high = np.fmax.reduce(np.clip(flat, -_WIDEST, _WIDEST))
    (left, top), (right, bottom) = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
    return np.array(
        [
            (1.0, 0.0, -left, 0.0),
            (-1.0, 0.0, right, 0.0),
            (0.0, 1.0, -top, 0.0),
            (0.0, -1.0, bottom, 0.0),
            (0.0, 0.0, 1.0, _NEAR_M),
        ]
    )


def _clipped(corners: Floats, planes: Floats) -> Floats:
    """The parts of convex polygons (N, K, 3) inside of all planes: (N, K + planes, 3), the last repeated.

    Each plane cuts off corners and adds one at most (Sutherland and Hodgman, "Reentrant polygon clipping",
    1974). Polygons without any part inside become NaN.
    """
    for plane in planes:
        places = corners @ plane[:3] - plane[3]
        following, places_after = np.roll(corners, -1, axis=1), np.roll(places, -1, axis=1)
        is_inside = places >= 0.0
        is_crossed = is_inside != (places_after >= 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(is_crossed, places / (places - places_after), 0.0)
        crossing = corners + ratio[..., None] * (following - corners)
        count, most = places.shape
        both = np.stack([corners, crossing], axis=2).reshape(count, 2 * most, 3)
        is_kept = np.stack([is_inside, is_crossed], axis=2).reshape(count, 2 * most)
        order = np.argsort(~is_kept, axis=1, kind="stable")[:, : most + 1]
        last = np.maximum(is_kept.sum(axis=1) - 1, 0)
        slots = np.minimum(np.arange(order.shape[1]), last[:, None])
        order = np.take_along_axis(order, slots, axis=1)
        corners = np.take_along_axis(both, order[..., None], axis=1)
        corners[~is_kept.any(axis=1)] = np.nan
    return corners


def _pillow() -> tuple[Any, Any]:
    """The modules Image and ImageDraw. Raises LibraryMissing."""
    try:
        from PIL import Image, ImageDraw  # noqa: PLC0415 - loaded when it is needed
    except ImportError:
        command = "pip install 'zstate[cameras]'"
        raise LibraryMissing(f"simulated cameras need Pillow: {command}", command=command) from None
    return Image, ImageDraw
