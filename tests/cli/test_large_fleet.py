"""Commands in a fleet of more robots than Zenoh's default channel holds tokens of (256)."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, run_cli, started
from helpers.processes import repeated

from zstate import StatePublisher, connect, load_model
from zstate.net.presence import local_writer
from zstate.wire.keys import READER_TOKEN, WRITER_TOKEN

ROBOTS = 300


@pytest.fixture
def fleet() -> Iterator[None]:
    """A robot that publishes, and the tokens of the writers and readers of 300 others."""
    with ExitStack() as opened:
        session = opened.enter_context(connect())
        for number in range(ROBOTS):
            identity = local_writer(number, "driver").identity
            for token in (
                WRITER_TOKEN.key(f"r{number}", "joint_states", identity),
                READER_TOKEN.key(f"r{number}", "joint_states", identity),
            ):
                opened.callback(session.zenoh.liveliness().declare_token(token).undeclare)
        publisher = opened.enter_context(StatePublisher(session, load_model(RRBOT), robot="rrbot"))
        opened.enter_context(repeated(lambda: publisher.publish([0.0, 0.0])))
        yield


def test_all_robots_are_listed(fleet: None):
    ended = run_cli("ls", "--json")
    assert ended.code == 0
    assert len(json.loads(ended.stdout)) == ROBOTS + 1
    assert f"r{ROBOTS - 1}" in run_cli("ls").stdout


@pytest.mark.parametrize(
    "command",
    [("graph",), ("tree", "rrbot"), ("doctor", "rrbot"), ("tf", "rrbot/world", "rrbot/tool", "--once")],
    ids=lambda command: command[0],
)
def test_a_command_answers(fleet: None, command: tuple[str, ...]):
    ended = run_cli(*command)
    assert ended.code == 0, ended.stderr
    assert "rrbot" in ended.stdout


@pytest.mark.processes
@pytest.mark.parametrize(
    "command",
    [
        ("ls", "--watch"),
        ("monitor", "--robots", "--robot", "rrbot"),
        ("record", "FILE", "rrbot"),
        ("view", "--port", "PORT"),
    ],
    ids=lambda command: command[0],
)
def test_ctrl_c_ends_a_command(
    fleet: None, spawn: Spawn, tmp_path: Path, free_port: int, command: tuple[str, ...]
):
    values = {"FILE": str(tmp_path / "fleet.mcap"), "PORT": str(free_port)}
    child = started(spawn, *(values.get(word, word) for word in command))
    child.line(timeout_s=30.0)
    child.process.send_signal(signal.SIGINT)
    child.wait()


@pytest.mark.long
def test_doctor_examines_every_robot_of_a_large_fleet_though_most_are_silent(fleet: None):
    ended = run_cli("doctor", "--json")
    assert ended.code == 1, ended.stderr  # drivers are announced, and silent
    states: dict[str, set[str]] = {}
    for check in json.loads(ended.stdout)["checks"]:
        states.setdefault(check["robot"], set()).add(check["state"])
    silent = {f"r{number}" for number in range(ROBOTS)}
    assert states.keys() == {None, "rrbot", *silent}
    assert "broken" not in states["rrbot"]
    assert all("broken" in states[robot] for robot in silent)
