"""Access control of a fleet with robots r1 and r2 and viewer desk, through the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, run_cli, started

from zstate import connect
from zstate.net.security.credentials import Credentials
from zstate.net.streams import StreamSubscriber
from zstate.wire.protocol import SerializedSample


@pytest.fixture
def router(spawn: Spawn, free_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The endpoint of the fleet's router; ZSTATE_PASSWORD is right for every user."""
    acl, users = tmp_path / "acl.json5", tmp_path / "users.txt"
    acl.write_text(run_cli("acl", "--robot", "r1", "--robot", "r2", "--viewer", "desk").stdout)
    users.write_text("r1:secret\nr2:secret\ndesk:secret\n")
    users.chmod(0o600)
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--listen", endpoint, "--acl", str(acl), "--users", str(users)).line()
    monkeypatch.setenv("ZSTATE_CONNECT", endpoint)
    monkeypatch.setenv("ZSTATE_PASSWORD", "secret")
    return endpoint


@pytest.mark.processes
def test_late_viewer_receives_the_poses_of_the_robot(spawn: Spawn, router: str):
    started(spawn, "publish", RRBOT, "--name", "r1", "--source", "sine", "--user", "r1").line()
    seen = run_cli("tf", "base", "lower", "--once", "--json", "--user", "desk")
    assert seen.code == 0, seen.stderr
    assert json.loads(seen.stdout)["target"] == "base"
    (robot,) = json.loads(run_cli("ls", "--json", "--user", "desk").stdout)
    assert robot["robot"] == "r1"


@pytest.mark.processes
@pytest.mark.parametrize("user", ["r2", "desk"])
def test_other_user_cannot_write_the_robot_and_the_error_names_the_reason(router: str, user: str):
    credentials = Credentials(user="desk", password="secret")
    received: list[SerializedSample] = []
    with connect(mode="client", endpoints=router, credentials=credentials) as session:
        subscriber = StreamSubscriber(session, "zstate/r1/**", received.extend)
        message = failure("publish", RRBOT, "--name", "r1", "--source", "sine", "--user", user)
        subscriber.close()
    assert f"the router does not let user '{user}' write as robot 'r1'" in message
    assert "`zstate acl --robot r1`" in message
    assert received == []


@pytest.mark.processes
def test_a_viewer_that_releases_stops_is_told_that_only_commanders_do(router: str):
    message = failure("stop", "r1", "--release", "--user", "desk")
    assert "Only commanders command a robot and release its stops" in message
    assert "`zstate acl --robot r1 --commander NAME`" in message


def test_invalid_names_are_refused():
    assert "cannot be the name of an identity" in failure("acl", "--robot", "a/b")
    assert "give at least one of --robot NAME" in failure("acl", code=2)


def test_a_placer_writes_static_edges_under_its_own_name():
    printed = run_cli("acl", "--robot", "r1", "--placer", "site").stdout
    assert "placers:     site" in printed
    assert '"zstate/site/tf_static/*"' in printed
    assert '"zstate/site/**"' not in printed


def test_a_file_without_access_control_is_refused(tmp_path: Path):
    file = tmp_path / "acl.json5"
    file.write_text("{}")
    assert "has no access_control" in failure("router", "--acl", str(file))


def test_access_control_without_authentication_is_refused(tmp_path: Path):
    file = tmp_path / "acl.json5"
    file.write_text(run_cli("acl", "--robot", "r1").stdout)
    assert "access control without certificates or users" in failure("router", "--acl", str(file))


def test_ros_robots_are_separated_by_namespaces():
    robots = ("--robot", "r1", "--robot", "r2")
    printed = run_cli("acl", *robots, "--wire", "native", "--wire", "ros2:domain=5,namespace=*").stdout
    for key in ("zstate/r1/**", "5/r1/**", "5/r1/**/@adv/**", "@ros2_lv/5/*/*/*/NN/*/%r2/**"):
        assert f'"{key}"' in printed
    assert "namespace=*" in failure("acl", *robots, "--wire", "ros2")
