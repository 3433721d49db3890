"""The table of docs/benchmarks.md, generated from the results folder that the line before it names."""

from __future__ import annotations

import re
from pathlib import Path

from bench.aggregate import Aggregate, aggregate, find_scenarios
from bench.markdown import dash, number, table
from bench.report import REFERENCE
from bench.results import Results

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
END = "<!-- end of bench -->"
# The most informative robot and rate: Python readers of ROS do not keep up with it.
ROBOT, RATE_HZ = "talos", 1000.0

_BLOCK = re.compile(r"(<!-- bench: (?P<folder>\S+) -->\n)(?P<table>.*?)(?=" + re.escape(END) + ")", re.DOTALL)


def short_table(results: Results) -> str:
    """One robot at one rate, one row per subject; no row is left out."""
    scenario = find_scenarios(results, group="rate", robot=ROBOT, rate_hz=RATE_HZ)[0]
    late = next(iter(find_scenarios(results, group="late", robot=ROBOT)), None)
    head = [f"{ROBOT} at {scenario.rate}", "rate at the reader", "latency p50 / p99", "CPU writer + reader"]
    head += ["+ others", "bytes a sample", "late joiner"]
    rows: list[list[str]] = []
    for name, facts in results.subjects.items():
        one = aggregate(results, name, scenario)
        join = None if late is None else aggregate(results, name, late)
        if one is not None:
            title = f"**{facts['title']}**" if name == REFERENCE else facts["title"]
            rows.append(
                [title, *_cells(one), dash(join, lambda joined: f"{_middle(joined.joins_ms):.0f} ms")]
            )
    return "\n".join(table(head, rows))


def _cells(one: Aggregate) -> list[str]:
    cpu = one.cpu_percent()
    p50, p99 = (dash(one.latency_us(percent), number) for percent in (50, 99))
    return [
        f"{one.rate_hz:.1f} Hz",
        f"{p50} / {p99} us",
        f"{cpu['writer']:.1f} + {cpu['reader']:.1f} %",
        f"{one.cpu_between:.1f} %" if one.cpu_between > 0.05 else "",
        number(one.bytes_per_sample),
    ]


def _middle(values: list[float]) -> float:
    return values[len(values) // 2]


def with_current_tables(text: str, root: Path = ROOT) -> str:
    """``text`` with every table regenerated from the folder that the line before it names."""

    def renew(block: re.Match[str]) -> str:
        return f"{block[1]}\n{short_table(Results.read(root / block['folder']))}\n"

    return _BLOCK.sub(renew, text)
