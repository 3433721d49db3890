"""Models of robots as lines over pictures, where they were when the picture was taken.

If the lines lie on the robot in the picture, the pose of the camera and its calibration are right: the check
of a hand-eye calibration.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping

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
_APART = UnknownFrame, AmbiguousFrame, Disconnected
"""Why a link has no place in the frame of a camera, at any instant."""

Segments = NDArray[np.float64]

_NO_LINES: Lines = np.empty((0, 2, 3))


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

    def newest(self, frame: str, buffer: TransformBuffer) -> int | None:
        """The newest stamp [ns] at which all links have a pose in ``frame``; None if none of them moves."""
        stamps: list[int] = []
        for link, _ in self._links():
            try:
                stamps.append(buffer.latest(frame, link))
            except LookupFailed:
                continue
        return min(stamps, default=None)

    def drawn_over(
        self, picture: StillPicture, camera: Camera, buffer: TransformBuffer
    ) -> tuple[StillPicture, str | None]:
        """``picture`` with the models at its stamp; and why they are not all in it, None if they are."""
        if not all(edges.is_loaded for edges in self._edges.values()):
            return picture, "the meshes are being read"
        found: list[Lines] = []
        reason: str | None = None
        for link, edges in self._links():
            try:
                camera_from_link = buffer.lookup(picture.packet.frame, link, picture.packet.stamp)
            except _APART:
                continue
            except LookupFailed as error:
                reason = str(error)
                continue
            lines = edges.seen_from(camera_from_link.inverse().translation)
            found.append((camera_from_link @ lines.reshape(-1, 3)).reshape(-1, 2, 3))
        segments = projected(np.concatenate([_NO_LINES, *found]), camera)
        if not len(segments):
            return picture, reason or "no robot is in it"
        try:
            return _with_segments(picture, segments), reason
        except OSError as error:
            return picture, f"it cannot be decoded: {error}"

    def _links(self) -> Iterator[tuple[str, MeshEdges]]:
        for robot, edges in self._edges.items():
            yield from ((f"{robot}/{link}", its) for link, its in edges.links.items())


def projected(lines: Lines, camera: Camera) -> Segments:
    """The lines (N, 2, 3) [m] in the frame of ``camera`` in its picture: (M, 2, 2) u v of both ends [px].

    Without those that are outside of the picture, or behind the camera.
    """
    is_long = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1) > _LONG_M
    split = [_split(lines[~is_long], 1), _split(lines[is_long], _PARTS)]
    pixels, valid = camera.project(np.concatenate(split).reshape(-1, 3))
    segments = pixels.reshape(-1, 2, 2)[valid.reshape(-1, 2).all(axis=1)]
    return segments[camera.contains(segments.reshape(-1, 2)).reshape(-1, 2).any(axis=1)]


def _split(lines: Lines, parts: int) -> Lines:
    """Each of the lines (N, 2, 3) in ``parts``: (N * parts, 2, 3)."""
    shares = np.linspace(0.0, 1.0, parts + 1)[:, None]
    points = lines[:, None, 0] * (1.0 - shares) + lines[:, None, 1] * shares
    return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)


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
