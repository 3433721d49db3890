"""A results folder: raw figures and their origin.

``about.json`` describes the machine, subjects and scenarios; ``runs.jsonl`` has one line per run, appended as
soon as the run is done. Tables and plots are generated from these two files only.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

from bench.robot import MODELS, bench_robot
from bench.scenario import Scenario
from bench.subjects.subject import Subject

Facts: TypeAlias = "dict[str, Any]"

FOLDER = Path(__file__).parent / "results"
ABOUT, RUNS = "about.json", "runs.jsonl"


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

    def completed_runs(self, subject: str, scenario: Scenario) -> list[Facts]:
        """The runs of one subject in one scenario that did not fail."""
        name = scenario.name
        return [
            run
            for run in self.runs
            if run["subject"] == subject and run["scenario"] == name and "failed" not in run
        ]

    def failures(self) -> list[Facts]:
        """The failed runs, with reasons."""
        return [run for run in self.runs if "failed" in run]


def newest() -> Path:
    """The folder of the last run. Raises FileNotFoundError if there is none."""
    folders = sorted(path.parent for path in FOLDER.glob(f"*/{ABOUT}"))
    if not folders:
        raise FileNotFoundError("there are no results yet; `python -m bench run` makes some")
    return max(folders, key=lambda folder: (folder / ABOUT).stat().st_mtime)


def new_folder() -> Path:
    """Creates the folder of a new run, named by date and commit."""
    folder = FOLDER / f"{time.strftime('%Y-%m-%d')}-{commit()}"
    number = 1
    while folder.exists():
        number += 1
        folder = folder.with_name(f"{time.strftime('%Y-%m-%d')}-{commit()}-{number}")
    folder.mkdir(parents=True)
    return folder


def write_about(
    folder: Path, command: str, subjects: Sequence[Subject], scenarios: Iterable[Scenario], seed: int
) -> None:
    """Writes ``about.json`` and an empty ``runs.jsonl``."""
    chosen = tuple(scenarios)
    about = {
        "command": command,
        "began": time.strftime("%Y-%m-%d %H:%M:%S %z"),
        "commit": commit(),
        "machine": machine(),
        "python": platform.python_version(),
        "seed": seed,
        "scenarios": [asdict(one) for one in chosen],
        "robots": {name: _robot(name) for name in MODELS if any(one.robot == name for one in chosen)},
        "subjects": {one.name: _subject(one) for one in subjects},
    }
    (folder / ABOUT).write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    (folder / RUNS).touch()


def append_run(folder: Path, run: Facts) -> None:
    """Appends one run to ``runs.jsonl``."""
    with (folder / RUNS).open("a", encoding="utf-8") as file:
        file.write(json.dumps(run) + "\n")


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
        head = _git("rev-parse", "--short", "HEAD")
        changed = _git(
            "status", "--porcelain", "--untracked-files=no", "--", "zstate", "bench/*.py", "setup.py"
        )
    except (OSError, subprocess.CalledProcessError):
        return "no-commit"
    return f"{head}-dirty" if changed else head


def _git(*arguments: str) -> str:
    command = ("git", *arguments)
    root = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def machine() -> str:
    """Cores, processor and kernel."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    cpu = next((line.partition(":")[2].strip() for line in lines if "model name" in line), platform.machine())
    return f"{os.cpu_count()} x {cpu}, Linux {platform.release().partition('-')[0]}"
