"""Datum: from latitude, longitude and altitude to a level plane, and back.

The plane is tangent to the WGS84 ellipsoid at the datum: x east, y north, z up. Latitude and longitude become
geocentric coordinates, which are turned into these axes; nothing is approximated, so there are no zones, and
poles and the 180th meridian are points as others. z is not the height above the ellipsoid: that grows by
the curvature of the Earth, 8 cm at 1 km and 7.8 m at 10 km.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from zstate.checks import Floats, real_numbers
from zstate.errors import InvalidInput

_A = 6378137.0
"""[m] The semi-major axis of WGS84 (NIMA TR8350.2)."""
_F = 1.0 / 298.257223563
_E2 = _F * (2.0 - _F)
"""The squared first eccentricity."""
_B = _A * (1.0 - _F)
_SECOND_E2 = _E2 / (1.0 - _E2)

_MOST_ALTITUDE = 1e7
"""[m] Above the orbits of the satellites, and below the centre of the Earth."""


SAME_DATUM_M = 0.01
"""Datums that are nearer to each other are one that was rounded."""


@dataclass(frozen=True, slots=True)
class Datum:
    """The origin of a map on the Earth: WGS84 latitude and longitude [deg], altitude above the ellipsoid [m].

    Raises InvalidInput unless latitude is within 90 degrees, longitude within 180 and all are finite.
    """

    latitude: float
    longitude: float
    altitude: float = 0.0

    def __post_init__(self) -> None:
        check_geodetic(self.latitude, self.longitude, self.altitude)

    def enu(self, latitude: float, longitude: float, altitude: float) -> Floats:
        """East, north and up from the datum [m], (3,). Raises InvalidInput as the datum itself."""
        check_geodetic(latitude, longitude, altitude)
        away = _geocentric(latitude, longitude, altitude) - _geocentric(
            self.latitude, self.longitude, self.altitude
        )
        return self._axes().dot(away)

    def __str__(self) -> str:
        return f"{self.latitude:.7f} {self.longitude:.7f} {self.altitude:.2f}"

    def distance(self, other: Datum) -> float:
        """To the origin of ``other`` [m]."""
        return float(np.linalg.norm(self.enu(other.latitude, other.longitude, other.altitude)))

    def geodetic(self, enu: ArrayLike) -> tuple[float, float, float]:
        """Latitude, longitude [deg] and altitude [m] of a point in the plane, (3,) [m].

        The inverse of ``enu``, to 1e-4 mm within 10 km: one step of Bowring, "Transformation from spatial to
        geographical coordinates", Survey Review 23, 1976. Raises InvalidInput for another shape, and for what
        is not finite.
        """
        point = real_numbers(enu, "a point in the plane of a datum")
        if point.shape != (3,) or not np.isfinite(point).all():
            raise InvalidInput(
                f"a point in the plane of a datum is x, y, z, all finite; got {point.tolist()}"
            )
        x, y, z = (
            _geocentric(self.latitude, self.longitude, self.altitude) + self._axes().T.dot(point)
        ).tolist()
        across = math.hypot(x, y)
        reduced = math.atan2(z * _A, across * _B)
        latitude = math.atan2(
            z + _SECOND_E2 * _B * math.sin(reduced) ** 3, across - _E2 * _A * math.cos(reduced) ** 3
        )
        sine, cosine = math.sin(latitude), math.cos(latitude)
        altitude = across * cosine + z * sine - _A * math.sqrt(1.0 - _E2 * sine * sine)
        return math.degrees(latitude), math.degrees(math.atan2(y, x)), altitude

    def _axes(self) -> Floats:
        """East, north and up in geocentric axes, (3, 3)."""
        sine, cosine = _sine_and_cosine(self.latitude)
        east, north = _sine_and_cosine(self.longitude)
        return np.array(
            (
                (-east, north, 0.0),
                (-sine * north, -sine * east, cosine),
                (cosine * north, cosine * east, sine),
            )
        )


def check_geodetic(latitude: float, longitude: float, altitude: float) -> None:
    """Raises InvalidInput for what is no place on the Earth."""
    if abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and abs(altitude) <= _MOST_ALTITUDE:
        return
    raise InvalidInput(
        "a place has a latitude of -90 to 90 and a longitude of -180 to 180 degrees, and an altitude in "
        f"metres; got {latitude}, {longitude}, {altitude}"
    )


def _geocentric(latitude: float, longitude: float, altitude: float) -> Floats:
    sine, cosine = _sine_and_cosine(latitude)
    east, north = _sine_and_cosine(longitude)
    radius = _A / math.sqrt(1.0 - _E2 * sine * sine)  # of curvature, in the prime vertical
    across = (radius + altitude) * cosine
    return np.array((across * north, across * east, (radius * (1.0 - _E2) + altitude) * sine))


def _sine_and_cosine(degrees: float) -> tuple[float, float]:
    angle = math.radians(degrees)
    return math.sin(angle), math.cos(angle)
