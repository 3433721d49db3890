"""``python -m bench`` without measurements."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from helpers.fake_results import a_run

from bench import __main__ as command
from bench.page import DOCUMENTS, END
from bench.scenario import Scenario, Turn
from bench.subjects import raw_zenoh

ALONE = raw_zenoh.SUBJECTS[0]
SUBJECTS = {
    "zstate_peer": replace(ALONE, name="zstate_peer", title="a system", floor=False),
    "cyclone": replace(
        ALONE,
        name="cyclone",
        title="Absent DDS",
        python=lambda: None,
        install=("echo made it", "apt-get-is-no-command-here"),
    ),
}


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """The command with two subjects, and runs that take no time."""
    turns: list[Turn] = []

    def fake_trial(subject: Any, scenario: Scenario) -> dict[str, Any]:
        turns.append(Turn(subject, scenario, 0))
        facts = a_run(subject.name, scenario, 0, 1.0)
        return {name: value for name, value in facts.items() if name not in ("subject", "scenario", "round")}

    monkeypatch.setattr(command, "SUBJECTS", SUBJECTS)
    monkeypatch.setattr(command, "run_trial", fake_trial)
    monkeypatch.setattr(command, "measure_parts", lambda _: None)
    monkeypatch.setattr(command, "CONSOLE", command.Console(width=200))
    return lambda *arguments: CliRunner().invoke(command.main, arguments)


def test_command_alone_shows_what_is_installed_and_one_line_for_each_that_is_not(
    bench: Callable[..., Result],
) -> None:
    result = bench()
    assert result.exit_code == 0, result.output
    assert "a system" in result.output
    lines = [line for line in result.output.splitlines() if "cyclone" in line]
    assert lines == ["cyclone is not installed: python -m bench setup cyclone (as root)"]


def test_command_alone_starts_no_run_after_two_minutes(
    bench: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "QUICK_WITHIN_S", 0.0)
    assert "not run, as this machine is slow or busy: zstate_peer" in bench().output


def test_setup_lists_install_commands_and_stops_at_the_first_that_fails(bench: Callable[..., Result]) -> None:
    assert "cyclone: Absent DDS; not installed\n  echo made it\n" in bench("setup").output
    result = bench("setup", "cyclone")
    assert result.exit_code == 1
    assert "cyclone: this command failed" in result.output


@pytest.mark.parametrize(
    ("option", "value", "known"),
    [("--subject", "ros9", "cyclone"), ("--scenario", "talos-7", "talos-1000")],
)
def test_unknown_subject_or_scenario_error_lists_known_names(
    bench: Callable[..., Result], option: str, value: str, known: str
) -> None:
    result = bench("run", option, value)
    assert result.exit_code == 2
    assert value in result.output
    assert known in result.output


@pytest.mark.robots
def test_one_command_measures_and_writes_both_documents_with_charts(
    bench: Callable[..., Result], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "docs").mkdir()
    (tmp_path / "bench" / "results").mkdir(parents=True)
    for name in DOCUMENTS:
        what = "summary" if name == "README.md" else "tables"
        old = f"before\n\n<!-- bench: {what} of bench/results/old -->\n\nold\n\n{END}\n\nafter\n"
        (tmp_path / name).write_text(old)
    result = bench("page", "--to", str(tmp_path), "--rounds", "2", "--seconds", "0.1")
    assert result.exit_code == 0, result.output
    [folder] = (tmp_path / "bench" / "results").iterdir()
    assert {path.name for path in folder.iterdir()} == {
        "about.json",
        "runs.jsonl",
        "report.md",
        "panda-100.svg",
        "talos-1000.svg",
    }
    assert "git rm -r bench/results/old" in result.output
    for name in DOCUMENTS:
        text = (tmp_path / name).read_text()
        assert re.match(r"before\n\n<!-- bench: \w+ of bench/results/[\w-]+ -->\n\n", text)
        assert text.endswith(f"{END}\n\nafter\n")
        assert "a system" in text
        assert "2 rounds of 0.1 s" in text
