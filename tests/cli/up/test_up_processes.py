"""The keys of the file of `zstate up`: the options, variables and order that they become."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, failure, run_cli

from zstate import Transform
from zstate.cli.up.cell import read_cell
from zstate.cli.up.processes import ProcessSpec, plan_processes
from zstate.scans import Grid

ROBOT = f"[[robot]]\nmodel = '{RRBOT}'\n"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the file, which is not that of the command."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    Grid([[0, 100]], 0.1, (0.0, 0.0, 0.0)).save(tmp_path / "hall.yaml")
    (tmp_path / "certs").mkdir()
    for name in ("secret.txt", "users.txt", "acl.toml", "zenoh.json5"):
        (tmp_path / name).touch()
    return tmp_path


def written(folder: Path, text: str) -> Path:
    file = folder / "cell.toml"
    file.write_text(text)
    return file


def commands(folder: Path, text: str) -> dict[str, str]:
    """What ``--check`` prints: the command of each process by its name."""
    shown = run_cli("up", str(written(folder, text)), "--check")
    assert shown.code == 0, shown.stderr
    return {name: " ".join(words) for name, *words in map(str.split, shown.stdout.splitlines())}


def planned(folder: Path, text: str) -> dict[str, ProcessSpec]:
    file = written(folder, text)
    return {spec.name: spec for spec in plan_processes(read_cell(str(file), {}), file, {})}


def test_user_and_certificates_of_the_network_are_options_of_every_command(folder: Path):
    network = (
        "[network]\nmode = 'client'\nconnect = ['tls/10.0.0.1:7447']\ncerts = 'certs'\nidentity = 'cell'\n"
        "user = 'alice'\npassword_file = 'secret.txt'\n"
    )
    robots = ROBOT + ROBOT + "name = 'other'\nidentity = 'arm'\n"
    found = commands(folder, network + robots + "[[map]]\nfile = 'hall.yaml'\n")
    options = (
        f"--mode client --connect tls/10.0.0.1:7447 --certs {folder}/certs --identity {{}} --user alice "
        f"--password-file {folder}/secret.txt"
    )
    assert found == {
        "rrbot": f"zstate publish {RRBOT} {options.format('cell')}",
        "other": f"zstate publish {RRBOT} --name other {options.format('arm')}",
        "hall/map": f"zstate map {folder}/hall.yaml {options.format('cell')}",
    }


def test_a_zenoh_configuration_takes_the_place_of_the_router_of_the_file(folder: Path):
    router = "[router]\nlisten = ['tcp/0.0.0.0:7001']\n"
    joined = commands(folder, router + ROBOT)["rrbot"]
    assert joined.endswith("--mode client --connect tcp/127.0.0.1:7001")
    configured = commands(folder, router + "[network]\nconfig = 'zenoh.json5'\n" + ROBOT)["rrbot"]
    assert configured == f"zstate publish {RRBOT} --config {folder}/zenoh.json5"


def test_keys_of_the_router_are_options_of_its_command_only(folder: Path):
    router = (
        "[router]\nlisten = ['tls/0.0.0.0:7001', 'tcp/127.0.0.1:7002']\nconnect = ['tls/10.0.0.2:7447']\n"
        "certs = 'certs'\nidentity = 'router'\nuser = 'hall'\npassword_file = 'secret.txt'\n"
        "acl = 'acl.toml'\nusers = 'users.txt'\nmetrics = 9100\nros2 = true\n"
    )
    found = commands(folder, router + ROBOT)
    words = found["router"].split()
    assert words[:2] == ["zstate", "router"]
    words.remove("--ros2")
    options = sorted(zip(words[2::2], words[3::2], strict=True))
    assert options == [
        ("--acl", f"{folder}/acl.toml"),
        ("--certs", f"{folder}/certs"),
        ("--connect", "tls/10.0.0.2:7447"),
        ("--identity", "router"),
        ("--listen", "tcp/127.0.0.1:7002"),
        ("--listen", "tls/0.0.0.0:7001"),
        ("--metrics", "9100"),
        ("--password-file", f"{folder}/secret.txt"),
        ("--user", "hall"),
        ("--users", f"{folder}/users.txt"),
    ]
    assert found["rrbot"].endswith("--mode client --connect tls/127.0.0.1:7001")


def test_the_router_of_a_site_thins_the_robots_of_the_file_and_serves_them_without_certificates(folder: Path):
    router = (
        "[router]\nsite = 'plant1'\nuplink = ['tls/10.0.0.2:7447']\ncerts = 'certs'\nidentity = 'plant1'\n"
        "thin = { joint_states = 5, tf = 0 }\n"
    )
    found = commands(folder, router + ROBOT)
    assert found["router"].endswith(
        "--listen tcp/127.0.0.1:7447 --site plant1 --uplink tls/10.0.0.2:7447 --thin joint_states=5 "
        f"--thin tf=0 --robot rrbot --certs {folder / 'certs'} --identity plant1"
    )
    assert "--connect tcp/127.0.0.1:7447" in found["rrbot"]
    assert "--robot r9" in commands(folder, router + "robot = ['r9']\n" + ROBOT)["router"]


def test_a_router_with_certificates_listens_with_tls_by_default(folder: Path):
    assert "--listen tcp/127.0.0.1:7447" in commands(folder, "[router]\n")["router"]
    assert "--listen tls/127.0.0.1:7447" in commands(folder, "[router]\ncerts = 'certs'\n")["router"]


def test_xacro_arguments_and_the_clock_of_a_robot_are_options(folder: Path):
    (folder / "arm.urdf.xacro").write_text(
        '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="$(arg side)_base"/>'
        '<xacro:arg name="side" default="left"/><xacro:arg name="tool" default="false"/></robot>'
    )
    robot = "[[robot]]\nmodel = 'arm.urdf.xacro'\nclock = 'sim'\nxacro_args = {side = 'right', tool = true}\n"
    assert commands(folder, robot) == {
        "arm": f"zstate publish {folder}/arm.urdf.xacro side:=right tool:=true --clock sim"
    }


@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        ("rpy = [0.1, 0.2, 0.3]", Transform.from_rpy("tool", "eye", (0.0, 0.0, 0.0), (0.1, 0.2, 0.3))),
        (
            "xyz = [1, 2, 3]\nrpy = [0.1, 0.2, 0.3]",
            Transform.from_rpy("tool", "eye", (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)),
        ),
        ("quat_xyzw = [0.0, 0.0, 0.6, 0.8]", Transform("tool", "eye", (0.0, 0.0, 0.0), (0.0, 0.0, 0.6, 0.8))),
        (
            "xyz = [1, 2, 3]\nquat_xyzw = [0.0, 0.0, 0.6, 0.8]",
            Transform("tool", "eye", (1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8)),
        ),
    ],
)
def test_an_edge_has_its_rotation_in_radians_or_as_a_quaternion(folder: Path, pose: str, expected: Transform):
    text = ROBOT + f"[[static]]\ntarget = 'tool'\nsource = 'eye'\n{pose}\n"
    (table,) = read_cell(str(written(folder, text)), {}).static
    assert table.section.transform() == expected


def test_two_rotations_of_an_edge_are_refused(folder: Path):
    text = ROBOT + "[[static]]\ntarget = 'tool'\nsource = 'eye'\nrpy = [0, 0, 1]\nquat_xyzw = [0, 0, 0, 1]\n"
    message = failure("up", str(written(folder, text)), "--check")
    assert "the pose of 'eye' in 'tool' has 2 rotations" in message


def test_an_angle_that_is_too_large_for_radians_is_refused_with_the_key_for_degrees(folder: Path):
    text = ROBOT + "[[static]]\ntarget = 'tool'\nsource = 'eye'\nrpy = [0, 0, 90]\n"
    message = failure("up", str(written(folder, text)), "--check")
    assert "to give degrees use --rpy-deg 0 0 90 (in a file: rpy_deg)" in message


def test_maps_and_scanners_start_after_what_they_name_and_are_started_again_as_they_say(folder: Path):
    scan = "[[scan]]\nrobot = 'rrbot'\nframe = 'base'\ndummy = true\n"
    specs = planned(
        folder,
        "[router]\nrestart = 'on-failure'\n"
        + ROBOT
        + "[[map]]\nfile = 'hall.yaml'\nafter = 'rrbot'\nrestart = 'always'\n"
        + f"{scan}after = ['hall/map', 'rrbot']\nrestart = 'on-failure'\n"
        + "wires = ['native', 'ros2']\nmetrics = '127.0.0.1:9101'\n",
    )
    assert {name: (spec.after, spec.restart) for name, spec in specs.items()} == {
        "router": ((), "on-failure"),
        "rrbot": (("router",), "never"),
        "hall/map": (("router", "rrbot"), "always"),
        "rrbot/scan": (("router", "hall/map", "rrbot"), "on-failure"),
    }
    words = " ".join(specs["rrbot/scan"].arguments)
    assert "--wire native --wire ros2 --metrics 127.0.0.1:9101" in words


def test_variables_of_a_program_are_those_of_its_table_before_those_of_the_network(folder: Path):
    network = (
        "[network]\nmode = 'client'\nconnect = ['tcp/10.0.0.1:1', 'tcp/10.0.0.2:2']\nuser = 'alice'\n"
        "password_file = 'secret.txt'\n"
    )
    program = (
        "[[program]]\nrun = 'python driver.py'\n"
        "environment = {GAIN = 0.5, TRIES = 3, SERIAL = '/dev/arm', ZSTATE_USER = 'bob'}\n"
    )
    driver = planned(folder, network + program)["driver"]
    assert driver.is_program
    assert driver.folder == str(folder)
    assert driver.environment == {
        "ZSTATE_MODE": "client",
        "ZSTATE_USER": "bob",
        "ZSTATE_PASSWORD_FILE": f"{folder}/secret.txt",
        "ZSTATE_CONNECT": "tcp/10.0.0.1:1 tcp/10.0.0.2:2",
        "GAIN": "0.5",
        "TRIES": "3",
        "SERIAL": "/dev/arm",
    }


def test_a_table_is_the_command_of_its_name(folder: Path):
    (folder / "arm.urdf").write_text(Path(RRBOT).read_text())
    (folder / "arm.py").touch()
    found = commands(
        folder,
        "[[drive]]\ndriver = 'arm.py:Arm'\nrobot = 'arm.urdf'\n"
        "param = {gain = 0.5, port = '/dev/x', on = true}\n"
        "velocities = ['shoulder=1', 2.0]\non-silence = 'relax'\nttl = 0.1\n"
        "[[odometry]]\nrobot = 'r1'\ninitial_pose = [1, 2.5, 90]\nreset = false\n"
        "[[record]]\nrobots = ['r1', 'r2']\nsplit_size = 10\n"
        "[[transform]]\nname = 'marker'\ntarget = 'map'\nsource = 'marker'\nxyz = [1, 0, 0]\n",
    )
    assert found == {
        "arm/drive": f"zstate drive arm.py:Arm {folder}/arm.urdf --param gain=0.5 --param port=/dev/x "
        "--param on=true --ttl 0.1 --on-silence relax --velocity shoulder=1 --velocity 2.0",
        "r1/odometry": "zstate odometry r1 --initial-pose 1 2.5 90",
        "record": "zstate record rec-%Y%m%d-%H%M%S.mcap r1 r2 --split-size 10",
        "marker/transform": "zstate transform map marker --xyz 1 0 0",
    }


def test_a_command_without_session_options_finds_the_network_in_its_environment(folder: Path):
    text = "[router]\n[[info]]\nfile = 'run.mcap'\nenvironment = {LINES = 3}\n"
    assert planned(folder, text)["info"].environment == {
        "ZSTATE_MODE": "client",
        "ZSTATE_CONNECT": "tcp/127.0.0.1:7447",
        "LINES": "3",
    }


def test_each_process_of_a_loop_has_the_next_port_for_its_metrics(folder: Path):
    text = "[[scan]]\nnames = 'a b'\nrobot = '${name}'\nframe = 'f'\ndummy = true\nmetrics = 9100\n"
    ports = {name: words.split()[-1] for name, words in commands(folder, text).items()}
    assert ports == {"a/scan": "9100", "b/scan": "127.0.0.1:9101"}
