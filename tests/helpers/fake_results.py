"""Synthetic results: two rounds of every scenario, with predictable figures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.recording import GRID
from bench.results import ABOUT, RUNS, Results
from bench.scenario import Scenario

TITLES = {"zstate_peer": "zstate", "ros1": "ROS 1", "raw_zenoh": "raw Zenoh (floor)"}
SCENARIOS = (
    Scenario("panda", 100.0, rounds=2),
    Scenario("talos", 1000.0, rounds=2, joins=3),
    Scenario("talos", 100.0, readers=5),
    Scenario("panda", 50.0, fleet=100, writers=4),
)
JOINTS = {"panda": 8, "talos": 32}


def about(subjects: dict[str, str], scenarios: Sequence[Scenario]) -> dict[str, Any]:
    installed = {
        name: {
            "title": title,
            "installed": True,
            "floor": name.startswith("raw"),
            "settings": [f"how {name} is set"],
            "install": [],
            "versions": {name: "1.0"},
        }
        for name, title in subjects.items()
    }
    absent = {"title": "Absent DDS", "installed": False, "install": ["pip install absent-dds"]}
    edges = {"base": "base", "tip": "tip"}
    return {
        "command": "python -m bench run",
        "began": "2026-01-02 03:04:05 +0000",
        "commit": "abc1234",
        "machine": "2 x a processor, Linux 6",
        "python": "3.11.2",
        "seed": 7,
        "scenarios": [asdict(one) for one in scenarios],
        "robots": {
            name: {"joints": joints, "moving_edges": joints, "links": joints + 1, **edges}
            for name, joints in JOINTS.items()
        },
        "subjects": {**installed, "absent": {**absent, "floor": False, "settings": [], "versions": {}}},
    }


def a_run(subject: str, scenario: Scenario, number: int, factor: float) -> dict[str, Any]:
    """A run at ``factor`` times the cost of zstate, 10 % more in round 1; 3 halve the rate at 1 kHz."""
    factor *= 1.0 + 0.1 * number
    rate = scenario.rate_hz
    slow = 0.5 if factor >= 3 and rate >= 1000 else 1.0
    sent = round(rate * scenario.fleet * 4)
    reader = {
        "rate_hz": rate * scenario.fleet * slow,
        "answered": round(sent * slow),
        "lost": round(sent * (1 - slow)),
        "late": 1,
        "latency_us": [factor * 100.0 * (1.0 + 0.01 * percent) for percent in GRID],
    }
    others = {"state publisher": 3.0 * factor} if subject == "ros1" else {}
    cpu = {"writer": 0.01 * factor * rate, "reader": 0.02 * factor * rate * scenario.readers, **others}
    return {
        "subject": subject,
        "scenario": scenario.name,
        "round": number,
        "window_s": 4.0,
        "sent": sent,
        "sent_hz": rate * scenario.fleet,
        "readers": [reader] * scenario.readers,
        "cpu_percent": cpu,
        "others_cpu_percent": 2.0,
        "bytes_per_s": rate * factor * 9.0 * JOINTS[scenario.robot],
        "peak_memory_mb": dict.fromkeys(cpu, 50.0 / factor),
        "joins_ms": [20.0 * factor, 30.0 * factor, 40.0 * factor][: scenario.joins],
        "poses": {"compared": 20, "most_m": 1e-15, "most_rad": 1e-15, "errors": 0, "first_error": None},
    }


def write_results(folder: Path, factors: dict[str, float], titles: dict[str, str] = TITLES) -> Results:
    """Writes a folder with the cost ``factors`` of the subjects; ROS 1 has failed with five readers."""
    folder.mkdir(parents=True, exist_ok=True)
    runs = [
        a_run(name, one, number, factor)
        for one in SCENARIOS
        for name, factor in factors.items()
        for number in range(one.rounds)
        if one.fleet == 1 or name != "ros1"
    ]
    failed = {"subject": "ros1", "scenario": "talos-100-readers5"}
    runs = [run for run in runs if not failed.items() <= run.items()]
    runs.append({**failed, "round": 0, "failed": "roscore was not ready"})
    (folder / ABOUT).write_text(json.dumps(about(titles, SCENARIOS)), encoding="utf-8")
    (folder / RUNS).write_text("".join(json.dumps(run) + "\n" for run in runs), encoding="utf-8")
    return Results.read(folder)
