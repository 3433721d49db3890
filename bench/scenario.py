"""Scenarios: the workloads that every subject runs."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from typing import Any

from bench.subjects.subject import Subject


@dataclass(frozen=True)
class Scenario:
    """One workload: a robot at a rate, and its readers.

    ``seconds`` is the measured window; it runs in ``rounds``, each with fresh processes. ``fleet`` is the
    number of robots, published by ``writers`` processes. After the window ``joins`` late joiners follow, one
    after the other.

    Of a fleet, each reader follows all robots, or the first ``follows``. Writers are clients of the first and
    readers of the last of ``routers`` in a row. With ``one_link`` the robots of a process share its link to
    the router; otherwise each has its own.

    A scenario that ``soaks`` has a late joiner each minute of its window, and measures what grows.
    """

    robot: str
    rate_hz: float
    readers: int = 1
    fleet: int = 1
    follows: int = 0
    routers: int = 1
    one_link: bool = False
    writers: int = 1
    joins: int = 0
    seconds: float = 4.0
    rounds: int = 1
    soaks: bool = False

    @property
    def name(self) -> str:
        """Short, unique and usable on a command line: ``talos-1000``, ``talos-100-readers5``."""
        words = {
            "readers": self.readers,
            "fleet": self.fleet,
            "follow": self.follows,
            "routers": self.routers,
        }
        parts = [f"{word}{count}" for word, count in words.items() if count > 1]
        soak = ["soak"] if self.soaks else []
        return "-".join([self.robot, f"{self.rate_hz:g}", *parts, *soak])

    @property
    def title(self) -> str:
        """What it is, in words."""
        text = f"{self.robot} at {self.rate_hz:g} Hz"
        if self.fleet > 1:
            text = f"{self.fleet} x {text} each; a reader of {self.followed}; routers: {self.routers}"
        if self.readers > 1:
            text += f", {self.readers} readers, whose costs are summed"
        return f"{text}, for {self.seconds / 60:g} minutes" if self.soaks else text

    @property
    def followed(self) -> int:
        """The number of robots that each reader follows."""
        return self.follows or self.fleet


PAGE = (
    Scenario("panda", 100.0, joins=1, seconds=10.0, rounds=5),
    Scenario("talos", 1000.0, joins=1, seconds=10.0, rounds=5),
)
"""Those of the page and the README: the rate of most robots, and the highest one."""

QUICK = (Scenario("panda", 100.0, seconds=2.0),)

ALL = (
    *PAGE,
    *(Scenario("panda", rate) for rate in (50.0, 200.0, 500.0, 1000.0)),
    *(Scenario("talos", rate) for rate in (50.0, 100.0, 200.0, 500.0)),
    *(Scenario(robot, rate) for robot in ("g1", "tiago_dual") for rate in (100.0, 1000.0)),
    *(Scenario("talos", 100.0, readers=readers) for readers in (5, 20)),
    Scenario("panda", 50.0, fleet=100, writers=4, seconds=8.0),
    Scenario("a1", 10.0, fleet=1000, writers=4, one_link=True, seconds=8.0),
    Scenario("a1", 10.0, fleet=1000, follows=50, routers=2, writers=4, one_link=True, seconds=8.0),
    Scenario("a1", 10.0, fleet=50, routers=2, writers=4, one_link=True, seconds=8.0),
)
SOAKS = (Scenario("panda", 50.0, fleet=100, writers=4, seconds=600.0, soaks=True),)
"""Run only when they are named."""


@dataclass(frozen=True)
class Turn:
    """One subject's turn in one round of a scenario."""

    subject: Subject
    scenario: Scenario
    round: int


def select_scenarios(patterns: Sequence[str], **changes: Any) -> tuple[Scenario, ...]:
    """The scenarios whose names match one of ``patterns``, or ALL, with the ``changes`` that are not None.

    Raises ValueError for a pattern that matches none.
    """
    known = (*ALL, *SOAKS)
    for pattern in patterns:
        if not any(fnmatch(one.name, pattern) for one in known):
            names = ", ".join(one.name for one in known)
            raise ValueError(f"no scenario is called {pattern}; there are {names}")
    chosen = [one for one in known if any(fnmatch(one.name, pattern) for pattern in patterns)]
    given = {name: value for name, value in changes.items() if value is not None}
    return tuple(replace(one, **given) for one in (chosen if patterns else ALL))


def plan_turns(subjects: Sequence[Subject], scenarios: Sequence[Scenario], seed: int) -> list[Turn]:
    """Every turn, in order.

    Within a round of a scenario the subjects follow each other in a shuffled order, so that compared figures
    come from the same minutes. Fleets run only subjects with ``fleet``.
    """
    order = random.Random(seed)
    return [turn for turns in _rounds(subjects, scenarios, order) for turn in turns]


def _rounds(
    subjects: Sequence[Subject], scenarios: Sequence[Scenario], order: random.Random
) -> Iterator[list[Turn]]:
    for number in range(max((one.rounds for one in scenarios), default=0)):
        for scenario in scenarios:
            if number < scenario.rounds:
                able = [one for one in subjects if one.fleet or scenario.fleet == 1]
                yield [Turn(one, scenario, number) for one in order.sample(able, len(able))]


def estimated_seconds(turns: Sequence[Turn]) -> float:
    """Estimated duration [s], dominated by starting a router, ROS or twenty readers."""
    return sum(
        3.5 + at.seconds + 0.4 * at.readers + 1.5 * at.joins for at in (turn.scenario for turn in turns)
    )
