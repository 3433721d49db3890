"""Starts the processes of fault_programs.py and sends them queries."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import Ended, run_cli
from helpers.processes import DEADLINE_S, Child, find_free_port

RECOVERED_WITHIN_S = 3.0
"""Below the 10 s after which Zenoh gives up a neighbour or repeats a query: beyond it, recovery has failed.

The figures themselves are printed (``-rP``), for an idle machine (``-n 0``).
"""

TESTS = str(Path(__file__).parents[1])
_CODE = (
    f"import sys; sys.path.insert(0, {TESTS!r}); from helpers import fault_programs; fault_programs.main()"
)


class FaultProcess:
    """A process of the fault suite, which replies to queries."""

    def __init__(self, child: Child) -> None:
        self.child = child
        self.ready_at = 0

    def wait_ready(self) -> FaultProcess:
        assert self.child.line(30.0) == "ready", self.child.stderr
        self.ready_at = time.time_ns()
        return self

    def query(self, name: str, *arguments: Any, timeout_s: float = DEADLINE_S + 5.0) -> Any:
        self.send(name, *arguments)
        return self.receive(timeout_s)

    def send(self, name: str, *arguments: Any) -> None:
        self.child.send_line(json.dumps([name, *arguments]))

    def receive(self, timeout_s: float = DEADLINE_S + 5.0) -> Any:
        """The reply to the oldest query without one."""
        return json.loads(self.child.line(timeout_s))

    def signal(self, number: int) -> None:
        self.child.process.send_signal(number)

    def freeze(self) -> None:
        self.child.freeze()

    def kill(self) -> None:
        self.child.kill()


Start = Callable[..., FaultProcess]


def starter(spawn: Callable[..., Child]) -> Start:
    """``start(role, **options)`` starts a process and, unless ``wait=False``, waits until it is ready."""

    def start(role: str, *, wait: bool = True, **options: Any) -> FaultProcess:
        process = FaultProcess(spawn(_CODE, role, json.dumps(options)))
        return process.wait_ready() if wait else process

    return start


def client(*endpoints: str) -> dict[str, Any]:
    return {"mode": "client", "endpoints": endpoints}


class Site:
    """A router with TLS and access control: the robots r1 and r2, and the viewer desk."""

    def __init__(self, folder: Path, start: Start) -> None:
        certificates = pytest.importorskip("zstate.fleet.certificates")
        certificates.issue_identities(folder, ["router", "r1", "r2", "desk", "stranger"])
        self.folder = folder
        self.endpoint = f"tls/127.0.0.1:{find_free_port()}"
        self._start = start
        self.router = self.start_router()

    def start_router(self) -> FaultProcess:
        roles = {"robots": ["r1", "r2"], "viewers": ["desk"]}
        certificates = (str(self.folder), "router")
        self.router = self._start("router", listen=self.endpoint, certificates=certificates, roles=roles)
        return self.router

    def join(self, identity: str) -> dict[str, Any]:
        return client(self.endpoint) | {"certificates": (str(self.folder), identity)}

    def doctor(self, identity: str, *arguments: str) -> Ended:
        certs = ("--certs", str(self.folder), "--identity", identity)
        return run_cli("doctor", "r1", "--connect", self.endpoint, *certs, "--timeout", "2", *arguments)


def assert_no_growth(before: dict[str, int], after: dict[str, int], *, rss_kb: int = 30_000) -> None:
    """Asserts that a round of the fault leaks no resources. Zenoh's thread pools vary by a few threads."""
    assert after["threads"] <= before["threads"] + 6, (before, after)
    assert after["fds"] <= before["fds"] + 3, (before, after)
    assert after["rss_kb"] <= before["rss_kb"] + rss_kb, (before, after)


def print_figures(title: str, seconds: list[float]) -> None:
    """Prints the median and the largest of the figures, for `pytest -rP`."""
    ordered = sorted(seconds)
    print(
        f"{title}: median {ordered[len(ordered) // 2]:.3f} s, largest {ordered[-1]:.3f} s, of {len(ordered)}"
    )
