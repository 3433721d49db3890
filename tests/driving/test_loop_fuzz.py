"""Random histories of a control loop: no setpoint that must not be. ``loop_fuzz.py`` runs more of them."""

from __future__ import annotations

from driving.loop_fuzz import run_all

SEEDS = 20
TICKS = 1000


def test_no_history_of_commands_stops_and_faults_has_a_setpoint_that_must_not_be():
    happened = run_all(range(SEEDS), TICKS)
    assert happened["tick"] >= SEEDS * TICKS
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
