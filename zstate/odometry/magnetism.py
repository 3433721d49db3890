"""The magnetic field of the Earth, and whether a magnetometer measures it or a motor."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

from zstate.errors import InvalidInput, LibraryMissing
from zstate.odometry.geodesy import check_geodetic

_STRENGTH_PART, _DIP = 0.1, math.radians(5.0)
"""A field that differs by more from what is expected is not that of the Earth alone."""
_CALM = 10
"""So many readings in a row that agree are what is expected from then on."""

_WEAKEST, _STRONGEST = 1e-6, 1e-3
"""[T] The Earth's field is 2.2e-5 to 6.7e-5; what is beyond these is of other units, or of a magnet."""

_YEAR_NS = 31_556_952_000_000_000


class EarthField(NamedTuple):
    """``declination`` of magnetic north to the east of true north [rad], ``strength`` [T], and ``dip``.

    ``dip`` [rad] is how far the field points below the horizontal.
    """

    declination: float
    strength: float
    dip: float


class UsualField(NamedTuple):
    """The mean ``strength`` [T] and ``dip`` [rad] of the first ``readings`` of a magnetometer."""

    strength: float
    dip: float
    readings: int


def earth_field(latitude: float, longitude: float, stamp: int) -> EarthField:
    """The field at a place on the Earth [deg], at the time ``stamp`` [ns], by the World Magnetic Model.

    Declinations are within 0.4 degrees at 47 degrees north, and within 0.9 at 80. Raises InvalidInput for
    what is no place, and for stamps before 2010 or after the last model; LibraryMissing without pygeomag.
    """
    check_geodetic(latitude, longitude, 0.0)
    return _modelled(latitude, longitude, round(1970.0 + stamp / _YEAR_NS, 1))


@lru_cache(maxsize=64)
def _modelled(latitude: float, longitude: float, year: float) -> EarthField:
    geomag = _pygeomag()
    try:
        model = geomag.GeoMag(base_year=int(year))
        field = model.calculate(glat=latitude, glon=longitude, alt=0.0, time=year)
    except ValueError as error:
        raise InvalidInput(
            f"the stamps are of the year {year:.1f}, for which pygeomag has no magnetic field of the Earth "
            f"({error}): leave the place out, or update pygeomag"
        ) from None
    return EarthField(math.radians(field.d), 1e-9 * field.f, math.radians(field.i))


def _pygeomag() -> Any:
    """The module. Raises LibraryMissing."""
    try:
        import pygeomag  # noqa: PLC0415 # pyright: ignore[reportMissingTypeStubs] - loaded when it is needed
    except ImportError:
        command = "pip install 'zstate[magnetometer]'"
        text = f"the Earth's magnetic field at a place needs pygeomag: {command}"
        raise LibraryMissing(text, command=command) from None
    return pygeomag


def check_strength(strength: float, source: str) -> None:
    """Raise InvalidInput, which names ``source``, for the strength [T] of a field without north."""
    if not _WEAKEST <= strength <= _STRONGEST:
        raise InvalidInput(
            f"the field of source {source!r} is {strength:.3g} T, and that of the Earth 2e-5 to 7e-5 T: 1 uT "
            "is 1e-6 T, 1 gauss 1e-4 T; or its bias is wrong"
        )


def usual_after(
    usual: UsualField | None, strength: float, dip: float, expected: EarthField | None
) -> UsualField:
    """What is usual after one more reading; with ``readings`` 1 if it is the first, or nothing was usual yet.

    Raises InvalidInput, with a sentence, for a reading that differs from the field that is ``expected`` at
    this place, or else from what is usual since the start.
    """
    if expected is not None:
        text = _difference(strength, dip, expected.strength, expected.dip, "of the Earth here")
    elif usual is not None:
        text = _difference(strength, dip, usual.strength, usual.dip, "at the start")
    else:
        text = ""
    if text and expected is None and usual is not None and usual.readings < _CALM:
        usual, text = None, ""  # the start was not calm: a new one
    if text:
        raise InvalidInput(text)
    if usual is None:
        return UsualField(strength, dip, 1)
    if usual.readings == _CALM:
        return usual
    count = usual.readings + 1
    return UsualField(
        usual.strength + (strength - usual.strength) / count, usual.dip + (dip - usual.dip) / count, count
    )


def _difference(strength: float, dip: float, known: float, known_dip: float, whose: str) -> str:
    """By how much a field differs from a known one, in a sentence; empty if by little."""
    part = strength / known - 1.0
    if abs(part) > _STRENGTH_PART:
        how = "stronger" if part > 0.0 else "weaker"
        return (
            f"the field is {1e6 * strength:.1f} uT, {100.0 * abs(part):.0f} % {how} than the "
            f"{1e6 * known:.1f} uT {whose}: iron or a motor is near, or the magnetometer is not calibrated"
        )
    if abs(dip - known_dip) > _DIP:
        return (
            f"the field points {math.degrees(dip):.0f} degrees below the horizontal, and {whose} "
            f"{math.degrees(known_dip):.0f}: iron or a motor is near, or the magnetometer is not calibrated"
        )
    return ""
