"""Aggregated figures of one subject in one scenario over all rounds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from math import fsum
from statistics import median
from typing import Any

from bench.recording import percentile
from bench.results import Facts, Results
from bench.scenario import Scenario


class Aggregate:
    """Figures over the rounds: medians, but sums of sample counts and the largest maximum.

    With several readers, the rate is that of the slowest and latencies are medians over readers.
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
        """Samples sent per second and robot."""
        return self._median(lambda run: run["sent_hz"]) / self.scenario.fleet

    @property
    def rate_hz(self) -> float:
        """Samples answered by a reader's buffer, per second and robot."""
        slowest = self._median(lambda run: min(reader["rate_hz"] for reader in run["readers"]))
        return slowest / self.scenario.followed

    @property
    def sent(self) -> int:
        """Samples sent, summed over rounds and readers."""
        return sum(run["sent"] * len(run["readers"]) for run in self._runs)

    @property
    def lost(self) -> int:
        """Sent samples that were never answered."""
        return sum(reader["lost"] for reader in self._readers)

    @property
    def late(self) -> int | None:
        """Samples answered more than a period after their stamp; None if flat out."""
        late = [reader["late"] for reader in self._readers]
        return None if None in late else sum(late)

    @cached_property
    def grid_us(self) -> list[float]:
        """Latencies [us] at the percentiles of ``recording.GRID``; empty if there are none."""
        grids = [
            [median(values) for values in zip(*given, strict=True)]
            for run in self._runs
            if (given := [reader["latency_us"] for reader in run["readers"] if reader["latency_us"]])
        ]
        return [median(values) for values in zip(*grids, strict=True)] if grids else []

    def latency_us(self, percent: float) -> float | None:
        """One percentile of the latency [us]; for 100 the maximum over all readers."""
        if not self.grid_us:
            return None
        if percent == 100:
            return max(reader["latency_us"][-1] for reader in self._readers if reader["latency_us"])
        return percentile(self.grid_us, percent)

    def cpu_percent(self) -> dict[str, float]:
        """CPU per role [% of a core]; the sum over readers."""
        roles = self._runs[0]["cpu_percent"]
        return {role: self._median(lambda run, role=role: run["cpu_percent"][role]) for role in roles}

    @property
    def cpu_total(self) -> float:
        """CPU of all processes together [% of a core]."""
        return fsum(self.cpu_percent().values())

    @property
    def cpu_between(self) -> float:
        """CPU of the processes between writer and readers: router, master, daemon [% of a core]."""
        return fsum(used for role, used in self.cpu_percent().items() if role not in ("writer", "reader"))

    @property
    def bytes_per_s(self) -> float:
        """Loopback bytes per second, IP and TCP headers included."""
        return self._median(lambda run: run["bytes_per_s"])

    @property
    def bytes_per_sample(self) -> float:
        """Loopback bytes per sent sample."""
        return self._median(lambda run: run["bytes_per_s"] * run["window_s"] / max(1, run["sent"]))

    def memory_mb(self) -> dict[str, float]:
        """Peak memory per role [MB]; the sum over readers."""
        roles = self._runs[0]["peak_memory_mb"]
        return {role: self._median(lambda run, role=role: run["peak_memory_mb"][role]) for role in roles}

    @property
    def joins_ms(self) -> list[float]:
        """Times until late joiners had the whole tree [ms], ascending."""
        return sorted(one for run in self._runs for one in run["whole_ms"])

    @property
    def connections_ms(self) -> list[float]:
        """Times late joiners took to open the session and subscribe [ms], ascending."""
        return sorted(one for run in self._runs for one in run["connected_ms"])

    def poses(self) -> list[Facts]:
        """Comparisons of answers with kinematics, one per round."""
        return [run["poses"] for run in self._runs if "poses" in run]

    @property
    def others_percent(self) -> float:
        """CPU of the rest of the machine [% of a core] in the worst round."""
        return max(run["others_cpu_percent"] for run in self._runs)


def aggregate(results: Results, subject: str, scenario: Scenario) -> Aggregate | None:
    """Figures of one subject in one scenario; None if it was not run or failed."""
    runs = results.completed_runs(subject, scenario)
    return Aggregate(scenario, runs) if runs else None


def aggregates(results: Results, scenario: Scenario) -> dict[str, Aggregate]:
    """Figures of all measured subjects in one scenario, by subject."""
    found = ((name, aggregate(results, name, scenario)) for name in results.subjects)
    return {name: one for name, one in found if one is not None}


def find_scenarios(results: Results, **values: Any) -> list[Scenario]:
    """The scenarios of a run with these values."""
    return [
        one for one in results.scenarios if all(getattr(one, name) == value for name, value in values.items())
    ]
