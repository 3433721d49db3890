"""Results: a folder of raw figures, and where they come from.

``about.json`` says what was measured, on what and how; ``runs.jsonl`` has one line for each run, written as
soon as it is done. Tables and plots are made of these two, and can be made again.
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
    """What a folder holds."""

    folder: Path
    about: Facts
    runs: tuple[Facts, ...]

    @classmethod
    def read(cls, folder: Path) -> Results:
        """The folder's two files. Raises OSError, and ValueError for what is not JSON."""
        about = json.loads((folder / ABOUT).read_text(encoding="utf-8"))
        lines = (folder / RUNS).read_text(encoding="utf-8").splitlines()
        return cls(folder, about, tuple(json.loads(line) for line in lines))

    @cached_property
    def scenarios(self) -> tuple[Scenario, ...]:
        """Those that were run, in their order."""
        return tuple(Scenario(**one) for one in self.about["scenarios"])

    @cached_property
    def subjects(self) -> dict[str, Facts]:
        """Those that were run, by name: title, settings, versions, ``floor``."""
        return {name: one for name, one in self.about["subjects"].items() if one["installed"]}

    @cached_property
    def missing(self) -> dict[str, Facts]:
        """Those that were not installed: title, ``install``."""
        return {name: one for name, one in self.about["subjects"].items() if not one["installed"]}

    def of(self, subject: str, scenario: Scenario) -> list[Facts]:
        """The runs of one subject in one scenario that did not fail."""
        name = scenario.name
        return [
            run
            for run in self.runs
            if run["subject"] == subject and run["scenario"] == name and "failed" not in run
        ]

    def failures(self) -> list[Facts]:
        """The runs that failed, with their reason."""
        return [run for run in self.runs if "failed" in run]


def newest() -> Path:
    """The folder of the last run. Raises FileNotFoundError when there was none."""
    folders = sorted(path.parent for path in FOLDER.glob(f"*/{ABOUT}"))
    if not folders:
        raise FileNotFoundError("there are no results yet; `python -m bench run` makes some")
    return max(folders, key=lambda folder: (folder / ABOUT).stat().st_mtime)


def new_folder() -> Path:
    """One for a run that begins now: its date and the commit."""
    folder = FOLDER / f"{time.strftime('%Y-%m-%d')}-{commit()}"
    number = 1
    while folder.exists():
        number += 1
        folder = folder.with_name(f"{time.strftime('%Y-%m-%d')}-{commit()}-{number}")
    folder.mkdir(parents=True)
    return folder


def begin(
    folder: Path, command: str, subjects: Sequence[Subject], scenarios: Iterable[Scenario], seed: int
) -> None:
    """Write down what is going to be measured."""
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


def add(folder: Path, run: Facts) -> None:
    """Write down one run."""
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
    """The commit that is checked out, with ``-dirty`` when the code of zstate or of bench differs from it."""
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
