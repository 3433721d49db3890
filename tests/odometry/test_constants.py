"""Constants of the estimator that no formula gives: half of each, and twice, are as good.

An estimator whose claims hold for one value only is tuned to the drives of these tests.
"""

from __future__ import annotations

from importlib import import_module

import pytest
from helpers import recordings
from helpers.recordings import calls_of, played, score
from odometry import test_faults as faults
from odometry.test_vibration import END_SIGMAS, VIBRATIONS, end_of

_FUSION = "zstate.odometry.fusion"
CHOSEN = [
    (_FUSION, "_VIBRATION_S"),
    ("zstate.odometry.turning", "_STRAIGHT"),
    (_FUSION, "_USUAL_BIAS"),
    (_FUSION, "_TELLING"),
    ("zstate.odometry.turning", "_SCALE"),
    ("zstate.odometry.turning", "COMPARED_S"),
    (_FUSION, "_STILL_SPEED"),
    (_FUSION, "_LEAST_SPEED_BOUND"),
    (_FUSION, "_PAUSE_SLIP"),
    (_FUSION, "_UNPROVEN"),
    ("zstate.odometry.alignment", "_UNKNOWN_GYRO_BIAS"),
]
"""The module that uses a constant, and its name; each module that imports a name has a row of its own."""

pytestmark = pytest.mark.soak  # some minutes

THREE_SIGMA = 3.5
FAULTS = (
    "none",
    "one sample of 16 g ahead",
    "pause of 13 s at rest",
    "wheels spin for 5 s while driving",
    "0.3 m/s with sigma 0.5",
)


def scaled(monkeypatch: pytest.MonkeyPatch, module: str, name: str, factor: float) -> None:
    value = getattr(import_module(module), name)
    monkeypatch.setattr(import_module(module), name, type(value)(value * factor))


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize(("module", "name"), CHOSEN)
def test_a_recording_is_inside_its_claim_with_half_a_constant_and_with_twice(
    monkeypatch: pytest.MonkeyPatch, module: str, name: str, factor: float
):
    scaled(monkeypatch, module, name, factor)
    husky = recordings.load("husky")
    t, path = recordings.dead_reckoned(husky)
    found = score(husky, played(husky, calls_of(husky, has_compass=True)))
    assert found.error < 1.5 * recordings.error_of(husky, t, path)
    assert found.end_sigmas < THREE_SIGMA


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize(("module", "name"), CHOSEN)
def test_faults_and_vibration_are_inside_their_claims_with_half_a_constant_and_with_twice(
    monkeypatch: pytest.MonkeyPatch, module: str, name: str, factor: float
):
    scaled(monkeypatch, module, name, factor)
    for fault in FAULTS:
        assert faults.findings(faults.FAULTS[fault], faults.played(faults.FAULTS[fault])) == [], fault
    assert end_of("diff drive", 0, 30.0, VIBRATIONS["white"]).sigmas < END_SIGMAS
