"""What the tests of commands have: a folder for stops, and a router in the place of rmw_zenohd."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.programs import router

from zstate.cli import session


@pytest.fixture(autouse=True)
def state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def ros_router(free_port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Where it listens; the commands of the test connect there, and speak to ROS."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with router(endpoint, ros2=True):
        monkeypatch.setenv("ZSTATE_CONNECT", endpoint)
        monkeypatch.setenv("ZSTATE_WIRE", "ros2")
        monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
        yield endpoint


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands of this process give up on routers and robots that are not there in a tenth of the time."""
    monkeypatch.setattr(session, "_ROUTER_WITHIN_S", 0.5)
    monkeypatch.setattr(session, "_LOCAL_ROUTER_WITHIN_S", 0.5)
    monkeypatch.setattr("zstate.view.cli._ANNOUNCED_WITHIN_S", 0.5)
