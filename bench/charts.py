"""Charts of a benchmark run, one question each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.aggregate import Aggregate, aggregates
from bench.chart_rows import cpu_bar, latency_row, name_rows, rate_bar, time_axis
from bench.drawing import add_footnote, label_ends, line_style, plain_ticks, styled
from bench.results import Results
from bench.scenario import Scenario

# A reader keeps up if it reaches this fraction of the commanded rate.
KEPT_UP = 0.995

Lines = Mapping[str, Sequence[tuple[float, float]]]


@styled
def overview(results: Results, scenario: Scenario) -> Figure:
    """Rate, latency and CPU of every subject in one scenario; suits a talk."""
    found = aggregates(results, scenario)
    figure = Figure(figsize=(13.0, 1.6 + 0.42 * len(found)))
    rate, latency, cpu = figure.subplots(1, 3, sharey=True, width_ratios=(1.0, 1.25, 1.25))
    name_rows(rate, results, found)
    for row, (name, one) in enumerate(found.items()):
        rate_bar(rate, row, name, one)
        latency_row(latency, row, name, one)
        cpu_bar(cpu, row, name, one)
    rate.set(
        title="Rate at the reader",
        xlim=(0, 1.28 * scenario.rate_hz),
        xticks=(0, scenario.rate_hz / 2, scenario.rate_hz),
    )
    rate.set_xlabel("Hz")
    time_axis(latency, "Latency, from stamp to answer")
    cpu.set(title="CPU, all processes", xlabel="% of a core; dark to light: writer, reader, others")
    cpu.margins(x=0.18)
    for axes in (rate, latency, cpu):
        axes.grid(axis="x")
        axes.tick_params(axis="y", length=0)
        axes.set_axisbelow(True)
    figure.suptitle(
        f"{scenario.robot}, {_joints(results, scenario)} joints, {scenario.rate} commanded",
        x=0.0,
        ha="left",
        fontsize=15,
        fontweight="bold",
    )
    figure.tight_layout(rect=(0, 0, 1, 0.99), w_pad=2.5)
    _add_source(figure, results, "Latency: bar from p1 to p99, dark from p25 to p75, dot p50, tick p99.9.")
    return figure


@styled
def latencies(results: Results, scenarios: Sequence[Scenario]) -> Figure | None:
    """Latency distributions, one panel per rate."""
    if not scenarios:
        return None
    names = {name: one for scenario in scenarios for name, one in aggregates(results, scenario).items()}
    figure = Figure(figsize=(2.4 + 4.6 * len(scenarios), 1.6 + 0.42 * len(names)))
    panels = figure.subplots(1, len(scenarios), sharey=True, sharex=True, squeeze=False)[0]
    name_rows(panels[0], results, names)
    for axes, scenario in zip(panels, scenarios, strict=True):
        found = aggregates(results, scenario)
        for row, name in enumerate(names):
            if name in found:
                latency_row(axes, row, name, found[name])
        time_axis(axes, f"{scenario.robot} at {scenario.rate}")
        axes.grid(axis="x")
        axes.tick_params(axis="y", length=0)
        axes.set_axisbelow(True)
    figure.tight_layout(w_pad=2.5)
    _add_source(
        figure,
        results,
        "From stamp to the answer of the reader's own buffer. "
        "Bar from p1 to p99, dark from p25 to p75, dot p50, tick p99.9.",
    )
    return figure


@styled
def rates(results: Results, scenarios: Sequence[Scenario]) -> Figure:
    """Commanded against achieved rate."""
    lines = _lines(results, scenarios, lambda scenario: scenario.rate_hz, lambda one: one.rate_hz)
    commanded = sorted({scenario.rate_hz for scenario in scenarios})
    figure = Figure(figsize=(8.6, 5.4))
    axes = figure.subplots()
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="commanded, Hz",
        title=f"Achieved rate at the reader, Hz: {scenarios[0].robot}",
    )
    axes.plot(commanded, commanded, color="#CCCCCC", lw=8, solid_capstyle="round", zorder=1)
    kept = {name for name, points in lines.items() if all(y >= KEPT_UP * x for x, y in points)}
    ends = _draw(axes, results, {name: points for name, points in lines.items() if name not in kept})
    for name in kept:
        axes.plot(
            *zip(*lines[name], strict=True),
            color=line_style(name).color,
            marker=line_style(name).marker,
            ls="",
            ms=5,
            zorder=3,
        )
    text = "on the line at every rate:\n" + "\n".join(_title(results, name) for name in lines if name in kept)
    axes.text(0.03, 0.97, text, transform=axes.transAxes, va="top", fontsize=9.5, linespacing=1.45)
    plain_ticks(axes, "x", commanded)
    plain_ticks(axes, "y", commanded)
    axes.grid()
    label_ends(axes, ends)
    _add_source(figure, results, f"On the line: never below {100 * KEPT_UP:g} % of the commanded rate.")
    return figure


@styled
def cpu_by_rate(results: Results, scenarios: Sequence[Scenario]) -> Figure:
    """CPU of all processes at each rate."""
    lines = _lines(results, scenarios, lambda scenario: scenario.rate_hz, lambda one: one.cpu_total)
    figure = _line_chart(
        results, lines, f"CPU of all processes, % of a core: {scenarios[0].robot}", "commanded, Hz"
    )
    _add_source(figure, results, "Writer, reader and every other process that the system needs.")
    return figure


@styled
def by_joints(results: Results, scenarios: Sequence[Scenario]) -> Figure:
    """Bytes per sample and CPU against the number of joints."""
    figure = Figure(figsize=(13.0, 5.0))
    left, right = figure.subplots(1, 2)

    def joints(scenario: Scenario) -> float:
        return float(_joints(results, scenario))

    figures: tuple[tuple[Axes, str, Callable[[Aggregate], float]], ...] = (
        (left, "Bytes on loopback for each sample", lambda one: one.bytes_per_sample),
        (right, "CPU of all processes, % of a core", lambda one: one.cpu_total),
    )
    for axes, title, figure_of in figures:
        _plot_lines(axes, results, _lines(results, scenarios, joints, figure_of), title, "joints")
    figure.subplots_adjust(wspace=0.62)
    for axes, _, figure_of in figures:
        label_ends(axes, _ends(results, _lines(results, scenarios, joints, figure_of)))
    robots = ", ".join(f"{one.robot} {_joints(results, one)}" for one in sorted(scenarios, key=joints))
    _add_source(
        figure,
        results,
        f"At {scenarios[0].rate}, one reader. Joints: {robots}. IP and TCP headers included.",
    )
    return figure


@styled
def by_readers(results: Results, scenarios: Sequence[Scenario]) -> Figure:
    """CPU of all processes against the number of readers."""
    lines = _lines(results, scenarios, lambda scenario: float(scenario.readers), lambda one: one.cpu_total)
    figure = _line_chart(
        results,
        lines,
        f"CPU of all processes, % of a core: {scenarios[0].robot} at {scenarios[0].rate}",
        "readers",
    )
    _add_source(figure, results, "Each reader is a process with its own buffer.")
    return figure


@styled
def joins(results: Results, scenario: Scenario) -> Figure:
    """Times of late joiners, one dot each."""
    found = aggregates(results, scenario)
    figure = Figure(figsize=(8.2, 1.5 + 0.4 * len(found)))
    axes = figure.subplots()
    name_rows(axes, results, found)
    for row, (name, one) in enumerate(found.items()):
        axes.plot(
            one.joins_ms,
            [row] * len(one.joins_ms),
            ls="",
            marker="o",
            ms=6,
            color=line_style(name).color,
            alpha=0.6,
            mew=0,
        )
        axes.annotate(
            f"{one.joins_ms[len(one.joins_ms) // 2]:.0f} ms",
            (max(one.joins_ms), row),
            xytext=(9, 0),
            textcoords="offset points",
            va="center",
            fontsize=9.5,
        )
    axes.set(xscale="log", title="A late joiner has the whole tree after")
    low, high = axes.get_xlim()
    plain_ticks(
        axes,
        "x",
        [tick for tick in (1, 3, 10, 30, 100, 300, 1000, 3000, 10000) if low <= tick <= 2 * high],
        "{:g} ms",
    )
    axes.set_xlim(low, 2 * high)
    axes.grid(axis="x")
    axes.tick_params(axis="y", length=0)
    figure.tight_layout()
    _add_source(
        figure,
        results,
        f"{scenario.robot} at {scenario.rate}; from the opening of the session. The figure is the median.",
    )
    return figure


def _line_chart(results: Results, lines: Lines, title: str, x_label: str) -> Figure:
    figure = Figure(figsize=(8.6, 5.4))
    axes = figure.subplots()
    _plot_lines(axes, results, lines, title, x_label)
    label_ends(axes, _ends(results, lines))
    return figure


def _plot_lines(axes: Axes, results: Results, lines: Lines, title: str, x_label: str) -> None:
    axes.set(xscale="log", yscale="log", title=title, xlabel=x_label)
    _draw(axes, results, lines)
    plain_ticks(axes, "x", sorted({x for points in lines.values() for x, _ in points}))
    low, high = axes.get_ylim()
    ticks = [digit * 10.0**power for power in range(-1, 7) for digit in (1, 2, 5)]
    plain_ticks(axes, "y", [tick for tick in ticks if low <= tick <= high], "{:,g}")
    axes.grid()


def _lines(
    results: Results,
    scenarios: Sequence[Scenario],
    x: Callable[[Scenario], float],
    y: Callable[[Aggregate], float],
) -> Lines:
    """The measured points of each subject, by ascending x."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for scenario in sorted(scenarios, key=x):
        for name, one in aggregates(results, scenario).items():
            lines.setdefault(name, []).append((x(scenario), y(one)))
    return {name: lines[name] for name in results.subjects if name in lines}


def _draw(axes: Axes, results: Results, lines: Lines) -> list[tuple[float, float, str, str]]:
    for name, points in lines.items():
        style = line_style(name)
        axes.plot(
            *zip(*points, strict=True),
            color=style.color,
            marker=style.marker,
            ls=style.dashes,
            mec="white",
            mew=0.8,
        )
    return _ends(results, lines)


def _ends(results: Results, lines: Lines) -> list[tuple[float, float, str, str]]:
    return [(*points[-1], _title(results, name), line_style(name).color) for name, points in lines.items()]


def _joints(results: Results, scenario: Scenario) -> int:
    return int(results.about["robots"][scenario.robot]["joints"])


def _title(results: Results, name: str) -> str:
    return str(results.subjects[name]["title"])


def _add_source(figure: Figure, results: Results, text: str) -> None:
    about = results.about
    add_footnote(figure, f"{text}\n{about['machine']}; commit {about['commit']}, {about['began'][:10]}.")
