"""Chart elements for charts with one row per subject."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.axes import Axes

from bench.aggregate import Aggregate
from bench.drawing import INK, ROLE_SHADES, line_style
from bench.results import Results

REFERENCE = "zstate_peer"


def name_rows(axes: Axes, results: Results, names: Mapping[str, object]) -> None:
    """Labels one row per subject, the first on top."""
    axes.set_yticks(range(len(names)), [results.subjects[name]["title"] for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    for label, name in zip(axes.get_yticklabels(), names, strict=True):
        label.set(color=line_style(REFERENCE).color if name.startswith("zstate") else INK, fontsize=11)
        label.set_fontweight("bold" if name == REFERENCE else "normal")


def rate_bar(axes: Axes, row: int, name: str, one: Aggregate) -> None:
    """A bar of the rate, labelled with its value."""
    axes.barh(row, one.rate_hz, height=0.56, color=line_style(name).color)
    axes.annotate(
        f"{one.rate_hz:,.0f}",
        (one.rate_hz, row),
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        fontsize=9.5,
    )


def latency_row(axes: Axes, row: int, name: str, one: Aggregate) -> None:
    """A latency distribution: p1 to p99, p25 to p75, p50 and p99.9."""
    found = [one.latency_us(percent) for percent in (1, 25, 50, 75, 99, 99.9)]
    if None in found:
        return
    p1, p25, p50, p75, p99, p999 = (max(1.0, value or 0.0) for value in found)
    color = line_style(name).color
    axes.plot([p1, p99], [row, row], color=color, lw=7, alpha=0.28, solid_capstyle="butt")
    axes.plot([p25, p75], [row, row], color=color, lw=7, solid_capstyle="butt")
    axes.plot([p99, p999], [row, row], color=color, lw=1)
    axes.plot([p999], [row], color=color, marker="|", ms=9, mew=1.6)
    axes.plot([p50], [row], color="white", marker="o", ms=5.5, mec=color, mew=1.6)


def cpu_bar(axes: Axes, row: int, name: str, one: Aggregate) -> None:
    """Stacked CPU of writer, reader and other processes, labelled with the sum."""
    cpu = one.cpu_percent()
    parts = (cpu["writer"], cpu["reader"], one.cpu_total - cpu["writer"] - cpu["reader"])
    left = 0.0
    for part, shade in zip(parts, ROLE_SHADES, strict=True):
        axes.barh(row, part, left=left, height=0.56, color=line_style(name).color, alpha=shade, lw=0)
        left += part
    axes.annotate(
        f"{left:.0f} %", (left, row), xytext=(5, 0), textcoords="offset points", va="center", fontsize=9.5
    )


def time_axis(axes: Axes, title: str) -> None:
    """A logarithmic time axis with unit labels."""
    axes.set(xscale="log", title=title)
    low, high = axes.get_xlim()
    ticks = {100.0: "0.1 ms", 1e3: "1 ms", 1e4: "10 ms", 1e5: "100 ms", 1e6: "1 s", 1e7: "10 s"}
    shown = [tick for tick in ticks if low <= tick <= high]
    axes.set_xticks(shown, [ticks[tick] for tick in shown])
    axes.set_xticks([], minor=True)
