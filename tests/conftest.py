"""Fixtures of every test: its own rendezvous, free ports, sessions and child processes that end with it."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from helpers.processes import Child, find_free_port, until
from hypothesis import settings

from zstate.net.session import Session, connect

if TYPE_CHECKING:
    from zstate.driving import DriverHost

# bench/ is not in the package, so it is imported from the repository. The path is appended: the tests use an
# installed zstate if there is one.
ROOT = str(Path(__file__).parents[1])
if ROOT not in sys.path:
    sys.path.append(ROOT)


# An example may take any time: on a busy machine one takes seconds.
settings.register_profile("zstate", deadline=None)
settings.load_profile("zstate")


@pytest.fixture
def free_port() -> int:
    return find_free_port()


@pytest.fixture(autouse=True)
def rendezvous(monkeypatch: pytest.MonkeyPatch) -> str:
    """A rendezvous address for this test and its processes, which isolates them from all others."""
    address = f"127.0.0.1:{find_free_port()}"
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", address)
    for variable in ("ZENOH_CONFIG", "ZSTATE_MODE", "ZSTATE_CONNECT", "ZSTATE_LISTEN", "ZSTATE_CONFIG"):
        monkeypatch.delenv(variable, raising=False)
    return address


@pytest.fixture
def sessions() -> Iterator[tuple[Session, Session]]:
    """A session for publishers and a session for readers."""
    with connect() as writer, connect() as reader:
        yield writer, reader


@pytest.fixture
def host_driver(
    sessions: tuple[Session, Session], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., DriverHost]]:
    """``host_driver()`` runs the driver of the robot "arm" until the end of the test.

    It is a simulated rrbot whose joints are at their setpoints, with 2 rad/s at most. ``options`` are those
    of DriverHost. Stops are kept in a folder of the test.
    """
    from helpers.robots import RRBOT

    from zstate.driving import DriverHost, Limits, SimulatedDriver

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    limits = Limits.of(RRBOT, velocity=2.0, acceleration=float("inf"))
    with ExitStack() as opened:

        def hosted(**options: Any) -> DriverHost:
            driver = SimulatedDriver(RRBOT, "mirror")
            options = {"rate_hz": 100.0, "limits": limits, "program": "driver", **options}
            host = opened.enter_context(DriverHost(sessions[0], driver, RRBOT, "arm", **options))
            thread = threading.Thread(target=host.run)
            thread.start()
            opened.callback(thread.join)
            opened.callback(host.close)
            until(lambda: host.state == "ready")
            return host

        yield hosted


@pytest.fixture
def spawn() -> Iterator[Callable[..., Child]]:
    """``spawn(code, *arguments)`` starts a Child, which is killed at the end of the test."""
    children: list[Child] = []

    def start(code: str, *arguments: str) -> Child:
        children.append(Child(code, *arguments))
        return children[-1]

    yield start
    for child in children:
        child.kill()
        child.wait()
