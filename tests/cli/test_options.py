from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, found_pose, run_cli, run_until, started

from zstate import StatePublisher, TransformListener, connect, load_model
from zstate.cli.options import load_robot, parse_models

ARM = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="prefix" default=""/>
  <link name="$(arg prefix)base"/><link name="$(arg prefix)tip"/>
  <joint name="$(arg prefix)lift" type="revolute">
    <parent link="$(arg prefix)base"/><child link="$(arg prefix)tip"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
</robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> str:
    """A xacro file with one argument."""
    pytest.importorskip("xacro")
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(ARM)
    return str(path)


def test_catalog_robot_has_its_catalog_name():
    assert load_robot("RRbot", None)[1] == "rrbot"
    assert load_robot(RRBOT, None)[1] == load_robot(RRBOT, None)[0].name
    assert load_robot("rrbot", "left")[1] == "left"


def test_xacro_arguments_belong_to_the_model_before_them():
    words = ("left.xacro", "prefix:=l_", "z:=a:=b", "panda", "right.xacro", "prefix:=")
    assert parse_models(words) == {
        "left.xacro": {"prefix": "l_", "z": "a:=b"},
        "panda": {},
        "right.xacro": {"prefix": ""},
    }


def test_check_takes_xacro_arguments(arm: str):
    assert json.loads(run_cli("check", arm, "--json").stdout)["root"] == "base"
    assert json.loads(run_cli("check", arm, "prefix:=left_", "--json").stdout)["root"] == "left_base"
    table = run_cli("check", arm, "prefx:=left_").stdout
    assert "the xacro argument 'prefx' is not used by the file; did you mean 'prefix'?" in table


@pytest.mark.parametrize("command", ["publish", "joints", "init", "demo", "check"])
def test_plain_urdf_takes_no_xacro_arguments(command: str):
    message = failure(command, RRBOT, "prefix:=left_")
    assert "contains no xacro, so it takes no xacro arguments; got prefix:=left_" in message


def test_an_argument_of_another_form_or_without_a_model_is_wrong_usage():
    assert "unexpected extra argument (prefix=left_)" in failure("publish", RRBOT, "prefix=left_", code=2)
    message = failure("init", "prefix:=left_", code=2)
    assert "'prefix:=left_' is a xacro argument; name the model before it" in message


def test_publish_expands_the_model_with_the_arguments(arm: str):
    with connect() as session, TransformListener(session, "arm") as listener:
        _, pose = run_until(
            lambda: found_pose(listener, "left_base", "left_tip"),
            *("publish", arm, "prefix:=left_", "--source", "sine"),
        )
    assert pose.kind != "static"


def test_joints_expand_the_model_with_the_arguments(arm: str):
    model = load_model(arm, xacro_args={"prefix": "left_"})
    with (
        connect() as session,
        StatePublisher(session, model, "arm", streams=("robot_description", "tf_static")),
        TransformListener(session, "arm") as listener,
    ):
        _, pose = run_until(
            lambda: found_pose(listener, "left_base", "left_tip"), "joints", arm, "prefix:=left_"
        )
    assert pose.kind != "static"


@pytest.mark.processes
def test_init_writes_the_arguments_and_up_publishes_with_them(spawn: Spawn, arm: str, tmp_path: Path):
    file = tmp_path / "cell.toml"
    assert run_cli("init", arm, "prefix:=left_", "-o", str(file)).code == 0
    assert re.search(r'^xacro_args = { "prefix" = "left_" }$', file.read_text(), re.MULTILINE)
    started(spawn, "up", str(file)).line()
    with connect() as session, TransformListener(session, "arm") as listener:
        listener.buffer.wait("left_base", "left_tip", timeout_s=10.0)


def test_up_refuses_xacro_arguments_for_a_plain_urdf(tmp_path: Path):
    file = tmp_path / "cell.toml"
    file.write_text('[[robot]]\nmodel = "rrbot"\nxacro_args = { prefix = "left_", lab = true }\n')
    message = failure("up", str(file), "--check")
    assert f"{file}:1: robot[0]: " in message
    assert "takes no xacro arguments; got prefix:=left_ lab:=true" in message
