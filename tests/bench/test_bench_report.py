"""The report of synthetic results."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from helpers.fake_results import SCENARIOS, TITLES, write_results

import bench
from bench.aggregate import aggregate
from bench.markdown import dash, number
from bench.plots import PlotsMissing, write_plots
from bench.report import report_lines, write_report
from bench.results import Results

FACTORS = {"zstate_peer": 1.0, "ros1": 4.0, "raw_zenoh": 0.8}
RATE = SCENARIOS[0]


@pytest.fixture
def results(tmp_path: Path) -> Results:
    return write_results(tmp_path / "2026-01-02-abc1234", FACTORS, TITLES)


def rows(results: Results, heading: str) -> dict[str, list[str]]:
    """The table under a heading, by its first column."""
    lines = list(report_lines(results, []))
    begin = next(at for at, line in enumerate(lines) if line.startswith(f"## {heading}"))
    table = [line for line in lines[begin : _next_heading(lines, begin)] if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    return {line[0]: line[1:] for line in cells}


def _next_heading(lines: list[str], begin: int) -> int:
    return next((at for at in range(begin + 1, len(lines)) if lines[at].startswith("## ")), len(lines))


def test_missing_subject_is_listed_with_its_install_command(results: Results) -> None:
    assert rows(results, "Not installed")["Absent DDS"] == ["`pip install absent-dds`"]
    assert "Absent DDS" not in rows(results, "Rate at the reader: talos")


def test_failed_run_is_listed_with_its_reason_and_no_figures(results: Results) -> None:
    assert rows(results, "Failed")["ROS 1"] == ["talos-100-busy", "roscore was not ready"]
    assert "ROS 1" not in rows(results, "A thread holds the reader's GIL")


def test_unmeasured_figure_is_a_dash(tmp_path: Path) -> None:
    results = write_results(tmp_path, {"zstate_peer": 1.0, "ros1": 4.0}, TITLES)
    assert rows(results, "Rate at the reader: talos")["raw Zenoh (floor)"] == ["-", "-"]


def test_rate_table_shows_commanded_rates_achieved_rates_and_losses(results: Results) -> None:
    table = rows(results, "Rate at the reader: talos")
    assert table["commanded"] == ["100 Hz", "1000 Hz"]
    assert table["zstate"] == ["100", "1,000"]
    assert table["ROS 1"] == ["100", "500 (4000 of 8000)"]


def test_ratio_is_the_other_systems_figure_divided_by_that_of_zstate(results: Results) -> None:
    table = rows(results, "Times zstate's figure: talos at 1000 Hz")
    # CPU: 3 % of a core each 100 Hz and factor, and the state publisher's 3 % by its factor of 4.
    assert table["ROS 1"] == ["0.5", "4", "4", f"{(120 + 12) / 30:.3g}", "4"]
    assert table["raw Zenoh (floor)"] == ["1", "0.8", "0.8", "0.8", "0.8"]
    assert "zstate" not in table


def test_fleet_table_shows_the_rate_per_robot(results: Results) -> None:
    assert rows(results, "100 x panda at 50 Hz")["zstate"][0] == "50"


def test_late_joiner_table_shows_median_and_maximum(results: Results) -> None:
    assert rows(results, "Late joiners: talos at 100 Hz")["ROS 1"] == ["120", "160", "60", "80", "3"]


def test_cpu_of_several_readers_is_summed_and_latency_is_the_median(results: Results) -> None:
    five = aggregate(results, "zstate_peer", SCENARIOS[3])
    one = aggregate(results, "zstate_peer", RATE)
    assert five is not None
    assert one is not None
    assert five.cpu_percent()["reader"] == pytest.approx(5 * one.cpu_percent()["reader"])
    assert five.latency_us(50) == one.latency_us(50)


def test_report_lists_the_settings_of_every_subject(results: Results) -> None:
    text = "\n".join(report_lines(results, []))
    for name, title in TITLES.items():
        assert f"- **{title}** ({name} 1.0): how {name} is set." in text


@pytest.mark.long
def test_plots_are_written_next_to_the_report_and_shown_in_it(results: Results) -> None:
    pytest.importorskip("matplotlib")
    plots = write_plots(results)
    names = {"overview", "rates", "latency", "cpu", "joints", "readers", "late"}
    assert {path.name for path in plots} == {f"{name}{end}" for name in names for end in (".svg", ".png")}
    text = write_report(results, plots).read_text()
    assert all(f"({name}.svg)" in text for name in names)
    assert "Rate at the reader" in (results.folder / "overview.svg").read_text()


def test_report_without_matplotlib_has_tables_and_names_the_package(
    results: Results, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(bench, "charts", raising=False)
    monkeypatch.setitem(sys.modules, "bench.charts", None)  # importing it fails, as without matplotlib
    with pytest.raises(PlotsMissing, match="pip install"):
        write_plots(results)
    assert write_report(results, []).exists()


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.51349, "0.513"), (12.34, "12.3"), (123.44, "123.4"), (100.0, "100"), (12345.6, "12,346")],
)
def test_number_is_rounded_to_three_or_four_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_missing_value_is_a_dash() -> None:
    assert dash(None, number) == "-"
