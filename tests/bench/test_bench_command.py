"""``python -m bench`` without measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from click.testing import CliRunner, Result

from bench import __main__ as command
from bench.subjects import raw_zenoh

SUBJECTS = {
    "here": replace(raw_zenoh.SUBJECT, name="here", title="a system"),
    "absent": replace(
        raw_zenoh.SUBJECT,
        name="absent",
        title="Absent DDS",
        python=lambda: None,
        install=("echo made it", "false"),
    ),
}


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """The command, with two subjects in place of the real ones."""
    monkeypatch.setattr(command, "NAMES", tuple(SUBJECTS))
    monkeypatch.setattr(command, "subject_named", SUBJECTS.__getitem__)
    monkeypatch.setattr(command, "CONSOLE", command.Console(width=200))
    return lambda *arguments: CliRunner().invoke(command.main, arguments)


def test_setup_lists_installed_subjects_and_install_commands_of_missing_ones(
    bench: Callable[..., Result], capsys
) -> None:
    command._show_installed(list(SUBJECTS.values()))
    shown = capsys.readouterr().out
    assert "a system" in shown
    assert "eclipse-zenoh 1" in shown
    assert "absent: python -m bench setup absent, which is\n  echo made it\n  false\n" in shown


def test_setup_stops_at_the_first_failing_command(bench: Callable[..., Result]) -> None:
    result = bench("setup", "absent")
    assert result.exit_code == 1
    assert "absent: this command failed" in result.output


@pytest.mark.parametrize(
    ("option", "value", "known"),
    [("--subject", "ros9", "here, absent"), ("--scenario", "talos-7", "talos-1000")],
)
def test_unknown_subject_or_scenario_error_lists_known_names(
    bench: Callable[..., Result], option: str, value: str, known: str
) -> None:
    result = bench("run", option, value)
    assert result.exit_code == 2
    assert value in result.output
    assert known in result.output
