"""Compression of clouds: numbers by columns, as differences, in planes of bytes, with LZ4 or Zstandard.

Each number of a point (a field, or an item of one with several) is a column over all points. A column is
taken as integers of its width: the bits of a float, or, if the cloud has a ``resolution``, x, y and z as
multiples of it in int32. Differences from one point to the next, modulo 2^bits, are small if points are in
the order of their measurement; zigzag (0, -1, 1, -2 as 0, 1, 2, 3) puts the sign last; and planes (the first
byte of all points, then the second, ...) collect the zeros.

Without a ``resolution`` nothing is lost but bytes that belong to no field. With one, x, y and z change by
half of it at most, and by the rounding of the result to their type. A coordinate that is not finite becomes
NaN: a mask, one bit for each point, precedes the planes of such a column.
"""

# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# lz4 has no types

from __future__ import annotations

from collections.abc import Iterator
from math import ceil
from typing import Any, Literal, NamedTuple, cast

import lz4.block
import numpy as np
import zstandard
from numpy.typing import NDArray

from zstate.errors import InvalidInput

Compression = Literal["", "lz4", "zstd"]

_COORDINATES = ("x", "y", "z")
_LARGEST = 2**30
"""Of multiples: their differences have 32 bits."""
_ZSTD_LEVEL = 1


class _Column(NamedTuple):
    """One number of each point: ``values`` (N,) is a view; with ``is_rounded`` multiples are sent."""

    name: str
    values: NDArray[Any]
    is_rounded: bool

    @property
    def width(self) -> int:
        """The bytes of each number that is sent."""
        return 4 if self.is_rounded else self.values.dtype.itemsize

    @property
    def nbytes(self) -> int:
        """The bytes before compression."""
        return self.width * len(self.values) + self.mask_bytes

    @property
    def mask_bytes(self) -> int:
        return ceil(len(self.values) / 8) if self.is_rounded else 0


def _columns(points: NDArray[np.void], resolution: float) -> Iterator[_Column]:
    """The columns of ``points`` (N,), in the order of the fields."""
    for name in points.dtype.names or ():
        values = points[name].reshape(len(points), -1)
        is_rounded = resolution > 0.0 and name in _COORDINATES and values.dtype.kind == "f"
        for item in range(values.shape[1]):
            yield _Column(name, values[:, item], is_rounded)


def compress(points: NDArray[np.void], compression: Compression, resolution: float) -> bytes:
    """The compressed numbers of ``points`` (N,), a structured array; x, y, z rounded to ``resolution`` [m].

    0 rounds nothing. Raises InvalidInput for a coordinate of more than 2^30 times ``resolution``.
    """
    parts: list[bytes] = []
    for column in _columns(points, resolution):
        if column.is_rounded:
            mask, integers = _multiples(column, resolution)
            parts.append(np.packbits(mask).tobytes())
        else:
            integers = np.ascontiguousarray(column.values).view(f"u{column.width}")
        parts.append(_planes(integers))
    block = b"".join(parts)
    if compression == "lz4":
        return cast("bytes", lz4.block.compress(block, store_size=False))
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(block)


def _multiples(column: _Column, resolution: float) -> tuple[NDArray[np.bool_], NDArray[np.uint32]]:
    """Which values are finite, and all as multiples of ``resolution``; others repeat the last finite one."""
    values = column.values.astype(np.float64) / resolution
    finite = np.isfinite(values)
    if not finite.all():
        last = np.maximum.accumulate(np.where(finite, np.arange(len(values)), 0))
        values = np.where(finite[last], values[last], 0.0)
    np.rint(values, out=values)
    if len(values) and max(values.max(), -values.min()) > _LARGEST:
        raise InvalidInput(
            f"the {column.name} of a point is {np.abs(values).max() * resolution:.6g} m, and a resolution of "
            f"{resolution:g} m reaches to {_LARGEST * resolution:.6g} m: give a larger one, or leave the "
            "point out"
        )
    return finite, values.astype(np.int32).view(np.uint32)


def _planes(integers: NDArray[Any]) -> bytes:
    differences = np.empty_like(integers)
    differences[:1] = integers[:1]
    np.subtract(integers[1:], integers[:-1], out=differences[1:])
    bits = 8 * integers.itemsize
    signs = (differences.view(f"i{integers.itemsize}") >> (bits - 1)).view(integers.dtype)
    zigzag = (differences << 1) ^ signs
    return zigzag.view(np.uint8).reshape(-1, integers.itemsize).T.tobytes()


def _integers(planes: NDArray[np.uint8], width: int) -> NDArray[Any]:
    """The integers (N,), unsigned, of planes (width * N,)."""
    items = np.empty((len(planes) // width, width), np.uint8)
    for number, plane in enumerate(planes.reshape(width, -1)):  # in a fifth of the time of a transposed copy
        items[:, number] = plane
    zigzag = items.view(f"u{width}").ravel()
    differences = (zigzag >> 1) ^ -(zigzag & 1)
    return np.cumsum(differences, dtype=zigzag.dtype)


def decompress(
    data: bytes, compression: Compression, resolution: float, dtype: np.dtype[np.void], count: int
) -> NDArray[np.void]:
    """The ``count`` points (N,) of ``dtype`` in ``data``; bytes of no field are zero.

    Raises InvalidInput unless ``data`` has exactly their numbers; never allocates more.
    """
    points = np.zeros(count, dtype)
    columns = list(_columns(points, resolution))
    block = np.frombuffer(_unpack(data, compression, sum(column.nbytes for column in columns)), np.uint8)
    for column in columns:
        mask, planes, block = np.split(block, [column.mask_bytes, column.nbytes])
        integers = _integers(planes, column.width)
        if column.is_rounded:
            column.values[:] = integers.view(np.int32) * resolution
            column.values[np.unpackbits(mask, count=count) == 0] = np.nan
        else:
            column.values[:] = integers.view(column.values.dtype)
    return points


def _unpack(data: bytes, compression: Compression, size: int) -> bytes:
    """The block of ``size`` bytes in ``data``."""
    block = b""
    try:
        if compression == "lz4":
            block = cast("bytes", lz4.block.decompress(data, uncompressed_size=size))
        elif zstandard.frame_content_size(data) == size:  # which a frame may state, and takes then
            block = zstandard.ZstdDecompressor().decompress(data)
    except (cast("type[Exception]", lz4.block.LZ4BlockError), zstandard.ZstdError):
        pass  # the error below
    if len(block) != size:
        raise InvalidInput(f"the compressed points are no {compression} of {size} bytes")
    return block
