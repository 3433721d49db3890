"""Random histories of a control loop: no setpoint that must not be. ``loop_fuzz.py`` runs more of them."""

from __future__ import annotations

import pytest
from driving.loop_fuzz import run_all

TICKS = 1000


@pytest.mark.parametrize("seeds", [12, pytest.param(200, marks=pytest.mark.soak)])
@pytest.mark.long
def test_no_history_of_commands_stops_and_faults_has_a_setpoint_that_must_not_be(seeds: int):
    happened = run_all(range(seeds), TICKS)
    assert happened["tick"] >= seeds * TICKS
    assert happened["write"] > 0.3 * happened["tick"]
    # It is no empty claim: there were all states, and all events.
    states = {"ready", "active", "holding", "stopped"}
    events = {
        "burst",
        "motion",
        "node",
        "stop",
        "release",
        "lie",
        "fail",
        "push",
        "pause",
        "restart",
        "token",
    }
    assert min(happened[name] for name in states | events) > 20
    assert happened["not admitted: no claim"]
    assert happened["not admitted: late"]
    assert happened["refused: not released"]
    assert happened["refused: outside limits"]
