"""Models of robots as lines over pictures, where they were when the picture was taken.

If the lines lie on the robot in the picture, the pose of the camera and its calibration are right: the check
of a hand-eye calibration. Lines are hidden by other links in front of them: the simplified faces of all links
are painted, the farthest first, and a line is left out where it is behind the one that is seen there.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

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
_TOUCH_M = 0.02
"""Links touch at joints, and their simplified faces lie as far beside the true ones."""
_SILENT_NS = 1_000_000_000
_APART = UnknownFrame, AmbiguousFrame, Disconnected
"""Why a link has no place in the frame of a camera, at any instant."""

Segments = NDArray[np.float64]


class SeenLink(NamedTuple):
    """What a picture has of one link.

    ``segments`` (M, 2, 2) [px] are its lines, and ``distances`` (M, 2) [m] those of their ends from the lens.
    ``covers`` (C, 8) [px] are the corners u v u v ... of its near faces, ``farthest`` (C,) [m] the distance
    of the farthest corner of each.
    """

    segments: Segments
    distances: NDArray[np.float64]
    covers: NDArray[np.float64]
    farthest: NDArray[np.float64]


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
        stamp, found = picture.packet.stamp, list[SeenLink]()
        reason: str | None = None
        for link, edges in self._links():
            try:
                found.append(_seen(edges, link, camera, buffer, stamp))
            except _APART:
                continue
            except LookupFailed as error:
                reason = str(error)
        if not any(len(one.segments) for one in found):
            return picture, reason or "no robot is in it"
        try:
            return _with_lines(picture, found), reason
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


def _seen(edges: MeshEdges, link: str, camera: Camera, buffer: TransformBuffer, stamp: int) -> SeenLink:
    """What a picture at ``stamp`` [ns] has of ``link``. Raises as ``TransformBuffer.lookup``."""
    eye = buffer.lookup(link, camera.frame, stamp).translation
    points = split(edges.seen_from(eye)).reshape(-1, 3)
    pixels, valid = buffer.project(points, link, camera, stamp)
    rows = seen_rows(pixels, valid, camera)
    corners = edges.covers.astype(np.float64)
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    near = corners[((eye - corners[:, 0]) * normals).sum(axis=1) > 0.0]
    outlines, known = buffer.project(near.reshape(-1, 3), link, camera, stamp)
    is_known = known.reshape(-1, 4).all(axis=1)
    return SeenLink(
        pixels.reshape(-1, 2, 2)[rows],
        np.linalg.norm(points - eye, axis=1).reshape(-1, 2)[rows],
        outlines.reshape(-1, 8)[is_known],
        np.linalg.norm(near - eye, axis=2).max(axis=1, initial=0.0)[is_known],
    )


def seen_rows(pixels: NDArray[np.float64], valid: NDArray[np.bool_], camera: Camera) -> NDArray[np.bool_]:
    """Which lines between pairs of ``pixels`` (2 N, 2) are valid and in the picture: (N,)."""
    is_inside = camera.contains(pixels).reshape(-1, 2).any(axis=1)
    return np.logical_and(valid.reshape(-1, 2).all(axis=1), is_inside)


def _nearest(
    links: Sequence[SeenLink], width: int, height: int
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The row of the link whose face is in front, -1 without one, and how far it is: (height, width)."""
    owners = np.repeat(np.arange(len(links)), [len(one.covers) for one in links])
    farthest = np.concatenate([one.farthest for one in links])
    outlines = np.concatenate([one.covers for one in links]) + 0.5  # Pillow cuts off fractions
    image = Image.new("I", (width, height))
    polygon = ImageDraw.Draw(image).polygon
    for face in np.argsort(-farthest, kind="stable").tolist():
        polygon(outlines[face].tolist(), fill=face + 1)
    faces = np.array(image)
    return np.append(-1, owners)[faces], np.append(np.inf, farthest)[faces]


def _with_lines(picture: StillPicture, links: Sequence[SeenLink]) -> StillPicture:
    """``picture`` with lines that are 2 px wide: all in a few array operations, as there are thousands."""
    segments = np.concatenate([one.segments for one in links])
    ends = np.concatenate([one.distances for one in links])
    owners = np.repeat(np.arange(len(links)), [len(one.segments) for one in links])
    with Image.open(io.BytesIO(picture.data)) as opened:
        pixels = np.array(opened.convert("RGB"))
    height, width = pixels.shape[:2]
    counts = np.minimum(np.abs(segments[:, 1] - segments[:, 0]).max(axis=1), width + height).astype(int) + 1
    lines = np.repeat(np.arange(len(segments)), counts)
    shares = (np.arange(len(lines)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[lines]
    points = segments[lines, 0] + (segments[lines, 1] - segments[lines, 0]) * shares[:, None]
    distances = ends[lines, 0] + (ends[lines, 1] - ends[lines, 0]) * shares
    columns, rows = np.floor(points).astype(int).T
    nearest, farthest = _nearest(links, width, height)
    u, v = columns.clip(0, width - 1), rows.clip(0, height - 1)
    is_hidden = (nearest[v, u] != owners[lines]) & (distances > farthest[v, u] + _TOUCH_M)
    columns, rows = columns[~is_hidden], rows[~is_hidden]
    for across, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        u, v = columns + across, rows + down
        is_inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        pixels[v[is_inside], u[is_inside]] = _COLOR
    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, "JPEG", quality=_QUALITY)
    return StillPicture(picture.packet, "jpeg", encoded.getvalue(), picture.size)
