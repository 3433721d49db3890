"""The plots of a run, as SVG and PNG: which there are."""

from __future__ import annotations

from pathlib import Path

from bench.outcome import find
from bench.results import Results

ROBOT = "talos"
TALK_RATE_HZ = 1000.0


class PlotsMissing(Exception):
    """There is no matplotlib."""


def write_plots(results: Results) -> list[Path]:
    """Every plot that the run has figures for, into its folder, the one for a talk first.

    Raises PlotsMissing where matplotlib is not installed.
    """
    try:
        from bench import charts, drawing  # noqa: PLC0415 - tables can be had without matplotlib
    except ImportError as error:
        raise PlotsMissing(
            f"there are no plots without matplotlib ({error}): pip install -e '.[robots,bench]'"
        ) from error
    rates = [one for one in find(results, group="rate", robot=ROBOT) if one.rate_hz]
    talk = [one for one in rates if one.rate_hz == TALK_RATE_HZ]
    robots = [one for group in ("rate", "robot") for one in find(results, group=group, rate_hz=100.0)]
    readers = find(results, group="readers")
    late = find(results, group="late")
    single = [find(results, group="rate", robot=one.robot, rate_hz=one.rate_hz) for one in readers[:1]]
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
