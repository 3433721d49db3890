"""Cloud: the points of one sensor as numpy views, with the instant of each.

The times of the points are in a field ``t``, ``time``, ``timestamp`` or ``offset_time``. Its name does not
give the unit: drivers have a float64 ``timestamp`` in seconds and in nanoseconds. It follows from the
numbers, and so does whether they are relative to the stamp of the cloud or instants (``_unit_ns``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.checks import Points, check_names, reduced_to_fields
from zstate.clock import check_stamp, format_stamp
from zstate.clouds.compression import Compression, compress, decompress
from zstate.clouds.messages import PointCloud, PointField, check_counts, check_fields
from zstate.errors import InvalidInput
from zstate.wire.keys import full_name

TIME_FIELDS = ("t", "time", "timestamp", "offset_time")
"""The names of the field with the times of the points."""

_DATATYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
"""Of sensor_msgs/PointField, from 1 on."""
_DRIVERS_NS = ("t", "offset_time")
"""As integers these are nanoseconds since the start of the sweep: Ouster's and Livox's."""
_COORDINATES = ("x", "y", "z")
_FLOATS = ("f4", "f8")
_ORGANISED = 2

_SECOND_NS = 10**9
_LONGEST_S = 2
_LONGEST_NS = _LONGEST_S * _SECOND_NS
"""The longest sweep."""
_EPOCH_S, _EPOCH_US, _EPOCH_NS = 1e9, 1e14, 1e17
"""Larger numbers are instants since 1970 in these units: from the years 2001, 1973 and 1973 on."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """The points that one sensor measured, seen from ``frame``.

    ``points`` is a structured array, (N,), or (height, width) of an organised cloud: a read-only view of the
    argument or of the message, with its fields, such as x, y, z [m], intensity, ring. ``stamp`` [ns] is that
    of the cloud. ``is_dense`` is the claim of its writer that all numbers are finite. The properties have a
    row for each point, in the order of ``points.ravel()``.
    """

    stamp: int
    frame: str
    points: NDArray[np.void]
    is_dense: bool = False

    def __post_init__(self) -> None:
        check_names(self.frame)
        check_stamp(self.stamp)
        names = tuple(_fields_of(getattr(self.points, "dtype", None)))
        if not names or self.points.ndim not in (1, 2):
            raise InvalidInput(
                "the points of a cloud are a structured array with fields x, y and z, (N,) or (height, width)"
            )
        if not set(_COORDINATES) <= set(names):
            raise InvalidInput(f"the points of a cloud have fields x, y and z; these have {', '.join(names)}")
        view = self.points.view()
        view.flags.writeable = False
        self.__dict__["points"] = view  # a frozen dataclass; only the constructor sets its fields

    __reduce__ = reduced_to_fields

    def __len__(self) -> int:
        """How many points it has."""
        return self.points.size

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.points.shape))
        fields = " ".join(self.points.dtype.names or ())
        return f"<Cloud of {self.frame!r} at {format_stamp(self.stamp)}: {shape} points, {fields}>"

    @cached_property
    def xyz(self) -> Points:
        """The points in ``frame``: (N, 3) x y z [m], float32 or float64; a view if the fields permit."""
        x, y, z = (self.points[name] for name in _COORDINATES)
        (_, first), (_, second), (_, third) = (self._fields[name][:2] for name in _COORDINATES)
        is_even = x.ndim == 1 and second - first == third - second
        if is_even and x.dtype == y.dtype == z.dtype and x.dtype.str[1:] in _FLOATS and x.dtype.isnative:
            strides = (*x.strides, second - first)
            return np.lib.stride_tricks.as_strided(x, (len(x), 3), strides, writeable=False)
        kind = np.result_type(np.float32, x, y, z)
        return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=-1, dtype=kind)

    @cached_property
    def stamps(self) -> NDArray[np.int64] | None:
        """The instant of each point [ns]: (N,), ``stamp`` for a time that is NaN; None without times.

        Raises InvalidInput for times that are no stamps of 64 bits.
        """
        name = self.time_field
        if name is None:
            return None
        return _instants(self.points[name].ravel(), self.stamp, is_ns=name in _DRIVERS_NS)

    @property
    def time_field(self) -> str | None:
        """The name of the field with the times of the points; None if they are not known."""
        return next((name for name in TIME_FIELDS if name in self._fields), None)

    @property
    def is_rigid(self) -> bool:
        """Whether all points have the stamp of the cloud, because their times are not known."""
        return self.time_field is None

    @property
    def end_stamp(self) -> int:
        """The instant of the last point [ns]."""
        return self._end_stamp

    @cached_property
    def _end_stamp(self) -> int:
        stamps = self.stamps
        return self.stamp if stamps is None or not stamps.size else int(stamps.max())

    @property
    def intensity(self) -> NDArray[Any] | None:
        """The intensities: (N,), in units of the sensor; None without the field ``intensity``."""
        return self.points["intensity"].ravel() if "intensity" in self._fields else None

    @property
    def ring(self) -> NDArray[Any] | None:
        """The number of the laser that measured each point: (N,); None without the field ``ring``."""
        return self.points["ring"].ravel() if "ring" in self._fields else None

    @property
    def rgb(self) -> NDArray[np.uint8] | None:
        """The colours: (N, 3) red, green, blue; None without a field ``rgb`` or ``rgba`` of 4 bytes."""
        for name in ("rgb", "rgba"):
            if name in self._fields and self._fields[name][0].itemsize == 4:
                bits = self.points[name].ravel().view(np.uint32)
                return np.stack([bits >> 16, bits >> 8, bits], axis=-1).astype(np.uint8)
        return None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which rows are points, with finite coordinates: (N,)."""
        x, y, z = self.xyz.T
        return np.isfinite(x) & np.isfinite(y) & np.isfinite(z)

    @property
    def nbytes(self) -> int:
        """The bytes of its points."""
        return self.points.nbytes

    @property
    def _fields(self) -> Mapping[str, Any]:
        """Type and offset of each field."""
        return _fields_of(self.points.dtype)


def _fields_of(dtype: np.dtype[Any] | None) -> Mapping[str, Any]:
    """Type and offset of each field; none of a type without."""
    fields: Any = None if dtype is None else dtype.fields
    return fields or {}


def _instants(times: NDArray[Any], stamp: int, *, is_ns: bool) -> NDArray[np.int64]:
    """The instants [ns] of ``times`` (N,), in a cloud of ``stamp``; integers in ns if ``is_ns``."""
    is_integer = times.dtype.kind in "iu"
    finite = np.isfinite(times)
    known = times if finite.all() else times[finite]
    if not known.size:
        return np.full(len(times), stamp, dtype=np.int64)
    low, high = known.min().item(), known.max().item()
    unit, is_absolute = (1, False) if is_ns and is_integer else _unit_ns(low, high, is_integer=is_integer)
    start = 0 if is_absolute else stamp
    for time in (low, high):
        check_stamp(start + round(time * unit))
    if is_integer:
        return times.astype(np.int64) * unit + start
    offsets = np.rint(np.where(finite, times, 0.0) * float(unit)).astype(np.int64) + start
    return np.where(finite, offsets, stamp)


def _unit_ns(low: float, high: float, *, is_integer: bool) -> tuple[int, bool]:
    """The unit [ns] of times from ``low`` to ``high``, and whether they are instants.

    A sweep takes 2 ms to 2 s: so times since its start are at most 2 in seconds, 2000 in ms, and so on. Times
    since another instant, the epoch or the start of the sensor's clock, differ by less than a hundredth of
    them, and it is their differences that are so large.
    """
    size, span = max(abs(low), abs(high)), high - low
    if size >= _EPOCH_NS:
        return 1, True
    if size >= _EPOCH_US:
        return 1_000, True
    if low >= _EPOCH_S and span < _LONGEST_S:
        return _SECOND_NS, True
    is_absolute = 0.0 < 100.0 * span < low
    duration = span if is_absolute else size
    units = (1_000, 1) if is_integer else (_SECOND_NS, 1_000_000, 1_000, 1)
    return next((unit for unit in units if duration * unit <= _LONGEST_NS), 1), is_absolute


def cloud_from_message(message: PointCloud, robot: str) -> Cloud:
    """The cloud of ``robot`` in ``message``, without a copy unless it is compressed.

    Its frame has the full name. Raises InvalidInput for compressed data that is none of its points, and for a
    cloud without x, y and z.
    """
    return Cloud(message.stamp, full_name(robot, message.frame), message_points(message), message.is_dense)


def message_points(message: PointCloud) -> NDArray[np.void]:
    """The points of ``message``: (N,), or (height, width) of an organised one; read-only."""
    dtype = _dtype(message)
    shape = (message.height, message.width)
    if message.compression:
        count = message.height * message.width
        points = decompress(message.data, message.compression, message.resolution, dtype, count)
        points.flags.writeable = False
        points = points.reshape(shape)
    else:
        strides = (message.row_step, message.point_step)
        points = np.ndarray(shape, dtype, message.data, 0, strides)
    return points[0] if message.height == 1 else points


def _dtype(message: PointCloud) -> np.dtype[np.void]:
    """The type of one point; a field with several numbers is an array."""
    order = ">" if message.is_bigendian else "<"
    forms = [order + _DATATYPES[field.datatype - 1] for field in message.fields]
    return np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": [
                form if field.count == 1 else (form, (field.count,))
                for form, field in zip(forms, message.fields, strict=True)
            ],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )


def cloud_to_message(
    cloud: Cloud, is_dense: bool, compression: Compression = "", resolution: float = 0.0
) -> PointCloud:
    """``cloud`` on the wire, without numbers of a writer; ``resolution`` [m] as in ``compress``.

    Raises InvalidInput for more points than a cloud may have, and for fields that PointCloud2 does not have.
    """
    points = cloud.points
    height, width = points.shape if points.ndim == _ORGANISED else (1, len(points))
    step = points.dtype.itemsize
    check_counts(height * width, step)
    fields = _point_fields(points.dtype)
    check_fields(fields, step)
    points = np.ascontiguousarray(points, dtype=points.dtype.newbyteorder("<")).ravel()
    compression = compression if points.size else ""
    resolution = resolution if compression else 0.0
    data = compress(points, compression, resolution) if compression else points.tobytes()
    head = (cloud.stamp, 0, 0, cloud.frame, height, width, fields)
    return PointCloud(*head, False, step, width * step, data, is_dense, compression, resolution)


def _point_fields(dtype: np.dtype[np.void]) -> tuple[PointField, ...]:
    fields: list[PointField] = []
    for name in dtype.names or ():
        kind, offset = _fields_of(dtype)[name][:2]
        form = kind.base.str[1:]
        if form not in _DATATYPES or len(kind.shape) > 1:
            raise InvalidInput(
                f"the field {name!r} of the points has the type {kind}; PointCloud2 has int8 to int32, "
                "uint8 to uint32, float32 and float64, and flat arrays of these: convert it"
            )
        fields.append(PointField(name, offset, _DATATYPES.index(form) + 1, math.prod(kind.shape)))
    return tuple(fields)
