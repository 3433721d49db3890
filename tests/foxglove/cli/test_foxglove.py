"""zstate foxglove as a process: its address, its events, and what it refuses."""

from __future__ import annotations

import re

import pytest
from helpers.cli_runner import (
    ELBOW,
    SHOULDER,
    Spawn,
    failure,
    interrupted,
    missing_library,
    published_robot,
    run_until,
    started,
)
from helpers.foxglove_client import FoxgloveClient
from helpers.processes import until

from zstate.web_access import listen


@pytest.mark.processes
def test_a_client_receives_a_robot_until_ctrl_c(spawn: Spawn):
    command = started(spawn, "foxglove", "rrbot", "--port", "0")
    found = re.fullmatch(r"Foxglove can connect to (ws://127\.0\.0\.1:\d+)", command.line())
    assert found
    until(lambda: "waiting: robot 'rrbot' is not announced" in command.stderr)
    with published_robot("rrbot"), FoxgloveClient(found[1]) as client:
        client.subscribe("/joint_states")
        client.until(lambda: client.frames.get("/joint_states"))
        assert client.messages("/joint_states")[0].position == [SHOULDER, ELBOW]
        until(lambda: "robot 'rrbot' is served" in command.stderr)
    until(lambda: "robot 'rrbot' is gone" in command.stderr and " disconnected" in command.stderr)
    with FoxgloveClient(found[1]):
        interrupted(command)


def test_other_hosts_are_served_with_a_token_that_is_printed():
    warning = "anyone with this address can read the robots; it is sent unencrypted"
    ended, _ = run_until(lambda: True, "foxglove", "--host", "0.0.0.0", "--port", "0", after=warning)
    assert re.fullmatch(r"Foxglove can connect to ws://[^/]+:\d+/\?token=[\w-]{20,}\n", ended.stdout)


def test_hosts_ports_and_names_that_cannot_be_used_are_refused():
    with listen("127.0.0.1", 0, 0) as taken:
        port = taken.getsockname()[1]
        text = f"port {port} is taken at '127.0.0.1'; name a free one with --port, or 0 for any"
        assert text in failure("foxglove", "--port", str(port))
    assert "cannot listen at '192.0.2.1', port 0" in failure("foxglove", "--host", "192.0.2.1", "--port", "0")
    assert "the robot name 'a/b' contains '/'" in failure("foxglove", "a/b", "--port", "0")


def test_missing_websockets_error_names_the_extra_to_install():
    with missing_library("websockets"):
        assert "pip install 'zstate[foxglove]'" in failure("foxglove")
