"""Outcome: one subject in one scenario, all rounds together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from math import fsum
from statistics import median
from typing import Any

from bench.recording import percentile
from bench.results import Facts, Results
from bench.scenario import Scenario


class Outcome:
    """Figures over the rounds: medians of them, but sums where samples are counted, and the worst maximum.

    Where there are several readers, the rate is that of the slowest and latencies are medians of theirs.
    """

    def __init__(self, scenario: Scenario, runs: Sequence[Facts]) -> None:
        self.scenario = scenario
        self.rounds = len(runs)
        self._runs = runs

    def _median(self, figure: Callable[[Facts], float]) -> float:
        return median(figure(run) for run in self._runs)

    @property
    def _readers(self) -> Iterable[Facts]:
        return (reader for run in self._runs for reader in run["readers"])

    @property
    def sent_hz(self) -> float:
        """Samples that were sent each second, of each robot."""
        return self._median(lambda run: run["sent_hz"]) / self.scenario.fleet

    @property
    def rate_hz(self) -> float:
        """Samples of each robot that a reader's buffer answered, each second."""
        slowest = self._median(lambda run: min(reader["rate_hz"] for reader in run["readers"]))
        return slowest / self.scenario.fleet

    @property
    def sent(self) -> int:
        """Samples that were sent, all rounds and readers counted."""
        return sum(run["sent"] * len(run["readers"]) for run in self._runs)

    @property
    def lost(self) -> int:
        """Of these, those that were never answered."""
        return sum(reader["lost"] for reader in self._readers)

    @property
    def late(self) -> int | None:
        """Of these, those that were answered later than a period after their stamp; None when flat out."""
        late = [reader["late"] for reader in self._readers]
        return None if None in late else sum(late)

    @cached_property
    def grid_us(self) -> list[float]:
        """The distribution of latencies [us] at the percentiles of ``recording.GRID``; empty without any."""
        grids = [
            [median(values) for values in zip(*given, strict=True)]
            for run in self._runs
            if (given := [reader["latency_us"] for reader in run["readers"] if reader["latency_us"]])
        ]
        return [median(values) for values in zip(*grids, strict=True)] if grids else []

    def latency_us(self, percent: float) -> float | None:
        """One of these percentiles; of 100 the worst of all."""
        if not self.grid_us:
            return None
        if percent == 100:
            return max(reader["latency_us"][-1] for reader in self._readers if reader["latency_us"])
        return percentile(self.grid_us, percent)

    def cpu_percent(self) -> dict[str, float]:
        """CPU of each role [% of a core]; readers together."""
        roles = self._runs[0]["cpu_percent"]
        return {role: self._median(lambda run, role=role: run["cpu_percent"][role]) for role in roles}

    @property
    def cpu_total(self) -> float:
        """CPU of all processes together [% of a core]."""
        return fsum(self.cpu_percent().values())

    @property
    def cpu_between(self) -> float:
        """CPU of those between writer and readers: a router, a master, a daemon [% of a core]."""
        return fsum(used for role, used in self.cpu_percent().items() if role not in ("writer", "reader"))

    @property
    def bytes_per_s(self) -> float:
        """What loopback carried each second, heads of IP and TCP included."""
        return self._median(lambda run: run["bytes_per_s"])

    @property
    def bytes_per_sample(self) -> float:
        """The same for each sample that was sent."""
        return self._median(lambda run: run["bytes_per_s"] * run["window_s"] / max(1, run["sent"]))

    def memory_mb(self) -> dict[str, float]:
        """The most memory of each role [MB]; readers together."""
        roles = self._runs[0]["peak_memory_mb"]
        return {role: self._median(lambda run, role=role: run["peak_memory_mb"][role]) for role in roles}

    @property
    def joins_ms(self) -> list[float]:
        """After how long [ms] late joiners had the whole tree."""
        return sorted(one for run in self._runs for one in run["whole_ms"])

    @property
    def connections_ms(self) -> list[float]:
        """How much of that [ms] opening the session and subscribing took."""
        return sorted(one for run in self._runs for one in run["connected_ms"])

    def poses(self) -> list[Facts]:
        """The comparisons of answers with kinematics, one for each round."""
        return [run["poses"] for run in self._runs if "poses" in run]

    @property
    def others_percent(self) -> float:
        """CPU of everything else on the machine [% of a core], the worst round."""
        return max(run["others_cpu_percent"] for run in self._runs)


def outcome(results: Results, subject: str, scenario: Scenario) -> Outcome | None:
    """What there is of one subject in one scenario; None when it was not run, or failed."""
    runs = results.of(subject, scenario)
    return Outcome(scenario, runs) if runs else None


def outcomes(results: Results, scenario: Scenario) -> dict[str, Outcome]:
    """All that there are, by subject."""
    found = ((name, outcome(results, name, scenario)) for name in results.subjects)
    return {name: one for name, one in found if one is not None}


def find(results: Results, **wanted: Any) -> list[Scenario]:
    """The scenarios that were run and have these values."""
    return [
        one for one in results.scenarios if all(getattr(one, name) == value for name, value in wanted.items())
    ]
