"""The magnetic field of the Earth by pygeomag, and sentences on fields that are not that."""

import math
import sys

import pytest

from zstate.errors import InvalidInput, LibraryMissing
from zstate.odometry import magnetism
from zstate.odometry.magnetism import EarthField, UsualField, check_strength, earth_field, usual_after

_2016, _2025, _2031 = (round((year - 1970.0) * 365.2425 * 86400e9) for year in (2016.1, 2025.25, 2031.0))
USUAL = UsualField(48e-6, math.radians(63.0), 10)


@pytest.mark.parametrize(
    ("place", "stamp", "declination_deg"),
    [
        ((47.6205, -122.3493), _2025, 15.07),  # the first example of pygeomag
        ((55.94, -3.19), _2016, -2.56),  # Edinburgh
    ],
)
def test_declination_is_positive_where_the_needle_points_east_of_north(
    place: tuple[float, float], stamp: int, declination_deg: float
):
    assert math.degrees(earth_field(*place, stamp).declination) == pytest.approx(declination_deg, abs=0.05)


def test_the_field_points_down_in_the_north_and_up_in_the_south_and_is_weakest_in_paraguay():
    north, south = earth_field(75.0, -100.0, _2025), earth_field(-60.0, 137.0, _2025)
    assert north.dip > math.radians(85.0)
    assert south.dip < math.radians(-85.0)
    assert earth_field(-26.0, -58.0, _2025).strength == pytest.approx(22.3e-6, rel=0.02)


def test_stamps_without_a_model_and_what_is_no_place_are_refused():
    for stamp, year in ((_2031, "2031.0"), (0, "1970.0")):
        with pytest.raises(InvalidInput, match=f"of the year {year}, for which .*: leave the place out"):
            earth_field(47.0, 8.0, stamp)
    with pytest.raises(InvalidInput, match="a place has a latitude"):
        earth_field(91.0, 8.0, _2025)


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch):
    magnetism._modelled.cache_clear()
    monkeypatch.setitem(sys.modules, "pygeomag", None)
    with pytest.raises(LibraryMissing, match=r"pip install 'zstate\[magnetometer\]'"):
        earth_field(47.0, 8.0, _2025)


@pytest.mark.parametrize("strength", [0.48, 480.0, 0.0, math.nan])
def test_a_strength_in_gauss_or_microtesla_is_refused_with_both_units(strength: float):
    with pytest.raises(InvalidInput, match=r"'mag' is .* 1 uT is 1e-6 T, 1 gauss 1e-4 T"):
        check_strength(strength, "mag")


@pytest.mark.parametrize(
    ("factor", "tilt_deg", "text"),
    [
        (1.3, 0.0, "62.4 uT, 30 % stronger than the 48.0 uT at the start: iron or a motor"),
        (0.85, 0.0, "40.8 uT, 15 % weaker than the 48.0 uT at the start"),
        (1.0, 8.0, "71 degrees below the horizontal, and at the start 63: iron or a motor"),
        (1.0, -8.0, "55 degrees below the horizontal, and at the start 63"),
    ],
)
def test_a_field_that_is_not_the_usual_one_is_named(factor: float, tilt_deg: float, text: str):
    with pytest.raises(InvalidInput, match=text):
        usual_after(USUAL, factor * USUAL.strength, USUAL.dip + math.radians(tilt_deg), None)


def test_a_field_is_compared_with_that_of_the_earth_if_it_is_known():
    expected = EarthField(0.0, 40e-6, USUAL.dip)
    with pytest.raises(InvalidInput, match=r"20 % stronger than the 40.0 uT of the Earth here"):
        usual_after(USUAL, USUAL.strength, USUAL.dip, expected)
    assert usual_after(None, 41e-6, USUAL.dip, expected).strength == 41e-6


def test_ten_readings_that_agree_are_usual_and_an_outlier_before_starts_anew():
    usual = usual_after(None, 100e-6, 1.0, None)
    for number in range(12):
        usual = usual_after(usual, (47e-6, 49e-6)[number % 2], 1.0, None)
        assert usual.readings == min(number + 1, 10)
    assert usual.strength == pytest.approx(48e-6)


@pytest.mark.parametrize(("change", "is_usual"), [(0.0999, True), (0.1001, False)])
def test_ten_percent_of_strength_are_usual(change: float, is_usual: bool):
    for sign in (-1.0, 1.0):
        strength = (1.0 + sign * change) * USUAL.strength
        if is_usual:
            assert usual_after(USUAL, strength, USUAL.dip, None) == USUAL
        else:
            with pytest.raises(InvalidInput, match="10 %"):
                usual_after(USUAL, strength, USUAL.dip, None)
