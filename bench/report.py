"""The Markdown report of a run: all tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.results import FIGURES, Facts, Figure, Results, Spread, latency
from bench.scenario import Scenario

REPORT = "report.md"
MORE = (Figure("p99.9 [us]", latency(99.9)), Figure("largest [us]", latency(100)))


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """The lines of a Markdown table and an empty line; the first column is text, the others are numbers."""
    for cells in (head, ["---", *["--:"] * (len(head) - 1)], *rows):
        yield f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"
    yield ""


def number(value: float) -> str:
    """Three or four significant digits, more only before the point: 0.513, 12.3, 123.4, 12,345."""
    if round(abs(value)) >= 1000:
        return f"{value:,.0f}"
    if abs(value) >= 100:
        return f"{value:.1f}".removesuffix(".0")
    return f"{value:.3g}"


def cell(spread: Spread | None) -> str:
    """The median, with the least and the most of the rounds; a dash if there are none, never an estimate."""
    if spread is None:
        return "-"
    least, most = number(spread.least), number(spread.most)
    return number(spread.median) if least == most else f"{number(spread.median)} [{least} to {most}]"


def figure_table(results: Results, scenario: Scenario, figures: Sequence[Figure] = FIGURES) -> Iterator[str]:
    """One scenario: one row for each subject that was measured."""
    rows = [
        [results.title(name), *(cell(results.spread(name, scenario, one)) for one in figures)]
        for name in results.measured(scenario)
    ]
    yield from table([scenario.title, *(one.title for one in figures)], rows)


def origin(results: Results) -> str:
    """Where the figures are from, in one sentence."""
    about = results.about
    return f"{about['machine']}, Python {about['python']}; commit {about['commit']}, {about['began'][:10]}"


def write_report(results: Results) -> Path:
    """Writes the report with all tables and the charts into the results folder; returns its path."""
    path = results.folder / REPORT
    path.write_text("\n".join(report_lines(results)) + "\n", encoding="utf-8")
    return path


def report_lines(results: Results) -> Iterator[str]:
    """The lines of the report."""
    yield from (
        f"# `{results.about['command']}`",
        "",
        f"{origin(results)}; seed {results.about['seed']}.",
        "",
    )
    facts = "{0} ({joints} joints, {moving_edges} moving edges, {links} links; {base} to {tip})"
    robots = (facts.format(name, **one) for name, one in results.about["robots"].items())
    yield from (f"Robots: {'; '.join(robots)}.", "")
    for chart in sorted(results.folder.glob("*.svg")):
        yield from (f"![{chart.stem}]({chart.name})", "")
    for scenario in results.scenarios:
        if scenario.soaks:
            yield from _soak(results, scenario)
        elif results.measured(scenario):
            yield from (f"## {scenario.title}", "")
            yield from figure_table(results, scenario, (*FIGURES, *MORE))
            yield from _roles(results, scenario)
    yield from _correctness(results)
    yield from _appendix(results)


def _roles(results: Results, scenario: Scenario) -> Iterator[str]:
    """Samples that are late or lost, and the CPU and memory of each role."""
    rows: list[list[str]] = []
    for name in results.measured(scenario):
        runs = results.of(name, scenario)
        late, lost = (
            str(sum(one[what] for run in runs for one in run["readers"])) for what in ("late", "lost")
        )
        memory = _by_role(runs[-1]["peak_memory_mb"])
        rows.append([results.title(name), late, lost, _by_role(results.cpu_percent(name, scenario)), memory])
    yield from table(["", "late", "lost", "CPU of each role [% of a core]", "peak memory [MB]"], rows)


def _by_role(figures: Mapping[str, float]) -> str:
    return ", ".join(f"{role} {value:.1f}" for role, value in figures.items())


def _soak(results: Results, scenario: Scenario) -> Iterator[str]:
    for name in results.measured(scenario):
        for run in results.of(name, scenario):
            yield from (f"## {results.title(name)}: {scenario.title}", "")
            yield from soak_lines(run["soak"])


def soak_lines(soak: Facts) -> Iterator[str]:
    """The table of a soak: growth from the first fifth of the time to the end, and what was lost."""
    rows = [
        [
            process,
            number(one["cpu_percent"]),
            "{} to {}".format(*one["memory_mb"]),
            "{} ± {}".format(*one["slope_kb_per_minute"]),
            *("{} to {}".format(*one[what]) for what in ("threads", "descriptors")),
        ]
        for process, one in soak["processes"].items()
    ]
    yield from table(["", "CPU [%]", "memory [MB]", "kB a minute", "threads", "descriptors"], rows)
    ages = ", ".join(map(str, soak["age_ms_p50_p99_max"]))
    latched = f"latched values {soak['latched']}, lost {soak['latched_lost']}"
    yield f"- sent {soak['sent']}, received {soak['count']}"
    yield f"- {latched}, the latest {soak['latched_within_s']:.2f} s after its half minute began"
    yield f"- age at the answer, p50, p99, largest: {ages} ms; older than a second: {soak['older_than_1_s']}"
    joins = soak["joins_ms"]
    yield from (f"- late joiners: {len(joins)}, whole after {max(joins, default=0.0):.0f} ms at most", "")


def _correctness(results: Results) -> Iterator[str]:
    yield from ("## Are the answers right?", "")
    yield from (
        "Some answers of each run compared with zstate's forward kinematics of the sent positions.",
        "",
    )
    rows: list[list[str]] = []
    for name in results.subjects:
        poses: list[dict[str, Any]] = [
            run["poses"] for run in results.runs if run["subject"] == name and "poses" in run
        ]
        compared, errors = (sum(one[what] for one in poses) for what in ("compared", "errors"))
        if compared or errors:
            most = [f"{max(one[what] for one in poses):.1e}" for what in ("most_m", "most_rad")]
            first = next((one["first_error"] for one in poses if one["first_error"]), "")
            rows.append([results.title(name), str(compared), *most, str(errors), first])
    yield from table(["", "answers", "most m", "most rad", "errors", "first error"], rows)


def _appendix(results: Results) -> Iterator[str]:
    if results.missing:
        yield from ("## Not installed", "")
        rows = [
            [one["title"], "; ".join(f"`{line}`" for line in one["install"])]
            for one in results.missing.values()
        ]
        yield from table(["", "to install it"], rows)
    if results.failures:
        yield from ("## Failed", "")
        rows = [[results.title(one["subject"]), one["scenario"], one["failed"]] for one in results.failures]
        yield from table(["", "scenario", "why"], rows)
    yield from ("## What each was set to", "")
    for one in results.subjects.values():
        versions = ", ".join(f"{name} {version}" for name, version in one["versions"].items())
        yield f"- **{one['title']}** ({versions}): {'; '.join(one['settings'])}."
    yield from (
        "",
        f"The rest of the machine used at most {results.others_percent:.0f} % of a core in any run.",
    )
