"""Scenarios and the order of the runs."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from bench.scenario import ALL, PAGE, SOAKS, Scenario, plan_turns, select_scenarios
from bench.subjects import raw_zenoh

ALONE = raw_zenoh.SUBJECTS[0]
SUBJECTS = [replace(ALONE, name=name, fleet=name == "c") for name in ("a", "b", "c", "d")]


def test_scenario_names_are_unique() -> None:
    assert len({one.name for one in (*ALL, *SOAKS)}) == len(ALL) + len(SOAKS)


def test_page_has_the_rate_of_robots_and_the_highest_one_in_five_rounds_of_ten_seconds() -> None:
    assert [(one.name, one.rounds, one.seconds) for one in PAGE] == [
        ("panda-100", 5, 10.0),
        ("talos-1000", 5, 10.0),
    ]


def test_all_scenarios_cover_robots_rates_readers_and_fleets() -> None:
    rates = {one.rate_hz for one in ALL if one.robot == "talos"}
    assert rates == {50.0, 100.0, 200.0, 500.0, 1000.0}
    assert {one.robot for one in ALL if one.rate_hz == 1000.0} == {"panda", "g1", "talos", "tiago_dual"}
    assert {one.readers for one in ALL} == {1, 5, 20}
    fleets = [(one.fleet, one.rate_hz, one.followed, one.routers) for one in ALL if one.fleet > 1]
    assert fleets == [(100, 50.0, 100, 1), (1000, 10.0, 1000, 1), (1000, 10.0, 50, 2), (50, 10.0, 50, 2)]


def test_patterns_select_scenarios_and_a_soak_is_run_only_by_name() -> None:
    assert [one.name for one in select_scenarios(["*-readers*", "panda-100"])] == [
        "panda-100",
        "talos-100-readers5",
        "talos-100-readers20",
    ]
    assert select_scenarios([]) == ALL
    assert select_scenarios(["*-soak"]) == SOAKS
    assert {(one.rounds, one.seconds) for one in select_scenarios([], rounds=2, seconds=1.0)} == {(2, 1.0)}


def test_unknown_pattern_error_lists_known_names() -> None:
    with pytest.raises(ValueError, match=r"no scenario is called talos-7; there are .*talos-1000"):
        select_scenarios(["talos-7"])


def test_every_subject_runs_every_round_except_fleets_it_cannot_run() -> None:
    scenarios = [Scenario("panda", 100.0, rounds=6), Scenario("panda", 50.0, fleet=9, rounds=2)]
    planned = plan_turns(SUBJECTS, scenarios, seed=1)
    count = Counter((turn.subject.name, turn.scenario.name) for turn in planned)
    assert count == {**{(name, "panda-100"): 6 for name in "abcd"}, ("c", "panda-50-fleet9"): 2}


def test_subjects_of_a_round_run_consecutively_in_shuffled_order() -> None:
    planned = plan_turns(SUBJECTS, [Scenario("panda", 100.0, rounds=20)], seed=5)
    rounds = [planned[at : at + 4] for at in range(0, len(planned), 4)]
    assert [{turn.round for turn in one} for one in rounds] == [{number} for number in range(20)]
    orders = {"".join(turn.subject.name for turn in one) for one in rounds}
    assert all(sorted(order) == ["a", "b", "c", "d"] for order in orders)
    assert len(orders) > 5


def test_equal_seeds_give_equal_orders() -> None:
    first, second, other = (
        [(turn.subject.name, turn.scenario.name) for turn in plan_turns(SUBJECTS, PAGE, seed)]
        for seed in (3, 3, 4)
    )
    assert first == second
    assert first != other
