"""The report of synthetic results."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.fake_results import SCENARIOS, TITLES, write_results

from bench.report import cell, number, report_lines, soak_lines
from bench.results import CPU, JOIN, P50, Results, Spread

FACTORS = {"zstate_peer": 1.0, "ros1": 4.0, "raw_zenoh": 0.8}


@pytest.fixture
def results(tmp_path: Path) -> Results:
    return write_results(tmp_path / "2026-01-02-abc1234", FACTORS)


def rows(results: Results, heading: str) -> dict[str, list[str]]:
    """The tables under a heading, by their first column; later tables add their cells."""
    lines = list(report_lines(results))
    begin = next(at for at, line in enumerate(lines) if line.startswith(f"## {heading}"))
    end = next((at for at in range(begin + 1, len(lines)) if lines[at].startswith("## ")), len(lines))
    found: dict[str, list[str]] = {}
    for line in lines[begin:end]:
        if line.startswith("|"):
            first, *others = [part.strip() for part in line.strip("|").split("|")]
            found.setdefault(first, []).extend(others)
    return found


def test_missing_subject_is_listed_with_its_install_command(results: Results) -> None:
    assert rows(results, "Not installed")["Absent DDS"] == ["`pip install absent-dds`"]
    assert "Absent DDS" not in rows(results, "talos at 1000 Hz")


def test_failed_run_is_listed_with_its_reason_and_no_figures(results: Results) -> None:
    assert rows(results, "Failed")["ROS 1"] == ["talos-100-readers5", "roscore was not ready"]
    assert "ROS 1" not in rows(results, "talos at 100 Hz, 5 readers")


def test_table_shows_medians_with_the_range_of_the_rounds_and_losses(results: Results) -> None:
    # Two rounds at 4 and 4.4 times the cost. CPU: 3 % of a core each 100 Hz, 3 % of the state publisher.
    cells = rows(results, "talos at 1000 Hz")["ROS 1"]
    assert cells[:2] == ["500", "630 [600 to 660]"]
    assert cells[3] == "138.6 [132 to 145.2]"
    assert cells[4] == "35.8 [34.1 to 37.5]"
    assert cells[6] == "126 [120 to 132]"
    assert cells[-4:-2] == ["2", "4000"]


def test_fleet_table_shows_the_rate_per_robot(results: Results) -> None:
    assert rows(results, "100 x panda at 50 Hz")["zstate"][0] == "50"


def test_cpu_of_several_readers_is_summed_and_latency_is_the_median(results: Results) -> None:
    scenario = SCENARIOS[2]
    assert results.spread("zstate_peer", scenario, CPU) == Spread(11.0, 11.0, 11.0)  # 1 % and 5 times 2 %
    assert results.spread("zstate_peer", scenario, P50) == Spread(150.0, 150.0, 150.0)


def test_unmeasured_figure_is_a_dash(results: Results) -> None:
    assert results.spread("zstate_peer", SCENARIOS[0], JOIN) is None
    assert rows(results, "panda at 100 Hz")["zstate"][6] == "-"


def test_report_lists_the_settings_of_every_subject(results: Results) -> None:
    text = "\n".join(report_lines(results))
    for name, title in TITLES.items():
        assert f"- **{title}** ({name} 1.0): how {name} is set." in text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.51349, "0.513"),
        (12.34, "12.3"),
        (123.44, "123.4"),
        (100.0, "100"),
        (999.98, "1,000"),
        (12345.6, "12,346"),
    ],
)
def test_number_is_rounded_to_three_or_four_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_cell_omits_a_range_that_rounds_to_one_number() -> None:
    assert cell(Spread(1.0001, 1.0, 1.0002)) == "1"
    assert cell(None) == "-"


def test_soak_table_shows_growth_and_losses() -> None:
    router = {"cpu_percent": 17.1, "memory_mb": [78.7, 82.5], "slope_kb_per_minute": [515.3, 18.5]}
    soak = {
        "processes": {"router": {**router, "threads": [261, 261], "descriptors": [120, 121]}},
        "sent": 100,
        "count": 99,
        "latched": 2000,
        "latched_lost": 1,
        "latched_within_s": 0.16,
        "age_ms_p50_p99_max": [17.1, 19.8, 872.7],
        "older_than_1_s": 0,
        "joins_ms": [900.0, 1092.0],
    }
    text = "\n".join(soak_lines(soak))
    assert "| router | 17.1 | 78.7 to 82.5 | 515.3 ± 18.5 | 261 to 261 | 120 to 121 |" in text
    assert "sent 100, received 99" in text
    assert "latched values 2000, lost 1" in text
    assert "late joiners: 2, whole after 1092 ms at most" in text
