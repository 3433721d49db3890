"""Fixtures for tests with ROS 1: a master for each file, and processes that use it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator

import pytest
from helpers.processes import Child
from helpers.ros1_processes import (
    BRIDGE,
    DEBIAN_PYTHON,
    ROS_PEER,
    TF2_LISTENER,
    Roscore,
    RosPeer,
    Spawn,
    ros_environment,
)

IN_DEBIAN = "import os, sys; os.execv(sys.argv[1], [sys.argv[1], '-u', '-c', *sys.argv[2:]])"


@pytest.fixture(scope="module")
def roscore(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment variables that lead to a master."""
    environment = ros_environment(tmp_path_factory.mktemp("ros"))
    core = Roscore(environment)
    yield environment
    core.close()


@pytest.fixture
def namespace(
    roscore: dict[str, str], monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> str:
    """The namespace, one for each test, of processes started in this test."""
    for name, value in roscore.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("ROS_NAMESPACE", f"/{request.node.name}")
    return f"/{request.node.name}"


def ready(spawn: Spawn, code: str, *arguments: str) -> Child:
    """A ready node that runs ``code`` with Debian's Python."""
    child = spawn(IN_DEBIAN, DEBIAN_PYTHON, textwrap.dedent(code), *arguments)
    assert child.line() == "ready", child.stderr
    return child


@pytest.fixture
def peer(namespace: str, spawn: Spawn) -> Callable[..., RosPeer]:
    """``peer()`` is a publisher node, ``peer("subscribe")`` also subscribes."""
    return lambda *arguments: RosPeer(ready(spawn, ROS_PEER, *arguments))


@pytest.fixture
def tf2_listener(namespace: str, spawn: Spawn) -> Callable[[], RosPeer]:
    """``tf2_listener().query(target, source, stamp, wait_s)`` looks up with the real tf2_ros."""
    return lambda: RosPeer(ready(spawn, TF2_LISTENER))


@pytest.fixture
def program(namespace: str, spawn: Spawn) -> Callable[..., Child]:
    """``program(path, *arguments)`` starts a program of ROS."""
    return lambda *command: spawn("import os, sys; os.execv(sys.argv[1], sys.argv[1:])", *command)


@pytest.fixture
def bridge(namespace: str, spawn: Spawn) -> Callable[..., Child]:
    """``bridge(*arguments)`` starts ``zstate ros1 rrbot ...`` and waits until it bridges."""

    def start(*arguments: str) -> Child:
        child = spawn(BRIDGE, "ros1", "rrbot", *arguments)
        assert child.line().startswith("bridging 'rrbot'"), child.stderr
        return child

    return start
