"""Selects and writes the plots of a run, as SVG and PNG."""

from __future__ import annotations

from pathlib import Path

from bench.aggregate import find_scenarios
from bench.results import Results

ROBOT = "talos"
TALK_RATE_HZ = 1000.0


class PlotsMissing(Exception):
    """matplotlib is not installed."""


def write_plots(results: Results) -> list[Path]:
    """Writes every plot that the run has figures for into its folder; the overview comes first.

    Raises PlotsMissing if matplotlib is not installed.
    """
    try:
        from bench import charts, drawing  # noqa: PLC0415 - tables need no matplotlib
    except ImportError as error:
        raise PlotsMissing(f"plots need matplotlib ({error}): pip install -e '.[bench]'") from error
    rates = [one for one in find_scenarios(results, group="rate", robot=ROBOT) if one.rate_hz]
    talk = [one for one in rates if one.rate_hz == TALK_RATE_HZ]
    robots = [
        one for group in ("rate", "robot") for one in find_scenarios(results, group=group, rate_hz=100.0)
    ]
    readers = find_scenarios(results, group="readers")
    late = find_scenarios(results, group="late")
    single = [
        find_scenarios(results, group="rate", robot=one.robot, rate_hz=one.rate_hz) for one in readers[:1]
    ]
    drawn = {
        "overview": charts.overview(results, talk[0]) if talk else None,
        "rates": charts.rates(results, rates) if len(rates) > 1 else None,
        "latency": charts.latencies(results, [one for one in rates if one.rate_hz in (100.0, 1000.0)]),
        "cpu": charts.cpu_by_rate(results, rates) if len(rates) > 1 else None,
        "joints": charts.by_joints(results, robots) if len(robots) > 1 else None,
        "readers": charts.by_readers(results, [*(single[0] if single else ()), *readers])
        if readers
        else None,
        "late": charts.joins(results, late[0]) if late else None,
    }
    return [path for name, made in drawn.items() if made for path in drawing.save(made, results.folder, name)]
