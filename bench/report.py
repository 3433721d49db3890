"""The Markdown report of a run: all tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from bench.aggregate import Aggregate, aggregate, aggregates, find_scenarios
from bench.markdown import dash, number, table
from bench.results import Results
from bench.scenario import Scenario

REFERENCE = "zstate_peer"
REPORT = "report.md"
RATIO_RATES = (100.0, 1000.0)


def write_report(results: Results, plots: Sequence[Path]) -> Path:
    """Writes the report with all tables and the SVG plots into the results folder; returns its path."""
    path = results.folder / REPORT
    shown = [plot.name for plot in plots if plot.suffix == ".svg"]
    path.write_text("\n".join(report_lines(results, shown)) + "\n", encoding="utf-8")
    return path


def report_lines(results: Results, plots: Sequence[str]) -> Iterator[str]:
    """The lines of the report."""
    yield from _head(results)
    for plot in plots:
        yield from (f"![{plot.removesuffix('.svg')}]({plot})", "")
    yield from _ratios(results)
    yield from _rates(results)
    for title, group in (("Latency", "rate"), ("Other robots", "robot")):
        yield from _costs(results, title, group)
    yield from _readers(results)
    yield from _late(results)
    yield from _correctness(results)
    yield from _appendix(results)


def _head(results: Results) -> Iterator[str]:
    about = results.about
    yield f"# `{about['command']}`"
    yield ""
    yield f"{about['began']}, commit {about['commit']}, seed {about['seed']}, Python {about['python']}."
    yield f"{about['machine']}."
    yield ""
    robots = (
        f"{name} ({one['joints']} joints, {one['moving_edges']} moving edges, {one['links']} links; "
        f"{one['base']} to {one['tip']})"
        for name, one in about["robots"].items()
    )
    yield f"Robots: {'; '.join(robots)}."
    yield ""


def _ratios(results: Results) -> Iterator[str]:
    for scenario in results.scenarios:
        if scenario.group != "rate" or scenario.rate_hz not in RATIO_RATES:
            continue
        ours = aggregate(results, REFERENCE, scenario)
        if ours is None:
            continue
        yield f"## Times zstate's figure: {scenario.robot} at {scenario.rate}"
        yield ""
        yield "Above 1 the other system has more: a higher rate, more latency, more CPU, more bytes."
        yield ""
        rows = [
            [_title(results, name), *_ratio_cells(one, ours)]
            for name, one in aggregates(results, scenario).items()
            if name != REFERENCE
        ]
        yield from table(["", "rate", "p50", "p99", "CPU, all processes", "bytes"], rows)


def _ratio_cells(one: Aggregate, ours: Aggregate) -> list[str]:
    figures: list[Callable[[Aggregate], float | None]] = [
        lambda at: at.rate_hz,
        lambda at: at.latency_us(50),
        lambda at: at.latency_us(99),
        lambda at: at.cpu_total,
        lambda at: at.bytes_per_s,
    ]
    return [_quotient(figure(one), figure(ours)) for figure in figures]


def _quotient(value: float | None, by: float | None) -> str:
    return dash(None if value is None or not by else value / by, lambda ratio: f"{ratio:.3g}")


def _rates(results: Results) -> Iterator[str]:
    for robot in dict.fromkeys(one.robot for one in find_scenarios(results, group="rate")):
        scenarios = find_scenarios(results, group="rate", robot=robot)
        yield f"## Rate at the reader: {robot}"
        yield ""
        yield "Samples per second answered by the reader's own buffer; in brackets, samples never answered."
        yield ""
        rows = [
            [_title(results, name), *(_rate(aggregate(results, name, one)) for one in scenarios)]
            for name in results.subjects
        ]
        yield from table(["commanded", *(one.rate for one in scenarios)], rows)


def _rate(one: Aggregate | None) -> str:
    if one is None:
        return "-"
    return number(one.rate_hz) + (f" ({one.lost} of {one.sent})" if one.lost else "")


def _costs(results: Results, title: str, group: str) -> Iterator[str]:
    for scenario in find_scenarios(results, group=group):
        if group == "rate" and not scenario.rate_hz:
            continue  # flat out, latency is the length of a queue
        yield f"## {title}: {scenario.robot} at {scenario.rate}"
        yield ""
        yield from table(*_cost_table(results, scenario))


def _cost_table(results: Results, scenario: Scenario) -> tuple[list[str], list[list[str]]]:
    head = ["", "Hz", "p50 us", "p99", "p99.9", "max", "late", "lost"]
    head += ["CPU %: writer", "reader", "others", "B/sample", "kB/s", "peak MB: writer", "reader"]
    return head, [
        [
            _title(results, name),
            number(one.rate_hz),
            *_latency_cells(one),
            *_count_cells(one),
            *_cost_cells(one),
        ]
        for name, one in aggregates(results, scenario).items()
    ]


def _latency_cells(one: Aggregate) -> list[str]:
    return [dash(one.latency_us(percent), number) for percent in (50, 99, 99.9, 100)]


def _count_cells(one: Aggregate) -> list[str]:
    return [dash(one.late, str), str(one.lost)]


def _cost_cells(one: Aggregate) -> list[str]:
    cpu, memory = one.cpu_percent(), one.memory_mb()
    others = [f"{role} {percent:.1f}" for role, percent in cpu.items() if role not in ("reader", "writer")]
    return [
        f"{cpu['writer']:.1f}",
        f"{cpu['reader']:.1f}",
        ", ".join(others),
        number(one.bytes_per_sample),
        number(one.bytes_per_s / 1000),
        f"{memory['writer']:.0f}",
        f"{memory['reader']:.0f}",
    ]


def _readers(results: Results) -> Iterator[str]:
    titles = {
        "readers": "{0.readers} readers of {0.robot} at {0.rate}; their CPU is the sum",
        "busy": "A thread holds the reader's GIL: {0.robot} at {0.rate}",
        "slow": "The reader sleeps 10 ms after each answer: {0.robot} at {0.rate}; lost: samples passed over",
        "fleet": "{0.fleet} x {0.robot} at {0.rate} each; one reader of {0.followed}; routers: {0.routers}",
    }
    for scenario in results.scenarios:
        title = titles.get(scenario.load if scenario.group == "load" else scenario.group)
        if title is not None:
            yield f"## {title.format(scenario)}"
            yield ""
            yield from table(*_cost_table(results, scenario))


def _late(results: Results) -> Iterator[str]:
    for scenario in find_scenarios(results, group="late"):
        yield f"## Late joiners: {scenario.robot} at {scenario.rate}"
        yield ""
        yield (
            "From opening the session until every link could be placed [ms], all modules imported "
            "before; and the part of it until the reader was created."
        )
        yield ""
        rows = [
            [
                _title(results, name),
                *_spread(one.joins_ms),
                *_spread(one.connections_ms),
                str(len(one.joins_ms)),
            ]
            for name, one in aggregates(results, scenario).items()
        ]
        yield from table(["", "whole tree: median", "max", "made: median", "max", "joins"], rows)


def _spread(values: Sequence[float]) -> list[str]:
    return [f"{values[len(values) // 2]:.0f}", f"{values[-1]:.0f}"]


def _correctness(results: Results) -> Iterator[str]:
    yield "## Are the answers right?"
    yield ""
    yield "Some answers of each run compared with zstate's forward kinematics of the sent positions."
    yield ""
    rows: list[list[str]] = []
    for name in results.subjects:
        poses = [one for scenario in results.scenarios for one in _poses(aggregate(results, name, scenario))]
        compared = sum(one["compared"] for one in poses)
        if not compared and not any(one["errors"] for one in poses):
            continue
        most = [f"{max(one[what] for one in poses):.1e}" for what in ("most_m", "most_rad")]
        first = next((one["first_error"] for one in poses if one["first_error"]), "")
        rows.append(
            [_title(results, name), str(compared), *most, str(sum(o["errors"] for o in poses)), first]
        )
    yield from table(["", "answers", "most m", "most rad", "errors", "first error"], rows)


def _poses(one: Aggregate | None) -> list[dict[str, Any]]:
    return [] if one is None else one.poses()


def _appendix(results: Results) -> Iterator[str]:
    if results.missing:
        yield "## Not installed"
        yield ""
        yield from table(
            ["", "to install it"],
            [
                [one["title"], "; ".join(f"`{line}`" for line in one["install"])]
                for one in results.missing.values()
            ],
        )
    failures = results.failures()
    if failures:
        yield "## Failed"
        yield ""
        rows = [[_title(results, one["subject"]), one["scenario"], one["failed"]] for one in failures]
        yield from table(["", "scenario", "why"], rows)
    yield "## What each was set to"
    yield ""
    for one in results.subjects.values():
        versions = ", ".join(f"{name} {version}" for name, version in one["versions"].items())
        yield f"- **{one['title']}** ({versions}): {'; '.join(one['settings'])}."
    yield ""
    noise = max((run.get("others_cpu_percent", 0.0) for run in results.runs), default=0.0)
    yield f"The rest of the machine used at most {noise:.0f} % of a core during any run."


def _title(results: Results, name: str) -> str:
    return str(results.subjects[name]["title"])
