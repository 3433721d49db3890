"""Datum against PROJ: its steps ``cart`` and ``topocentric`` have the same definition."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from pyproj import Transformer

from zstate import InvalidInput
from zstate.odometry.geodesy import Datum
from zstate.odometry.invariant_filter import Floats

MILLIMETRE = 1e-3
PLACES = {
    "the equator": Datum(0.0, 11.0),
    "45 degrees": Datum(45.0, -71.0, 250.0),
    "80 degrees": Datum(80.0, 20.0, 30.0),
    "89.9 degrees": Datum(89.9, -120.0),
    "the south pole": Datum(-90.0, 0.0, 2800.0),
    "the 180th meridian": Datum(-17.0, 179.98, 5.0),
    "the 180th meridian, eastern side": Datum(65.0, -179.99),
}
at_places = pytest.mark.parametrize("datum", PLACES.values(), ids=PLACES.keys())


def points(count: int, across: float = 1e4) -> Floats:
    """East, north and up within so many metres, and 200 m of height."""
    random = np.random.default_rng(0)
    return random.uniform((-across, -across, -200.0), (across, across, 200.0), (count, 3))


def by_proj(datum: Datum) -> Callable[[float, float, float], tuple[float, float, float]]:
    """East, north and up by longitude, latitude [deg] and altitude."""
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={datum.longitude} +lat_0={datum.latitude} "
        f"+h_0={datum.altitude}"
    ).transform


@at_places
def test_the_plane_is_that_of_proj_to_a_millimetre_within_ten_kilometres(datum: Datum):
    transform = by_proj(datum)
    for point in points(300):
        latitude, longitude, altitude = datum.geodetic(point)
        expected = transform(longitude, latitude, altitude)
        np.testing.assert_allclose(datum.enu(latitude, longitude, altitude), expected, atol=MILLIMETRE)


@at_places
def test_a_point_of_the_plane_comes_back_from_its_latitude_and_longitude(datum: Datum):
    for point in points(300):
        np.testing.assert_allclose(datum.enu(*datum.geodetic(point)), point, atol=1e-3 * MILLIMETRE)


def test_the_datum_is_the_origin():
    for datum in PLACES.values():
        here = datum.enu(datum.latitude, datum.longitude, datum.altitude)
        np.testing.assert_array_equal(here, np.zeros(3))


def test_longitudes_on_both_sides_of_the_180th_meridian_are_neighbours():
    """0.02 degrees at the equator are 2226.4 m, by the definition of the ellipsoid."""
    datum = Datum(0.0, 179.99)
    east, north, up = datum.enu(0.0, -179.99, 0.0).tolist()
    assert east == pytest.approx(6378137.0 * math.sin(math.radians(0.02)), abs=MILLIMETRE)
    assert north == pytest.approx(0.0, abs=MILLIMETRE)
    assert datum.geodetic((east, north, up))[1] == pytest.approx(-179.99, abs=1e-9)


def test_up_is_not_the_height_above_a_curved_earth():
    """At the distance d, the ellipsoid is d^2 / 2 R below the plane: 7.8 m at 10 km."""
    datum = Datum(45.0, 0.0)
    latitude, longitude, altitude = datum.geodetic((1e4, 0.0, 0.0))
    assert altitude == pytest.approx(1e8 / 2.0 / 6.388e6, abs=0.01)
    assert datum.enu(latitude, longitude, 0.0)[2] == pytest.approx(-altitude, abs=0.01)


NO_PLACES = [
    (91.0, 0.0, 0.0),
    (-90.001, 0.0, 0.0),
    (0.0, 180.5, 0.0),
    (math.nan, 0.0, 0.0),
    (0.0, math.inf, 0.0),
    (0.0, 0.0, math.nan),
    (0.0, 0.0, -math.inf),
]


@pytest.mark.parametrize("place", NO_PLACES)
def test_what_is_no_place_on_the_earth_is_refused_with_its_numbers(place: tuple[float, float, float]):
    numbers = ", ".join(map(str, place))
    for make in (Datum, Datum(45.0, 0.0).enu):
        with pytest.raises(InvalidInput, match=f"latitude of -90 to 90 .* got {numbers}"):
            make(*place)


@pytest.mark.parametrize(
    "point", [(1.0, 2.0), (1.0, 2.0, 3.0, 4.0), [(1.0, 2.0, 3.0)], (1.0, math.nan, 0.0), 1.0]
)
def test_what_is_no_point_of_the_plane_is_refused(point: object):
    with pytest.raises(InvalidInput, match="x, y, z, all finite"):
        Datum(45.0, 0.0).geodetic(point)
