from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.cli_runner import (
    ELBOW,
    RRBOT,
    SHOULDER,
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_watched,
    started,
)
from helpers.processes import until
from helpers.programs import router

from zstate import StaticPublisher, Transform, TransformListener, connect, discover, load_model
from zstate.cli.session import SessionOptions
from zstate.recording.cli.snapshot_file import (
    Configuration,
    RobotSnapshot,
    Snapshot,
    StaticTransformSnapshot,
    read_snapshot,
)

HERE = Configuration("1.0", "desk", "peer")
STATIC = StaticTransformSnapshot("arm", "tool.1", "lower", "came ra", (0.1, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8))


@pytest.mark.parametrize(
    "urdf",
    [
        "<robot name='a'>\n<link name='b'/>\n</robot>",
        "<robot name='a'>\r\n<link name='b'/></robot>",
        "<robot name='a'><!-- '''\n\\ \t\x7f é \U0001f916 --><link name='b'/></robot>",
    ],
)
@pytest.mark.parametrize(("text", "suffix"), [(Snapshot.as_toml, "toml"), (Snapshot.as_json, "json")])
def test_snapshot_file_round_trips(tmp_path: Path, urdf: str, text, suffix: str):
    positions = {"shoulder pan": 0.1, "base": (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0), 'a"b': -1e-9}
    arm = RobotSnapshot(name="arm", urdf=urdf, writers=("tf: driver",), stamp=17, positions=positions)
    shots = (arm, RobotSnapshot(name="other", urdf=urdf))
    snapshot = Snapshot(1, "2026-01-02T03:04:05+00:00", HERE, shots, (STATIC,))
    file = tmp_path / f"cell.{suffix}"
    file.write_text(text(snapshot), newline="")
    assert read_snapshot(file) == snapshot


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", "missing required field `format`"),
        (
            "format = 1\nsaved = 'x'\n[configuration]\nzstate = 1\n",
            "cell.toml:4: configuration.zstate: Expected",
        ),
        (
            "format = 2\nsaved = 'x'\n[configuration]\nzstate = '1'\nhost = 'h'\nmode = 'peer'\n",
            "its format is 2",
        ),
        ("format = \n", "is not TOML"),
    ],
)
def test_invalid_snapshot_error_names_the_place_in_the_file(tmp_path: Path, text: str, error: str):
    file = tmp_path / "cell.toml"
    file.write_text(text)
    assert error in failure("snapshot", "load", str(file))


@pytest.mark.parametrize("suffix", ["toml", "json"])
def test_loaded_robot_has_the_saved_poses(tmp_path: Path, suffix: str):
    file = tmp_path / f"cell.{suffix}"
    edge = Transform("lower", "camera", (0.0, 0.1, 0.2), (0.0, 0.0, 0.6, 0.8))
    with published_robot(), connect() as session, StaticPublisher(session, "rrbot", "calibration") as static:
        static.set(edge)
        saved = run_cli("snapshot", "save", str(file))
        assert saved.code == 0, saved.stderr
        assert "(1 robot, 1 static edge)" in saved.stderr
        with TransformListener(session, "rrbot") as listener:
            there = listener.buffer.wait("world", "camera", timeout_s=10.0)
    (shot,) = read_snapshot(file).robot
    assert shot.positions == {"shoulder": SHOULDER, "elbow": ELBOW}
    assert shot.model().digest == load_model(RRBOT).digest

    def look(command: Command) -> None:
        assert command.line().startswith("rrbot: its model, 2 joints standing still")
        with connect() as session, TransformListener(session, "rrbot") as listener:
            again = listener.buffer.wait("world", "camera", timeout_s=10.0)
            assert again.pose7 == pytest.approx(there.pose7)
            (info,) = discover(session)
            assert "calibration" in {name for name, _ in info.named("tf_static")}
            count = listener.stats.received
            until(lambda: listener.stats.received > count)

    run_watched(look, "snapshot", "load", str(file))


@pytest.mark.parametrize(
    ("saved", "options", "network"),
    [
        (HERE, "", SessionOptions()),
        (Configuration("1", "h", "peer", "ros2"), "--wire ros2", SessionOptions()),
        (
            Configuration("1", "h", "client", connect=("tcp/a:1",)),
            "--mode client --connect tcp/a:1",
            SessionOptions("client", ("tcp/a:1",)),
        ),
        (
            Configuration("1", "h", "peer", "native", ("tcp/a:1",), ("tcp/b:1",), "my file"),
            "--mode peer --connect tcp/a:1 --listen tcp/b:1 --config 'my file'",
            SessionOptions("peer", ("tcp/a:1",), ("tcp/b:1",), "my file"),
        ),
    ],
)
def test_saved_session_options_can_be_used_again(saved, options: str, network: SessionOptions):
    assert saved.options() == options
    assert saved.is_default == (not options)
    assert saved.network(SessionOptions()) == network
    elsewhere = saved.network(SessionOptions(connect=("tcp/c:1",)))
    assert (elsewhere.connect, elsewhere.listen) == (("tcp/c:1",), network.listen)


@pytest.mark.processes
def test_snapshot_is_loaded_on_this_host_unless_as_saved(spawn: Spawn, tmp_path: Path, free_port: int):
    file = tmp_path / "cell.toml"
    with router(f"tcp/127.0.0.1:{free_port}") as endpoint:
        with published_robot(router=endpoint):
            assert run_cli("snapshot", "save", str(file), "--connect", endpoint).code == 0
        here = run_cli("snapshot", "load", str(file), "--seconds", "0.1").stderr
        assert f"with --mode client --connect {endpoint}; --as-saved uses the same options" in here
        child = started(spawn, "snapshot", "load", str(file), "--as-saved")
        child.line()
        with connect(mode="client", endpoints=endpoint) as session:
            until(lambda: [info.name for info in discover(session)] == ["rrbot"])
        assert f": --mode client --connect {endpoint}" in child.stderr
        interrupted(child)


def test_only_the_named_robots_are_saved_and_loaded(tmp_path: Path):
    file = tmp_path / "cell.toml"
    with published_robot("left"), published_robot("right"):
        assert "left" in failure("snapshot", "save", str(file), "lef")
        assert run_cli("snapshot", "save", str(file), "left").code == 0
    assert [shot.name for shot in read_snapshot(file).robot] == ["left"]
    assert "has no robot 'right'; it has left" in failure("snapshot", "load", str(file), "right")


def test_robot_without_joint_states_is_saved_without_positions():
    with published_robot(streams=("robot_description", "tf_static")):
        saved = run_cli("snapshot", "save", "-")
    assert "positions" not in saved.stdout
    assert "[[robot]]" in saved.stdout


def test_a_file_that_exists_is_kept_unless_forced(tmp_path: Path):
    file = tmp_path / "cell.json"
    file.write_text("mine")
    assert "--force replaces it" in failure("snapshot", "save", str(file))
    with published_robot():
        assert run_cli("snapshot", "save", str(file), "--force").code == 0
    assert json.loads(file.read_text())["robot"][0]["name"] == "rrbot"


def test_empty_network_saves_no_file(tmp_path: Path):
    file = tmp_path / "cell.toml"
    failure("snapshot", "save", str(file))
    assert not file.exists()
