"""Scenarios: the workloads that every subject runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Load = Literal["none", "busy", "slow"]
Group = Literal["rate", "robot", "readers", "load", "fleet", "late"]

RATES = (50.0, 100.0, 200.0, 500.0, 1000.0, 0.0)
FLAT_OUT = 0.0


@dataclass(frozen=True)
class Scenario:
    """One workload: a robot at a rate, and its readers.

    ``rate_hz`` is 0 for as fast as possible; ``seconds`` is the measured window; ``fleet`` is the number
    of robots, published by ``writers`` processes; ``joins`` the number of late joiners. Runs in ``repeats``
    rounds, each with fresh processes.

    Of a fleet, each reader follows all robots, or the first ``follows``. Writers are clients of the first and
    readers of the last of ``routers`` in a row. With ``one_link`` the robots of a process share its link to
    the router; otherwise each has its own.
    """

    group: Group
    robot: str
    rate_hz: float
    readers: int = 1
    load: Load = "none"
    fleet: int = 1
    follows: int = 0
    routers: int = 1
    one_link: bool = False
    writers: int = 1
    joins: int = 0
    seconds: float = 4.0
    repeats: int = 1

    @property
    def name(self) -> str:
        """Short, unique and usable on a command line: ``talos-1000``, ``talos-100-readers5``."""
        parts = [self.robot, f"{self.rate_hz:g}" if self.rate_hz else "flat"]
        if self.readers > 1:
            parts.append(f"readers{self.readers}")
        if self.load != "none":
            parts.append(self.load)
        if self.fleet > 1:
            parts.append(f"fleet{self.fleet}")
        if self.follows:
            parts.append(f"follow{self.follows}")
        if self.routers > 1:
            parts.append(f"routers{self.routers}")
        if self.joins:
            parts.append("late")
        return "-".join(parts)

    @property
    def followed(self) -> int:
        """The number of robots that each reader follows."""
        return self.follows or self.fleet

    @property
    def rate(self) -> str:
        """The rate in words."""
        return f"{self.rate_hz:g} Hz" if self.rate_hz else "flat out"


def _rates(robot: str, rates: Sequence[float], repeats: int) -> list[Scenario]:
    """Rate scenarios; those of 100 Hz and 1 kHz, which ratios use, run in ``repeats`` rounds."""
    return [
        Scenario(
            "rate",
            robot,
            rate,
            seconds=4.0 if rate else 2.0,
            repeats=repeats if rate in (100.0, 1000.0) else 1,
        )
        for rate in rates
    ]


FULL: tuple[Scenario, ...] = (
    *_rates("panda", RATES, repeats=3),
    *_rates("talos", RATES, repeats=3),
    *(Scenario("robot", robot, rate) for robot in ("g1", "tiago_dual") for rate in (100.0, 1000.0)),
    Scenario("readers", "talos", 100.0, readers=5),
    Scenario("readers", "talos", 100.0, readers=20),
    Scenario("load", "talos", 100.0, load="busy"),
    Scenario("load", "talos", 200.0, load="slow"),
    Scenario("late", "talos", 100.0, joins=7),
    Scenario("fleet", "panda", 50.0, fleet=100, writers=4, seconds=8.0),
    Scenario("fleet", "a1", 10.0, fleet=1000, writers=4, one_link=True, seconds=8.0),
    Scenario("fleet", "a1", 10.0, fleet=1000, follows=50, routers=2, writers=4, one_link=True, seconds=8.0),
    Scenario("fleet", "a1", 10.0, fleet=50, routers=2, writers=4, one_link=True, seconds=8.0),
)
"""All scenarios: about three quarters of an hour with every subject installed."""

QUICK: tuple[Scenario, ...] = (
    Scenario("rate", "panda", 100.0, seconds=1.5),
    Scenario("rate", "talos", 100.0, seconds=1.5),
    Scenario("rate", "talos", 1000.0, seconds=1.5),
    Scenario("late", "talos", 100.0, joins=2),
)
"""A functional check and a rough comparison."""


def select_scenarios(scenarios: Sequence[Scenario], words: Sequence[str]) -> tuple[Scenario, ...]:
    """Scenarios with a name or group in ``words``; all if empty. Raises ValueError for an unknown word."""
    known = {word for one in scenarios for word in (one.name, one.group)}
    unknown = [word for word in words if word not in known]
    if unknown:
        raise ValueError(f"no scenario is called {', '.join(unknown)}; there are {', '.join(sorted(known))}")
    return tuple(one for one in scenarios if not words or one.name in words or one.group in words)
