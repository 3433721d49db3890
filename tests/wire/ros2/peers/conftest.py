"""Fixtures of the tests with other implementations: a router process, and a zstate session at it."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest
from peers import RUN, Peer, Spawn, interpreter, start_peer

from zstate.net.session import Session, connect


@pytest.fixture
def router(spawn: Spawn, free_port: int) -> str:
    """The endpoint of a router process."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = spawn(RUN, sys.executable, "-u", "-m", "zstate", "router", "--listen", endpoint)
    assert endpoint in child.line(), child.stderr
    return endpoint


@pytest.fixture
def session(router: str) -> Iterator[Session]:
    with connect(mode="client", endpoints=router) as session:
        yield session


@pytest.fixture
def peer(request: pytest.FixtureRequest, spawn: Spawn) -> Peer:
    """The peer that the test is parametrized with."""
    interpreter(request.param)  # skips before a router is started
    return start_peer(request.param, spawn, request.getfixturevalue("router"))
