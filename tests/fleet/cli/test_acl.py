"""Access control of a fleet with robots r1 and r2 and viewer desk, through the command line."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, failure, run_cli
from helpers.processes import repeated
from helpers.programs import router

from zstate import StatePublisher, connect, load_model
from zstate.net.security.credentials import Credentials
from zstate.net.streams import StreamSubscriber
from zstate.wire.protocol import SerializedSample


@pytest.fixture
def fleet(free_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The endpoint of the fleet's router; ZSTATE_PASSWORD is right for every user."""
    acl, users = tmp_path / "acl.json5", tmp_path / "users.txt"
    acl.write_text(run_cli("acl", "--robot", "r1", "--robot", "r2", "--viewer", "desk").stdout)
    users.write_text("r1:secret\nr2:secret\ndesk:secret\n")
    users.chmod(0o600)
    with router(f"tcp/127.0.0.1:{free_port}", users=users, acl=acl) as endpoint:
        monkeypatch.setenv("ZSTATE_CONNECT", endpoint)
        monkeypatch.setenv("ZSTATE_PASSWORD", "secret")
        yield endpoint


def test_late_viewer_receives_the_poses_of_the_robot(fleet: str):
    with (
        connect(
            mode="client", endpoints=fleet, credentials=Credentials(user="r1", password="secret")
        ) as session,
        StatePublisher(session, load_model(RRBOT), "r1") as publisher,
        repeated(lambda: publisher.publish([0.0, 0.0])),
    ):
        seen = run_cli("tf", "base", "lower", "--once", "--json", "--user", "desk")
        (robot,) = json.loads(run_cli("ls", "--json", "--user", "desk").stdout)
    assert seen.code == 0, seen.stderr
    assert json.loads(seen.stdout)["target"] == "base"
    assert robot["robot"] == "r1"


@pytest.mark.parametrize("user", ["r2", "desk"])
def test_other_user_cannot_write_the_robot_and_the_error_names_the_reason(fleet: str, user: str):
    credentials = Credentials(user="desk", password="secret")
    received: list[SerializedSample] = []
    with connect(mode="client", endpoints=fleet, credentials=credentials) as session:
        subscriber = StreamSubscriber(session, "zstate/r1/**", received.extend)
        message = failure("publish", RRBOT, "--name", "r1", "--source", "sine", "--user", user)
        subscriber.close()
    assert f"the router does not let user '{user}' write as robot 'r1'" in message
    assert "`zstate acl --robot r1`" in message
    assert received == []


def test_a_viewer_that_releases_stops_is_told_that_only_commanders_do(fleet: str):
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
