from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import failure, run_cli


@pytest.fixture(autouse=True)
def _bare_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in [name for name in os.environ if name.startswith("ZSTATE_")] + ["ROS_DOMAIN_ID"]:
        monkeypatch.delenv(variable, raising=False)


def effective_config(*arguments: str, code: int = 0) -> tuple[dict[str, tuple[Any, str]], list[str]]:
    """Each setting with its origin, and the problems."""
    ended = run_cli("config", *arguments, "--json")
    assert ended.code == code, ended.stderr
    output = json.loads(ended.stdout)
    return {one["name"]: (one["value"], one["origin"]) for one in output["settings"]}, output["problems"]


def test_without_options_every_setting_is_a_default():
    settings, problems = effective_config()
    assert settings["mode"] == ("peer", "default")
    addresses = "127.0.0.1:7450 127.0.0.1:7451 127.0.0.1:7452"
    assert settings["rendezvous"] == (addresses, "default")
    assert settings["wire"] == ("native", "default")
    assert {origin for name, (_, origin) in settings.items() if name != "kernel"} == {"default"}
    assert problems == []


def test_options_precede_the_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_MODE", "lan")
    monkeypatch.setenv("ZSTATE_CLOCK", "sim")
    settings, _ = effective_config("--mode", "peer")
    assert settings["mode"] == ("peer", "option --mode")
    assert settings["clock"] == ("sim", "environment ZSTATE_CLOCK")


def test_implied_setting_names_the_option_that_implies_it():
    settings, _ = effective_config("--connect", "tcp/10.0.0.1:7447")
    assert settings["mode"] == ("client", "option --connect, which alone means a router")
    assert settings["connect"] == (["tcp/10.0.0.1:7447"], "option --connect")
    assert "rendezvous" not in settings


def test_zenoh_configuration_applies_without_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "zenoh.json5"
    file.write_text('{mode: "client", connect: {endpoints: ["tcp/10.0.0.1:7447"]}}')
    monkeypatch.setenv("ZENOH_CONFIG", str(file))
    settings, _ = effective_config("--connect", "tcp/10.0.0.2:7447")
    assert settings["config"] == (str(file), "environment ZENOH_CONFIG")
    assert settings["mode"] == ("client", f"file {file}")
    assert settings["connect"] == (["tcp/10.0.0.2:7447"], "option --connect")
    assert settings["listen"][1] == "default of Zenoh"


def test_ros_domain_of_the_wire_precedes_the_environment(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert effective_config("--wire", "ros2")[0]["ros domain"] == (7, "environment ROS_DOMAIN_ID")
    assert effective_config("--wire", "ros2:domain=3")[0]["ros domain"] == (3, "option --wire")


def test_a_password_is_never_shown(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_PASSWORD", "hunter2")
    for form in ((), ("--json",), ("--zenoh",)):
        ended = run_cli("config", "--connect", "tcp/10.0.0.1:7447", "--user", "bob", *form)
        assert ended.code == 0
        assert "bob" in ended.stdout
        assert "hunter2" not in ended.stdout + ended.stderr


def test_zenoh_settings_are_listed():
    output = json.loads(run_cli("config", "--zenoh", "--json", "--connect", "tcp/10.0.0.1:7447").stdout)
    assert output["mode"] == "client"
    assert output["connect/endpoints"] == ["tcp/10.0.0.1:7447"]


@pytest.mark.parametrize(
    ("variable", "value", "problem"),
    [
        ("ZSTATE_CONECT", "tcp/10.0.0.1:7447", "nothing reads ZSTATE_CONECT; did you mean 'ZSTATE_CONNECT'?"),
        ("ZSTATE_RENDEZVOUS", "here", "ZSTATE_RENDEZVOUS is 'here'"),
        ("ZSTATE_CERTS", "/", "--certs needs --identity"),
        ("ZSTATE_CONNECT", "10.0.0.1", "write 'tcp/10.0.0.1:7447'"),
        ("ZSTATE_MODE", "client", "mode 'client' needs --connect"),
    ],
)
def test_problems_of_the_environment_are_reported(monkeypatch, variable: str, value: str, problem: str):
    monkeypatch.setenv(variable, value)
    _, problems = effective_config(code=1)
    assert len(problems) == 1
    assert problem in problems[0]
    assert problem in run_cli("config").stderr


def test_every_option_can_be_set_in_the_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_TF_RATE", "5")
    assert effective_config()[1] == []


def test_missing_file_is_wrong_usage():
    assert "'nowhere.json5' does not exist" in failure("config", "--config", "nowhere.json5", code=2)
