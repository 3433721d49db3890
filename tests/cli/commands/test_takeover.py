from __future__ import annotations

import os

import pytest
from helpers.cli_runner import failure, published_robot, run_cli, run_until

from zstate import StaticPublisher, Transform, connect

POSE = ("--xyz", "1", "0", "0")


@pytest.mark.parametrize("command", [("joints", "rrbot"), ("publish", "rrbot", "--source", "sine")])
def test_stream_with_a_writer_needs_takeover(command):
    with published_robot():
        message = failure(*command)
        assert f"pid {os.getpid()}'" in message
        assert "already writes joint_states of 'rrbot'" in message
        ended = run_cli(*command, "--takeover", "--seconds", "0.1")
    assert ended.code == 0, ended.stderr
    assert "rrbot" in ended.stdout.splitlines()[0]
    assert "; commanded 100 Hz" in ended.stdout


def test_static_edge_with_a_writer_needs_takeover():
    with connect() as session, StaticPublisher(session, "r", "mount") as mount:
        mount.set(Transform("base", "camera", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        assert "as 'mount' of 'r'" in failure("static", "r/base", "r/camera", *POSE)
        run_until(lambda: True, "static", "r/base", "r/camera", *POSE, "--takeover", after="r/camera")
