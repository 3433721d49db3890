"""``python -m bench``, as far as it measures nothing."""

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


def test_setup_shows_what_is_there_and_how_the_rest_is_installed(
    bench: Callable[..., Result], capsys
) -> None:
    command._show_installed(list(SUBJECTS.values()))
    shown = capsys.readouterr().out
    assert "a system" in shown
    assert "eclipse-zenoh 1" in shown
    assert "absent: python -m bench setup absent, which is\n  echo made it\n  false\n" in shown


def test_setup_stops_at_the_first_command_that_fails(bench: Callable[..., Result]) -> None:
    result = bench("setup", "absent")
    assert result.exit_code == 1
    assert "absent: this command failed" in result.output


@pytest.mark.parametrize(("option", "value"), [("--subject", "ros9"), ("--scenario", "talos-7")])
def test_a_name_that_does_not_exist_is_refused_with_those_that_do(
    bench: Callable[..., Result], option: str, value: str
) -> None:
    result = bench("run", option, value)
    assert result.exit_code == 2
    assert value in result.output
    assert "here, absent" in result.output or "talos-1000" in result.output
