"""What the tests of commands have: a folder for stops, and a router in the place of rmw_zenohd."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, started


@pytest.fixture(autouse=True)
def state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def ros_router(spawn: Spawn, free_port: int, monkeypatch: pytest.MonkeyPatch) -> str:
    """Where it listens; the commands of the test connect there, and speak to ROS."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--ros2", "--listen", endpoint).line()
    monkeypatch.setenv("ZSTATE_CONNECT", endpoint)
    monkeypatch.setenv("ZSTATE_WIRE", "ros2")
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    return endpoint
