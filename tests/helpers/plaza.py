"""The Plaza data sets in the gtsam wheel: a mower with wheel and gyro increments, and its positions by RTK.

Djugash, "Geolocation with range: robustness, efficiency and scalability", PhD thesis, CMU (2010). The files
are MATLAB's, level 5: elements of a type, a size and data padded to 8 bytes, of which matrices may be
compressed.
"""

import struct
import zlib
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zstate.odometry.invariant_filter import Floats

_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8"}


class Plaza(NamedTuple):
    """Rows (N + 1, 4) t [s], x, y [m], yaw by RTK, and (N, 3) t, distance [m] and turn [rad] until then."""

    truth: Floats
    increments: Floats


def folder() -> Path | None:
    """Where gtsam has its data; None without gtsam."""
    spec = find_spec("gtsam")
    return None if spec is None or spec.origin is None else Path(spec.origin).parent / "Data"


def load(path: Path) -> Plaza:
    data, place, matrices = path.read_bytes(), 128, dict[str, Floats]()
    while place < len(data):
        kind, content, place = _element(data, place)
        if kind == _COMPRESSED:
            kind, content, _ = _element(zlib.decompress(content), 0)
        if kind == _MATRIX:
            (_, _), (_, shape), (_, name), (number, numbers) = _elements(content, 4)
            values = np.frombuffer(numbers, _TYPES[number]).astype(np.float64)
            matrices[name.decode()] = values.reshape(np.frombuffer(shape, "<i4"), order="F")
    return Plaza(matrices["GT"], matrices["DR"])


def aligned_error(path: Floats, truth: Floats) -> float:
    """The root mean square distance [m] after the best planar rotation and translation (Umeyama, 1991)."""
    one, other = (points - points.mean(axis=0) for points in (path, truth))
    return float(np.sqrt(((one - other @ best_turn(one, other).T) ** 2).sum(axis=1).mean()))


def best_turn(path: Floats, truth: Floats) -> Floats:
    """path_from_truth, (2, 2), the rotation about the origin that maps points best to those of the path."""
    # The turn by a maximises a . (cosine, sine).
    cosine, sine = (
        float((path * truth).sum()),
        float((truth[:, 0] * path[:, 1] - truth[:, 1] * path[:, 0]).sum()),
    )
    return np.array([[cosine, -sine], [sine, cosine]]) / float(np.hypot(cosine, sine))


def _elements(data: bytes, count: int) -> list[tuple[int, bytes]]:
    found: list[tuple[int, bytes]] = []
    place = 0
    for _ in range(count):
        kind, content, place = _element(data, place)
        found.append((kind, content))
    return found


def _element(data: bytes, place: int) -> tuple[int, bytes, int]:
    """The type and data of an element, and the place of the next."""
    kind, size = struct.unpack_from("<II", data, place)
    if small := kind >> 16:  # up to 4 bytes, in place of the size
        return kind & 0xFFFF, data[place + 4 : place + 4 + small], place + 8
    padding = 0 if kind == _COMPRESSED else -size % 8
    return kind, data[place + 8 : place + 8 + size], place + 8 + size + padding
