"""Scenarios and the order of the runs."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from bench.run import plan_turns
from bench.scenario import FULL, QUICK, Scenario, select_scenarios
from bench.subjects import raw_zenoh

ALONE = raw_zenoh.SUBJECT
SUBJECTS = [replace(ALONE, name=name, fleet=name == "c") for name in ("a", "b", "c", "d")]


@pytest.mark.parametrize("scenarios", [FULL, QUICK])
def test_scenario_names_are_unique(scenarios: tuple[Scenario, ...]) -> None:
    assert len({one.name for one in scenarios}) == len(scenarios)


def test_full_run_covers_all_robots_rates_and_loads() -> None:
    rates = {one.rate_hz for one in FULL if one.group == "rate" and one.robot == "talos"}
    assert rates == {50.0, 100.0, 200.0, 500.0, 1000.0, 0.0}
    assert {one.robot for one in FULL if one.rate_hz == 1000.0} == {"panda", "g1", "talos", "tiago_dual"}
    assert {one.readers for one in FULL} == {1, 5, 20}
    assert {one.load for one in FULL} == {"none", "busy", "slow"}
    fleets = [(one.fleet, one.rate_hz, one.followed, one.routers) for one in FULL if one.fleet > 1]
    assert fleets == [(100, 50.0, 100, 1), (1000, 10.0, 1000, 1), (1000, 10.0, 50, 2), (50, 10.0, 50, 2)]
    assert any(one.joins for one in FULL)


def test_word_selects_a_scenario_or_a_group() -> None:
    assert [one.name for one in select_scenarios(FULL, ["readers"])] == [
        "talos-100-readers5",
        "talos-100-readers20",
    ]
    assert [one.name for one in select_scenarios(FULL, ["talos-1000", "late"])] == [
        "talos-1000",
        "talos-100-late",
    ]
    assert select_scenarios(FULL, []) == FULL


def test_unknown_word_error_lists_known_words() -> None:
    with pytest.raises(ValueError, match=r"no scenario is called talos-7; there are .*talos-1000"):
        select_scenarios(FULL, ["talos-7"])


def test_every_subject_runs_every_round_except_fleets_it_cannot_run() -> None:
    scenarios = [Scenario("rate", "panda", 100.0, repeats=3), Scenario("fleet", "panda", 50.0, fleet=9)]
    planned = plan_turns(SUBJECTS, scenarios, 2, seed=1)
    count = Counter((turn.subject.name, turn.scenario.name) for turn in planned)
    assert count == {
        **{(name, "panda-100"): 6 for name in "abcd"},
        ("c", "panda-50-fleet9"): 2,
    }


def test_subjects_of_a_round_run_consecutively_in_shuffled_order() -> None:
    planned = plan_turns(SUBJECTS, [Scenario("rate", "panda", 100.0, repeats=20)], 1, seed=5)
    rounds = [planned[at : at + 4] for at in range(0, len(planned), 4)]
    assert [{turn.round for turn in one} for one in rounds] == [{number} for number in range(20)]
    orders = {"".join(turn.subject.name for turn in one) for one in rounds}
    assert all(sorted(order) == ["a", "b", "c", "d"] for order in orders)
    assert len(orders) > 5


def test_equal_seeds_give_equal_orders() -> None:
    first, second, other = (
        [(turn.subject.name, turn.scenario.name) for turn in plan_turns(SUBJECTS, QUICK, 1, seed)]
        for seed in (3, 3, 4)
    )
    assert first == second
    assert first != other
