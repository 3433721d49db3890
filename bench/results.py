"""A results folder: raw figures and their origin, and the figures of a subject over its rounds.

``about.json`` describes the machine, subjects and scenarios; ``runs.jsonl`` has one line per run, appended as
soon as it is done; ``micro.jsonl`` has the rows of micro benchmarks. Tables and charts are generated from
these files only.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from math import fsum
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple, TypeAlias

from bench.recording import percentile
from bench.robot import MODELS, bench_robot
from bench.scenario import Scenario
from bench.subjects.subject import Subject

Facts: TypeAlias = "dict[str, Any]"

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "bench" / "results"
ABOUT, RUNS, MICRO = "about.json", "runs.jsonl", "micro.jsonl"
CODE = ("zstate", "bench/*.py", "bench/*.cpp", "setup.py")


class Spread(NamedTuple):
    """A figure over the rounds."""

    median: float
    least: float
    most: float


def itself(_: Scenario, value: float) -> float:
    """The loss of a figure of which less is better."""
    return value


@dataclass(frozen=True)
class Figure:
    """A figure of a run, by its scenario and facts; None if it was not measured.

    The better of two has the smaller ``loss``.
    """

    title: str
    of: Callable[[Scenario, Facts], float | None]
    loss: Callable[[Scenario, float], float] = itself


def latency(percent: float) -> Callable[[Scenario, Facts], float | None]:
    """A percentile of the latency [us], the median over readers; for 100 the largest."""

    def of(_: Scenario, run: Facts) -> float | None:
        grids = [one["latency_us"] for one in run["readers"] if one["latency_us"]]
        over = max if percent == 100 else median
        return over(percentile(grid, percent) for grid in grids) if grids else None

    return of


def _rate(scenario: Scenario, run: Facts) -> float:
    return min(one["rate_hz"] for one in run["readers"]) / scenario.followed


def _late_joiner(_: Scenario, run: Facts) -> float | None:
    return median(run["joins_ms"]) if run.get("joins_ms") else None


def _missed(scenario: Scenario, rate_hz: float) -> float:
    """What is missing of the commanded rate; a deviation of 0.5 % is as good as none."""
    return max(0.0, 0.995 * scenario.rate_hz - rate_hz)


RATE = Figure("rate at the reader [Hz]", _rate, _missed)
P50, P99 = Figure("latency p50 [us]", latency(50)), Figure("p99 [us]", latency(99))
CPU = Figure("CPU, all processes [% of a core]", lambda _, run: fsum(run["cpu_percent"].values()))
MEMORY = Figure("memory, all processes [MB]", lambda _, run: fsum(run["peak_memory_mb"].values()))
BYTES = Figure("bytes a sample", lambda _, run: run["bytes_per_s"] * run["window_s"] / max(1, run["sent"]))
JOIN = Figure("late joiner [ms]", _late_joiner)
FIGURES = (RATE, P50, P99, CPU, MEMORY, BYTES, JOIN)
"""Those of every table, in its order."""


@dataclass(frozen=True)
class Results:
    """The content of a results folder."""

    folder: Path
    about: Facts
    runs: tuple[Facts, ...]

    @classmethod
    def read(cls, folder: Path) -> Results:
        """Reads both files. Raises OSError, or ValueError if a file is not JSON."""
        about = json.loads((folder / ABOUT).read_text(encoding="utf-8"))
        lines = (folder / RUNS).read_text(encoding="utf-8").splitlines()
        return cls(folder, about, tuple(json.loads(line) for line in lines))

    @cached_property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The scenarios of the run, in order."""
        return tuple(Scenario(**one) for one in self.about["scenarios"])

    @cached_property
    def subjects(self) -> dict[str, Facts]:
        """The installed subjects by name: title, settings, versions, ``floor``."""
        return {name: one for name, one in self.about["subjects"].items() if one["installed"]}

    @cached_property
    def missing(self) -> dict[str, Facts]:
        """The subjects that were not installed: title, ``install``."""
        return {name: one for name, one in self.about["subjects"].items() if not one["installed"]}

    @cached_property
    def failures(self) -> list[Facts]:
        """The failed runs, with reasons."""
        return [run for run in self.runs if "failed" in run]

    def title(self, subject: str) -> str:
        """What tables call a subject."""
        return self.about["subjects"][subject]["title"]

    def scenario(self, robot: str, rate_hz: float) -> Scenario:
        """The scenario with one reader of one robot. Raises LookupError if the run has none."""
        chosen = [one for one in self.scenarios if one.name == f"{robot}-{rate_hz:g}"]
        if not chosen:
            raise LookupError(f"{self.folder} has no {robot} at {rate_hz:g} Hz")
        return chosen[0]

    def of(self, subject: str, scenario: Scenario) -> list[Facts]:
        """The runs of one subject in one scenario that did not fail."""
        at = (subject, scenario.name)
        return [run for run in self.runs if (run["subject"], run["scenario"]) == at and "failed" not in run]

    def measured(self, scenario: Scenario) -> list[str]:
        """The subjects with figures in a scenario, in the order of the tables."""
        return [name for name in self.subjects if self.of(name, scenario)]

    def spread(self, subject: str, scenario: Scenario, figure: Figure) -> Spread | None:
        """A figure of one subject over its rounds; None if it was not measured."""
        values = [
            value for run in self.of(subject, scenario) if (value := figure.of(scenario, run)) is not None
        ]
        return Spread(median(values), min(values), max(values)) if values else None

    def cpu_percent(self, subject: str, scenario: Scenario) -> dict[str, float]:
        """CPU of each role [% of a core], the median over the rounds."""
        runs = [run["cpu_percent"] for run in self.of(subject, scenario)]
        return {role: median(run[role] for run in runs) for role in runs[0]}

    @property
    def others_percent(self) -> float:
        """CPU of the rest of the machine [% of a core] in the worst run."""
        return max((run.get("others_cpu_percent", 0.0) for run in self.runs), default=0.0)


def newest() -> Path:
    """The folder of the last run. Raises FileNotFoundError if there is none."""
    folders = [path.parent for path in FOLDER.glob(f"*/{ABOUT}")]
    if not folders:
        raise FileNotFoundError("there are no results yet; `python -m bench run` makes some")
    return max(folders, key=lambda folder: (folder / ABOUT).stat().st_mtime)


def new_folder(parent: Path = FOLDER) -> Path:
    """Creates the folder of a new run, named by date and commit."""
    name = f"{time.strftime('%Y-%m-%d')}-{commit()}"
    number = sum(1 for _ in parent.glob(f"{name}*"))
    folder = parent / (f"{name}-{number + 1}" if number else name)
    folder.mkdir(parents=True)
    return folder


def write_about(
    folder: Path, command: str, subjects: Iterable[Subject], scenarios: Sequence[Scenario], seed: int
) -> None:
    """Writes ``about.json`` and an empty ``runs.jsonl``."""
    about = {
        "command": command,
        "began": time.strftime("%Y-%m-%d %H:%M:%S %z"),
        "commit": commit(),
        "machine": machine(),
        "python": platform.python_version(),
        "seed": seed,
        "scenarios": [asdict(one) for one in scenarios],
        "robots": {name: _robot(name) for name in MODELS if any(one.robot == name for one in scenarios)},
        "subjects": {one.name: _subject(one) for one in subjects},
    }
    (folder / ABOUT).write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    (folder / RUNS).touch()


def append(folder: Path, facts: Facts, file: str = RUNS) -> None:
    """Appends one run to ``runs.jsonl``, or one row to another file of lines."""
    with (folder / file).open("a", encoding="utf-8") as lines:
        lines.write(json.dumps(facts) + "\n")


def _robot(name: str) -> Facts:
    robot = bench_robot(name)
    return {
        "joints": len(robot.model.joint_names),
        "moving_edges": robot.moving_edges,
        "links": len(robot.model.links),
        "base": robot.model.root,
        "tip": robot.tip,
    }


def _subject(subject: Subject) -> Facts:
    installed = subject.python() is not None
    return {
        "title": subject.title,
        "installed": installed,
        "floor": subject.floor,
        "settings": list(subject.settings),
        "install": list(subject.install),
        "versions": subject.versions() if installed else {},
    }


def commit() -> str:
    """The checked-out commit, with ``-dirty`` if the code of zstate or bench differs from it."""
    try:
        head = git("rev-parse", "--short", "HEAD")
        changed = git("status", "--porcelain", "--untracked-files=no", "--", *CODE)
    except (OSError, subprocess.CalledProcessError):
        return "no-commit"
    return f"{head}-dirty" if changed else head


def git(*arguments: str) -> str:
    """The output of git in the checkout. Raises OSError or CalledProcessError."""
    done = subprocess.run(("git", *arguments), cwd=ROOT, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def machine() -> str:
    """Cores, processor and kernel."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    cpu = next((line.partition(":")[2].strip() for line in lines if "model name" in line), platform.machine())
    return f"{os.cpu_count()} x {cpu}, Linux {platform.release().partition('-')[0]}"
