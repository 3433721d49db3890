from __future__ import annotations

import os

import pytest
from helpers.cli_runner import Spawn, failure, published_robot, started

pytestmark = pytest.mark.processes

POSE = ("--xyz", "1", "0", "0")


@pytest.mark.parametrize("command", [("joints", "rrbot"), ("publish", "rrbot", "--source", "sine")])
def test_what_somebody_writes_already_is_written_with_takeover_only(spawn: Spawn, command):
    with published_robot():
        message = failure(*command)
        assert f"pid {os.getpid()}'" in message
        assert "joint_states of 'rrbot' already" in message
        assert "rrbot" in started(spawn, *command, "--takeover").line()


def test_an_edge_that_somebody_places_already_is_placed_with_takeover_only(spawn: Spawn):
    started(spawn, "static", "r/base", "r/camera", *POSE, "--writer", "mount").line()
    assert "as 'mount' of 'r'" in failure("static", "r/base", "r/camera", *POSE)
    assert "r/camera" in started(spawn, "static", "r/base", "r/camera", *POSE, "--takeover").line()
