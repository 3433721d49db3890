"""Models of robots as lines over pictures, where they were when the picture was taken.

If the lines lie on the robot in the picture, the pose of the camera and its calibration are right: the check
of a hand-eye calibration.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from zstate.buffer.buffer import TransformBuffer
from zstate.cameras.camera import Camera
from zstate.errors import AmbiguousFrame, Disconnected, LookupFailed, UnknownFrame
from zstate.view.mesh_edges import Lines, MeshEdges, RobotEdges
from zstate.view.pictures import StillPicture
from zstate.view.scene.robot_meshes import RobotKind

_COLOR = 60, 255, 90
_QUALITY = 85
_LONG_M, _PARTS = 0.1, 8
"""Longer lines are drawn in parts: a lens bends them, and they may begin behind the camera."""
_SILENT_NS = 1_000_000_000
_APART = UnknownFrame, AmbiguousFrame, Disconnected
"""Why a link has no place in the frame of a camera, at any instant."""

Segments = NDArray[np.float64]

_NO_SEGMENTS: Segments = np.empty((0, 2, 2))


class ModelOverlay:
    """Draws the models of robots over pictures. To be used by one thread."""

    def __init__(self) -> None:
        self._edges: dict[str, RobotEdges] = {}

    def load(self, kinds: Mapping[str, RobotKind]) -> None:
        """Read the meshes of these robots, in the background, and forget the others."""
        for robot in self._edges.keys() - kinds.keys():
            del self._edges[robot]
        for robot, kind in kinds.items():
            if robot not in self._edges or self._edges[robot].kind != kind:
                self._edges[robot] = RobotEdges(kind)

    def newest(self, camera: Camera, buffer: TransformBuffer, stamp: int) -> int:
        """``stamp`` of a picture [ns], or an earlier one for all of whose rows the links have poses by now.

        A robot that is silent, for a second, has none, and is not waited for.
        """
        shutter = camera.line_time_ns * camera.height
        newest = stamp
        for link, _ in self._links():
            with suppress(LookupFailed):
                known = buffer.latest(camera.frame, link) - shutter
                newest = min(newest, known) if known > stamp - _SILENT_NS else newest
        return newest

    def drawn_over(
        self, picture: StillPicture, camera: Camera, buffer: TransformBuffer
    ) -> tuple[StillPicture, str | None]:
        """``picture`` with the models at its stamp; and why they are not all in it, None if they are."""
        if not all(edges.is_loaded for edges in self._edges.values()):
            return picture, "the meshes are being read"
        stamp, found = picture.packet.stamp, [_NO_SEGMENTS]
        reason: str | None = None
        for link, edges in self._links():
            try:
                eye = buffer.lookup(link, camera.frame, stamp).translation
                points = split(edges.seen_from(eye)).reshape(-1, 3)
                found.append(segments_of(*buffer.project(points, link, camera, stamp), camera))
            except _APART:
                continue
            except LookupFailed as error:
                reason = str(error)
        segments = np.concatenate(found)
        if not len(segments):
            return picture, reason or "no robot is in it"
        try:
            return _with_segments(picture, segments), reason
        except OSError as error:
            return picture, f"it cannot be decoded: {error}"

    def _links(self) -> Iterator[tuple[str, MeshEdges]]:
        for robot, edges in self._edges.items():
            yield from ((f"{robot}/{link}", its) for link, its in edges.links.items())


def split(lines: Lines) -> Lines:
    """The lines (N, 2, 3) [m], long ones in parts: (M, 2, 3)."""
    is_long = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1) > _LONG_M
    shares = np.linspace(0.0, 1.0, _PARTS + 1)[:, None]
    points = lines[is_long, None, 0] * (1.0 - shares) + lines[is_long, None, 1] * shares
    parts = np.stack([points[:, :-1], points[:, 1:]], axis=2)
    return np.concatenate([lines[~is_long], parts.reshape(-1, 2, 3)])


def segments_of(pixels: NDArray[np.float64], valid: NDArray[np.bool_], camera: Camera) -> Segments:
    """The lines between pairs of ``pixels`` (2 N, 2): (M, 2, 2), those that are valid and in the picture."""
    segments = pixels.reshape(-1, 2, 2)[valid.reshape(-1, 2).all(axis=1)]
    return segments[camera.contains(segments.reshape(-1, 2)).reshape(-1, 2).any(axis=1)]


def _with_segments(picture: StillPicture, segments: Segments) -> StillPicture:
    """``picture`` with lines that are 2 px wide: all in a few array operations, as there are thousands."""
    with Image.open(io.BytesIO(picture.data)) as opened:
        pixels = np.array(opened.convert("RGB"))
    height, width = pixels.shape[:2]
    counts = np.minimum(np.abs(segments[:, 1] - segments[:, 0]).max(axis=1), width + height).astype(int) + 1
    lines = np.repeat(np.arange(len(segments)), counts)
    shares = (np.arange(len(lines)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[lines]
    points = segments[lines, 0] + (segments[lines, 1] - segments[lines, 0]) * shares[:, None]
    columns, rows = np.floor(points).astype(int).T
    for across, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        u, v = columns + across, rows + down
        is_inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        pixels[v[is_inside], u[is_inside]] = _COLOR
    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, "JPEG", quality=_QUALITY)
    return StillPicture(picture.packet, "jpeg", encoded.getvalue(), picture.size)
