"""Benchmark tables in documents match the results they name."""

from __future__ import annotations

from pathlib import Path

from helpers.fake_results import TITLES, write_results

from bench.page import END, PAGE, short_table, with_current_tables

FOLDER = "bench/results/2026-01-02-abc1234"
FACTORS = {"zstate_peer": 1.0, "ros1": 4.0, "raw_zenoh": 0.8}


def test_tables_of_the_page_match_the_results_they_name() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert END in text
    assert with_current_tables(text) == text, "python -m bench report --page rewrites them"


def test_every_bench_mark_has_an_end_mark() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert text.count("<!-- bench: ") == text.count(END)


def test_only_the_table_between_the_marks_is_rewritten(tmp_path: Path) -> None:
    results = write_results(tmp_path / FOLDER, FACTORS, TITLES)
    before = f"# Title\n<!-- bench: {FOLDER} -->\nan old table\n{END}\nthe rest\n"
    after = with_current_tables(before, tmp_path)
    assert after == f"# Title\n<!-- bench: {FOLDER} -->\n\n{short_table(results)}\n{END}\nthe rest\n"
    assert with_current_tables(after, tmp_path) == after


def test_short_table_has_a_row_per_measured_subject(tmp_path: Path) -> None:
    lines = short_table(write_results(tmp_path, FACTORS, TITLES)).splitlines()
    cells = {
        line.split("|")[1].strip(): [one.strip() for one in line.split("|")[2:-1]] for line in lines if line
    }
    assert cells["**zstate**"] == ["1000.0 Hz", "150 / 299 us", "10.0 + 20.0 %", "", "288", "30 ms"]
    assert cells["ROS 1"][0] == "500.0 Hz"
    assert cells["ROS 1"][3] == "12.0 %"
    assert cells["raw Zenoh (floor)"][-1] == "24 ms"


def test_document_without_marks_is_unchanged(tmp_path: Path) -> None:
    assert with_current_tables("no table\n", tmp_path) == "no table\n"
