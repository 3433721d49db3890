from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.cli_runner import (
    ALL_STREAMS,
    RRBOT,
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_watched,
    started,
)
from helpers.processes import Child, until
from helpers.programs import router

from zstate import StatePublisher, StaticPublisher, Transform, connect, load_model
from zstate.cli.commands.wait import wait_command


def waited(*arguments: str, code: int) -> dict[str, object]:
    ended = run_cli("wait", *arguments, "--json")
    assert ended.code == code, ended.stderr
    return json.loads(ended.stdout)


def await_text(command: Command | Child, text: str) -> None:
    until(lambda: text in command.stderr)


def test_available_robot_is_ready_at_once():
    with published_robot():
        ended = run_cli("wait", "robot", "rrbot")
    assert (ended.code, ended.stdout) == (0, "ready: 'rrbot' (7 frames)\n")
    assert ended.stderr == ""


def test_a_robot_is_ready_when_it_moves_and_not_before():
    def move(command: Command) -> None:
        await_text(command, "robot 'rrbot' is not announced")
        with connect() as session, StatePublisher(session, load_model(RRBOT), streams=ALL_STREAMS[1:]):
            await_text(command, "joint_states of 'rrbot' has no writer")
            assert not command.is_over(0.0)
            with published_robot(streams=("joint_states",)):
                assert command.is_over()

    ended = run_watched(move, "wait", "robot", "rrbot", code=0)
    assert ended.stdout == "ready: 'rrbot' (7 frames)\n"


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


def test_a_router_may_come_late(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"

    def come(command: Command) -> None:
        await_text(command, f"waiting: no answer yet at '{endpoint}'")
        with router(endpoint):
            assert command.is_over()

    ended = run_watched(come, "wait", "router", endpoint, code=0)
    assert ended.stdout == f"ready: the router at '{endpoint}'\n"


def test_robot_behind_a_late_router_is_waited_for(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"

    def come(command: Command) -> None:
        await_text(command, f"waiting: no answer yet at '{endpoint}'")
        with router(endpoint), published_robot(router=endpoint):
            assert command.is_over()

    ended = run_watched(come, "wait", "robot", "rrbot", "--connect", endpoint, code=0)
    assert ended.stdout == "ready: 'rrbot' (7 frames)\n"


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
