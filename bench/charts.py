"""The charts of a run: latency, CPU, memory and bytes of every subject in one scenario."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from bench.report import number, origin
from bench.results import BYTES, CPU, MEMORY, P50, P99, Figure, Results, Spread
from bench.scenario import PAGE, Scenario

INK, FAINT = "#222222", "#767676"
# Okabe and Ito's colours, which are distinguishable with colour blindness: zstate, other systems, floors.
OURS, THEIRS, FLOOR = "#0072B2", "#D55E00", "#888888"
ROLES = (1.0, 0.62, 0.34)
"""Opacity of the CPU of writer, reader and other processes."""
STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["Inter", "Helvetica Neue", "Arial", "Liberation Sans", "DejaVu Sans"],
    "font.size": 10.5,
    "axes.titlesize": 12,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": "#BBBBBB",
    "axes.labelcolor": INK,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": INK,
    "grid.color": "#E4E4E4",
    "svg.fonttype": "none",
    "svg.hashsalt": "zstate",  # the same figures give the same file
}
"""Fonts and lines, independent of the user's matplotlib style; text stays text in SVG."""


def write_charts(results: Results) -> list[Path]:
    """Writes a chart of each scenario of the page into the results folder."""
    names = {one.name for one in PAGE}
    chosen = [one for one in results.scenarios if one.name in names and results.measured(one)]
    return [write_chart(results, scenario) for scenario in chosen]


def write_chart(results: Results, scenario: Scenario) -> Path:
    """Writes the chart of one scenario; returns its path."""
    path = results.folder / f"{scenario.name}.svg"
    with mpl.rc_context(STYLE):
        draw(results, scenario).savefig(path, bbox_inches="tight", metadata={"Date": None})
    return path


def draw(results: Results, scenario: Scenario) -> Drawing:
    """One row per subject, one panel per figure; a line is the range over the rounds."""
    names = results.measured(scenario)
    drawing = Drawing(figsize=(14.0, 1.6 + 0.42 * len(names)))
    latency, cpu, memory, size = drawing.subplots(1, 4, sharey=True, width_ratios=(1.3, 1.2, 1.0, 1.0))
    latency.set_yticks(range(len(names)), [results.title(name) for name in names])
    latency.set_ylim(len(names) - 0.4, -0.6)
    for row, name in enumerate(names):
        shade = color(results, name)
        for figure, marker in ((P50, "o"), (P99, "|")):
            draw_range(latency, row, results.spread(name, scenario, figure), shade, marker)
        draw_roles(cpu, row, results.cpu_percent(name, scenario), shade)
        for axes, figure in ((memory, MEMORY), (size, BYTES)):
            draw_bar(axes, row, results.spread(name, scenario, figure), shade)
        label(cpu, row, results.spread(name, scenario, CPU))
    title_panels((latency, cpu, memory, size), (P50, CPU, MEMORY, BYTES))
    joints = results.about["robots"][scenario.robot]["joints"]
    head = f"{scenario.title}, {joints} joints"
    drawing.suptitle(head, x=0.0, ha="left", fontsize=15, fontweight="bold")
    drawing.tight_layout(rect=(0, 0, 1, 0.99), w_pad=2.0)
    note = "Latency from stamp to answer: dot p50, tick p99. CPU from dark to light: writer, reader, others."
    lines = f"Lines: the range over {scenario.rounds} rounds of {scenario.seconds:g} s."
    text = f"{note} {lines}\n{origin(results)}."
    drawing.text(0.0, -0.02, text, fontsize=8.5, color=FAINT, va="top", ha="left")
    return drawing


def title_panels(panels: Sequence[Axes], figures: Sequence[Figure]) -> None:
    """Titles and grids of the panels; latencies are on a logarithmic axis."""
    panels[0].set_xscale("log")
    for axes, figure in zip(panels, figures, strict=True):
        axes.set_title(figure.title.replace(" p50", "").replace(", all processes", ""))
        axes.grid(axis="x")
        axes.tick_params(axis="y", length=0)
        axes.margins(x=0.2)


def color(results: Results, name: str) -> str:
    """The colour of zstate, of another system, or of a floor."""
    if results.subjects[name]["floor"]:
        return FLOOR
    return OURS if name.startswith("zstate") else THEIRS


def draw_range(axes: Axes, row: int, spread: Spread | None, shade: str, marker: str) -> None:
    """A figure's median with its range."""
    if spread is not None:
        axes.plot(spread[1:], [row, row], color=shade, lw=3, alpha=0.4, solid_capstyle="butt")
        axes.plot([spread.median], [row], color=shade, marker=marker, ms=7, mew=1.6)


def draw_bar(axes: Axes, row: int, spread: Spread | None, shade: str) -> None:
    """A figure's median as a bar, with its range and value."""
    if spread is not None:
        axes.barh(row, spread.median, height=0.56, color=shade, lw=0)
        label(axes, row, spread)


def draw_roles(axes: Axes, row: int, cpu: dict[str, float], shade: str) -> None:
    """Stacked CPU of writer, reader and other processes."""
    others = sum(used for role, used in cpu.items() if role not in ("writer", "reader"))
    left = 0.0
    for part, opacity in zip((cpu["writer"], cpu["reader"], others), ROLES, strict=True):
        axes.barh(row, part, left=left, height=0.56, color=shade, alpha=opacity, lw=0)
        left += part


def label(axes: Axes, row: int, spread: Spread | None) -> None:
    """The range and the value at the end of a bar."""
    if spread is not None:
        axes.plot(spread[1:], [row, row], color=INK, lw=1)
        offset = {"xytext": (5, 0), "textcoords": "offset points", "va": "center", "fontsize": 9.5}
        axes.annotate(number(spread.median), (spread.most, row), **offset)
