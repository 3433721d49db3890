from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.cli_runner import (
    ALL_STREAMS,
    RRBOT,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    started,
)
from helpers.processes import Child, until

from zstate import StatePublisher, StaticPublisher, Transform, connect, load_model
from zstate.cli.commands.wait import wait_command


def waited(*arguments: str, code: int) -> dict[str, object]:
    ended = run_cli("wait", *arguments, "--json")
    assert ended.code == code, ended.stderr
    return json.loads(ended.stdout)


def await_text(child: Child, text: str) -> None:
    until(lambda: text in child.stderr)


def test_available_robot_is_ready_at_once():
    with published_robot():
        ended = run_cli("wait", "robot", "rrbot")
    assert (ended.code, ended.stdout) == (0, "ready: 'rrbot' (7 frames)\n")
    assert ended.stderr == ""


@pytest.mark.processes
def test_a_robot_is_ready_when_it_moves_and_not_before(spawn: Spawn):
    child = started(spawn, "wait", "robot", "rrbot")
    await_text(child, "robot 'rrbot' is not announced")
    with connect() as session, StatePublisher(session, load_model(RRBOT), streams=ALL_STREAMS[1:]):
        await_text(child, "joint_states of 'rrbot' has no writer")
        assert child.process.poll() is None
        with published_robot(streams=("joint_states",)):
            assert child.line() == "ready: 'rrbot' (7 frames)"
            assert child.wait() == 0


def test_every_named_robot_is_waited_for():
    with published_robot("left"):
        outcome = waited("robot", "left", "right", "--timeout", "1", code=1)
    assert outcome["ready"] is False
    assert "robot 'right' is not announced" in str(outcome["reason"])
    assert float(str(outcome["waited_s"])) >= 1.0


def test_robot_that_publishes_transforms_is_ready_without_joint_states():
    with published_robot(streams=("tf", "robot_description")):
        assert waited("robot", "rrbot", code=0)["ready"] is True


def test_a_robot_that_cannot_move_is_ready_with_its_model(tmp_path: Path):
    table = tmp_path / "table.urdf"
    table.write_text('<robot name="table"><link name="top"/></robot>')
    with connect() as session, StatePublisher(session, load_model(table)):
        assert waited("robot", "table", code=0)["ready"] is True


def test_a_pose_is_waited_for_with_the_reason():
    with published_robot():
        assert waited("frame", "base", "lower", code=0)["ready"] is True
        assert "did you mean 'lower'" in failure("wait", "frame", "base", "lwer", "--timeout", "0.6")


@pytest.mark.parametrize(("placer", "timeout", "code"), [("thief", "30", 0), ("site", "1", 1)])
def test_only_placers_place_the_root_of_the_robot_of_a_pose(placer: str, timeout: str, code: int):
    with published_robot(), connect() as session, StaticPublisher(session, "thief", "edges") as statics:
        statics.set(Transform("thief/x", "rrbot/world", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        outcome = waited(
            "frame", "thief/x", "rrbot/world", "--timeout", timeout, "--placer", placer, code=code
        )
    assert outcome["ready"] is (code == 0)


@pytest.mark.processes
def test_a_router_may_come_late(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = started(spawn, "wait", "router", endpoint)
    await_text(child, f"waiting: no answer yet at '{endpoint}'")
    started(spawn, "router", "--listen", endpoint)
    assert child.line() == f"ready: the router at '{endpoint}'"
    assert child.wait() == 0


@pytest.mark.processes
def test_robot_behind_a_late_router_is_waited_for(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = started(spawn, "wait", "robot", "rrbot", "--connect", endpoint)
    started(spawn, "router", "--listen", endpoint).line()
    with published_robot(router=endpoint):
        assert child.line() == "ready: 'rrbot' (7 frames)"


def test_missing_router_ends_the_wait_by_its_timeout_and_not_after_the_default_one(free_port: int):
    (default_s,) = (option.default for option in wait_command.params if option.name == "timeout")
    outcome = waited("router", f"tcp/127.0.0.1:{free_port}", "--timeout", "1", code=1)
    assert "nothing answers" in str(outcome["reason"])
    assert 1.0 <= float(str(outcome["waited_s"])) < default_s


@pytest.mark.processes
def test_ctrl_c_ends_a_wait(spawn: Spawn):
    child = started(spawn, "wait", "robot", "rrbot")
    await_text(child, "waiting:")
    interrupted(child)


def test_wait_arguments_are_checked():
    assert "name a robot" in failure("wait", "robot", code=2)
    assert "--placer is for `zstate wait frame" in failure("wait", "robot", "r1", "--placer", "site", code=2)
    assert "two frames" in failure("wait", "frame", "base", code=2)
    assert "'robto' is not one of" in failure("wait", "robto", code=2)
    assert "contains '/'" in failure("wait", "robot", "a/b")
