"""Runs every subject in every scenario, interleaved."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench import results
from bench.scenario import Scenario
from bench.subjects.subject import Subject
from bench.trial import Facts, run_trial


@dataclass(frozen=True)
class Turn:
    """One subject's turn in one round of a scenario."""

    subject: Subject
    scenario: Scenario
    round: int


def plan_turns(
    subjects: Sequence[Subject], scenarios: Sequence[Scenario], repeat: int, seed: int
) -> list[Turn]:
    """Every turn, in order.

    Within a round of a scenario the subjects follow each other in a shuffled order, so that compared figures
    come from the same minutes. Fleet scenarios run only subjects with ``fleet``.
    """
    order = random.Random(seed)
    return [turn for turn_set in _rounds(subjects, scenarios, repeat, order) for turn in turn_set]


def _rounds(
    subjects: Sequence[Subject], scenarios: Sequence[Scenario], repeat: int, order: random.Random
) -> Iterator[list[Turn]]:
    rounds = max((one.repeats for one in scenarios), default=0) * repeat
    for number in range(rounds):
        for scenario in scenarios:
            if number < scenario.repeats * repeat:
                able = [one for one in subjects if one.fleet or scenario.fleet == 1]
                yield [Turn(one, scenario, number) for one in order.sample(able, len(able))]


def run(folder: Path, planned: Sequence[Turn], on_turn: Callable[[int, Turn, Facts | None], None]) -> None:
    """Runs every turn and appends its result; ``on_turn`` is called before and after each turn."""
    for number, turn in enumerate(planned):
        on_turn(number, turn, None)
        load = os.getloadavg()[0]
        facts = run_trial(turn.subject, turn.scenario)
        head = {"subject": turn.subject.name, "scenario": turn.scenario.name, "round": turn.round}
        results.append_run(folder, {**head, "turn": number, "load_before": round(load, 2), **facts})
        on_turn(number, turn, facts)


def estimated_seconds(planned: Sequence[Turn]) -> float:
    """Estimated duration [s], dominated by starting a router, ROS or twenty readers."""
    return sum(
        3.5 + one.scenario.seconds + 0.4 * one.scenario.readers + 1.2 * one.scenario.joins for one in planned
    )
