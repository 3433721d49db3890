from __future__ import annotations

import os

import pytest
from helpers.cli_runner import Spawn, failure, published_robot, started

pytestmark = pytest.mark.processes

POSE = ("--xyz", "1", "0", "0")


@pytest.mark.parametrize("command", [("joints", "rrbot"), ("publish", "rrbot", "--source", "sine")])
def test_stream_with_a_writer_needs_takeover(spawn: Spawn, command):
    with published_robot():
        message = failure(*command)
        assert f"pid {os.getpid()}'" in message
        assert "already writes joint_states of 'rrbot'" in message
        assert "rrbot" in started(spawn, *command, "--takeover").line()


def test_static_edge_with_a_writer_needs_takeover(spawn: Spawn):
    started(spawn, "static", "r/base", "r/camera", *POSE, "--writer", "mount").line()
    assert "as 'mount' of 'r'" in failure("static", "r/base", "r/camera", *POSE)
    assert "r/camera" in started(spawn, "static", "r/base", "r/camera", *POSE, "--takeover").line()
