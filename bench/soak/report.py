"""The result of a soak test: JSON with every sample, and a Markdown table."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from bench.soak.roles import Report
from bench.soak.task import Task
from bench.soak.usage import COLUMNS, growth


def build_result(
    task: Task,
    seconds: float,
    ended: Mapping[str, Report],
    samples: Mapping[str, Sequence[Sequence[float]]],
    joins: Sequence[Report],
) -> Report:
    """All measured figures."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpu = next((line.partition(":")[2].strip() for line in lines if "model name" in line), "")
    sent = sum(report.get("sent", 0) for report in ended.values())
    kernel = platform.release().partition("-")[0]
    return {
        "command": " ".join(["python -m bench.soak", *task.options]),
        "machine": f"{os.cpu_count()} x {cpu or platform.machine()}, Linux {kernel}",
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("zstate", "eclipse-zenoh")},
        },
        "seconds": round(seconds, 1),
        "warm_up_s": task.warm_up_s,
        "load_1_5_15": os.getloadavg(),
        "robots": task.robots,
        "sent": sent,
        "arrived_percent": round(100.0 * ended["reader"]["received"] / sent, 4),
        "processes": {
            role: {**report, **growth(samples[role], task.warm_up_s)} for role, report in ended.items()
        },
        "fresh_readers": joins,
        "sample_columns": COLUMNS,
        "samples": samples,
    }


def write(result: Report, path: Path) -> None:
    """Writes ``path`` as .json and .md, and prints the table."""
    path.parent.mkdir(exist_ok=True)
    table = "\n".join([*_head(result), *map(_row, result["processes"].items()), "", *_findings(result), ""])
    path.with_suffix(".json").write_text(json.dumps(result) + "\n", encoding="utf-8")
    path.with_suffix(".md").write_text(table, encoding="utf-8")
    print(table)


def _head(result: Report) -> list[str]:
    versions = ", ".join(f"{name} {number}" for name, number in result["versions"].items())
    return [
        f"# `{result['command']}`",
        "",
        f"{result['machine']}; {versions}; {result['seconds']} s, load {result['load_1_5_15'][1]:.2f}.",
        f"Memory, threads and file descriptors are given after {result['warm_up_s']:g} s and at the end;",
        "growth is the slope of a line through means of half minutes, with its standard error.",
        "",
        "| process | CPU % | memory MB | growth kB/min | threads | fds | Hz |",
        "|---|---|---|---|---|---|---|",
    ]


def _row(named: tuple[str, Report]) -> str:
    role, one = named
    spans = ["{} -> {}".format(*one[f"{what}_first_last"]) for what in ("rss_mb", "threads", "fds")]
    slope = f"{one['rss_slope_kb_per_minute']:.1f} ± {one['rss_slope_error']:.1f}"
    hz = f"{one['achieved_hz']:.3f}" if "achieved_hz" in one else ""
    return f"| {' | '.join(map(str, [role, one['cpu_percent'], spans[0], slope, *spans[1:], hz]))} |"


def _findings(result: Report) -> Iterator[str]:
    reader, joins = result["processes"]["reader"], result["fresh_readers"]
    received = f"- sent {result['sent']}, received {reader['received']} ({result['arrived_percent']} %)"
    if "looks" in reader:
        losses = ", ".join(f"{what} {reader[what]}" for what in ("missed", "dropped", "late", "refused"))
        yield f"{received}; {losses}"
        yield (
            f"- age of the newest sample in {reader['looks']} checks, median, p99, largest: "
            f"{reader['age_ms_p50_p99_max']} ms; older than a second: {reader['stale_looks']}"
        )
        yield (
            f"- latched values: {reader['latched_rounds']} rounds of {result['robots']} robots, lost "
            f"{reader['latched_lost']}; all received after "
            f"{reader['latched_within_s_median_max']} s (median, max)"
        )
    else:
        yield received
    if joins:
        yield (
            f"- fresh readers: {sum(one['complete'] for one in joins)} of {len(joins)} had everything, after "
            f"{max(one['seconds'] for one in joins)} s at most"
        )
