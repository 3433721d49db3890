"""Scan: one sweep of a laser scanner, as in sensor_msgs/LaserScan, with integer times.

Ray i points along ``angle_min + i * angle_increment`` in the x-y plane of the sensor's frame, measured
from x towards y, and was measured at ``stamp + i * ray_ns``.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.checks import check_names, real_numbers, reduced_to_fields
from zstate.clock import check_stamp, format_stamp
from zstate.errors import InvalidInput
from zstate.scans.messages import LaserScan
from zstate.wire.keys import full_name
from zstate.wire.measurements import from_float32_block, to_float32_block

Floats32 = NDArray[np.float32]

# A full turn as float32, which sensors publish, is larger than that of a float64.
_FULL_TURN = math.tau + 1e-5


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Scan:
    """One sweep of a laser scanner: ``ranges`` [m] of N rays, seen from ``frame``.

    ``stamp`` [ns] is the instant of the first ray, and ``ray_ns`` the time between two rays; 0 means that
    all rays have the stamp of the scan. ``angle_min`` [rad] is the direction of the first ray,
    ``angle_increment`` [rad] the angle between two rays, negative for a clockwise sweep. Ranges inside
    [``range_min``, ``range_max``] [m] are measurements. Others (NaN and infinite ones included) are not
    errors: REP 117 gives them a meaning, and ``valid`` is False for them.

    ``ranges`` and ``intensities`` (in units of the sensor, None if not measured) are read-only copies of the
    arguments, float32 (N,). Raises InvalidInput if the values are no scan.
    """

    stamp: int
    angle_min: float
    angle_increment: float
    ray_ns: int
    ranges: Floats32
    range_min: float
    range_max: float
    frame: str = "laser"
    intensities: Floats32 | None = None

    def __init__(  # noqa: PLR0917 - the order is that of LaserScan
        self,
        stamp: int,
        angle_min: float,
        angle_increment: float,
        ray_ns: int,
        ranges: ArrayLike,
        range_min: float,
        range_max: float,
        frame: str = "laser",
        intensities: ArrayLike | None = None,
    ) -> None:
        check_names(frame)
        fields = self.__dict__  # a frozen dataclass; only the constructor sets its fields
        fields["stamp"] = check_stamp(stamp)
        fields["angle_min"] = _number(angle_min, "angle_min")
        fields["angle_increment"] = _number(angle_increment, "angle_increment")
        fields["ray_ns"] = _ray_ns(ray_ns)
        fields["ranges"] = _float32(ranges, "ranges")
        fields["range_min"] = _number(range_min, "range_min")
        fields["range_max"] = _number(range_max, "range_max")
        fields["frame"] = frame
        fields["intensities"] = None if intensities is None else _float32(intensities, "intensities")
        self._check_rays()
        self._check_angles()
        self._check_limits()

    def _check_rays(self) -> None:
        if not len(self.ranges):
            raise InvalidInput("a scan has one ray or more; ranges is empty: leave out scans without rays")
        check_stamp(self.end_stamp)
        if self.intensities is not None and len(self.intensities) != len(self.ranges):
            raise InvalidInput(
                f"a scan has one intensity for each ray; got {len(self.intensities)} intensities of "
                f"{len(self.ranges)} rays: pass None if they are not measured"
            )

    def _check_angles(self) -> None:
        if not (math.isfinite(self.angle_min) and math.isfinite(self.angle_increment)):
            raise InvalidInput(
                f"angles of a scan are finite; got angle_min={self.angle_min!r}, "
                f"angle_increment={self.angle_increment!r}"
            )
        if abs(self.angle_min) > _FULL_TURN:
            raise InvalidInput(
                f"angles of a scan are in radians, at most a full turn; got angle_min={self.angle_min:g}. If "
                f"it is in degrees, it is {math.radians(self.angle_min):.6g} rad"
            )
        increment = abs(self.angle_increment)
        if increment > _FULL_TURN or increment * (len(self.ranges) - 1) > _FULL_TURN + increment:
            raise InvalidInput(
                f"the rays of a scan cover at most a full turn [rad]; got {len(self.ranges)} rays with "
                f"angle_increment={self.angle_increment:g}. If it is in degrees, it is "
                f"{math.radians(self.angle_increment):.6g} rad"
            )
        if self.angle_increment == 0.0 and len(self.ranges) > 1:
            raise InvalidInput(
                f"angle_increment is 0, so that all {len(self.ranges)} rays would have one direction; pass "
                "the angle between two rays [rad], negative for a clockwise sweep"
            )

    def _check_limits(self) -> None:
        # NaN fails each comparison.
        if not 0.0 <= self.range_min <= self.range_max:
            raise InvalidInput(
                "the limits of a scan are 0 <= range_min <= range_max [m]; got "
                f"range_min={self.range_min!r}, range_max={self.range_max!r}"
            )

    __reduce__ = reduced_to_fields

    @property
    def is_rigid(self) -> bool:
        """Whether all rays have the stamp of the scan."""
        return self.ray_ns == 0

    @property
    def nbytes(self) -> int:
        """The bytes of its ranges and intensities."""
        return self.ranges.nbytes + (0 if self.intensities is None else self.intensities.nbytes)

    @property
    def end_stamp(self) -> int:
        """The instant of the last ray [ns]."""
        return self.stamp + self.ray_ns * (len(self.ranges) - 1)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which rays have a measurement: a finite range inside [range_min, range_max]. (N,)"""
        ranges = self.ranges
        # The limits are rounded to float32 here, as the ranges are. NaN fails each comparison.
        return (ranges >= self.range_min) & (ranges <= self.range_max) & (ranges < math.inf)

    def points(self) -> Floats32:
        """The measured points in ``frame``: (N, 3), x y z [m], NaN for rays that are not valid."""
        measured = np.where(self.valid, self.ranges, np.float32(math.nan))
        return _directions(self.angle_min, self.angle_increment, len(measured)) * measured[:, None]

    def stamps(self) -> NDArray[np.int64]:
        """The instant of each ray [ns]: (N,)."""
        return _offsets(self.ray_ns, len(self.ranges)) + self.stamp

    def __repr__(self) -> str:
        count = len(self.ranges)
        return (
            f"<Scan of {self.frame!r} at {format_stamp(self.stamp)}: {count} rays, "
            f"{np.count_nonzero(self.valid)} valid>"
        )


def scan_to_message(scan: Scan, scan_ns: int = 0) -> LaserScan:
    """``scan`` on the wire, without numbers of a writer.

    ``scan_ns`` [ns] is the time between two scans, 0 if it is not known.
    """
    intensities = None if scan.intensities is None else to_float32_block(scan.intensities)
    return LaserScan(
        scan.stamp,
        0,
        0,
        scan.frame,
        scan.angle_min,
        scan.angle_increment,
        scan.ray_ns,
        scan_ns,
        scan.range_min,
        scan.range_max,
        to_float32_block(scan.ranges),
        intensities,
    )


def scan_from_message(message: LaserScan, robot: str) -> Scan:
    """The scan of ``robot`` in ``message``; its frame has the full name.

    Raises InvalidInput if it is none: it has no rays, or all in one direction.
    """
    return Scan(
        message.stamp,
        message.angle_min,
        message.angle_increment,
        message.ray_ns,
        from_float32_block(message.ranges),
        message.range_min,
        message.range_max,
        full_name(robot, message.frame),
        None if message.intensities is None else from_float32_block(message.intensities),
    )


@lru_cache(maxsize=64)  # a sensor keeps its geometry
def _directions(angle_min: float, angle_increment: float, count: int) -> Floats32:
    """Unit vectors along the rays of a scan: (count, 3), read-only."""
    angles = angle_min + angle_increment * np.arange(count)
    vectors = np.stack((np.cos(angles), np.sin(angles), np.zeros(count)), axis=-1).astype(np.float32)
    vectors.flags.writeable = False
    return vectors


@lru_cache(maxsize=64)
def _offsets(ray_ns: int, count: int) -> NDArray[np.int64]:
    return ray_ns * np.arange(count, dtype=np.int64)


def _float32(values: Any, what: str) -> Floats32:
    """A read-only copy of ``values``, (N,). Raises InvalidInput for other shapes."""
    numbers = real_numbers(values, what)
    if numbers.ndim != 1:
        raise InvalidInput(f"{what} of a scan are a flat array (N,); got shape {numbers.shape}")
    with np.errstate(over="ignore"):  # numbers beyond float32 become infinite, and no measurement
        copy = numbers.astype(np.float32)
    copy.flags.writeable = False
    return copy


def _number(value: Any, name: str) -> float:
    number = real_numbers(value, name)
    if number.ndim:
        raise InvalidInput(f"{name} of a scan is one number; got shape {number.shape}")
    return float(number)


def _ray_ns(value: Any) -> int:
    try:
        ray_ns = operator.index(value)
    except TypeError:
        ray_ns = -1
    if ray_ns < 0 or isinstance(value, bool):
        raise InvalidInput(
            f"ray_ns is the time between two rays as a whole number of nanoseconds, 0 or more; got "
            f"{value!r}. From ROS: round(time_increment * 1e9)"
        )
    return check_stamp(ray_ns)
