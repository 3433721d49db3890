"""Starting the processes of ``roles``, and asking them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from helpers.processes import DEADLINE_S, Child

SLACK = 3.0
"""A machine of CI is busy with other tests: what exceeds a stated bound by so much does not come back at all.

The figures are printed (``-rP``); hold them against the bounds where nothing else runs (``-n 0``).
"""

TESTS = str(Path(__file__).parents[1])
_CODE = (
    f"import sys; sys.path.insert(0, {TESTS!r}); from helpers import fault_programs; fault_programs.main()"
)


class FaultProcess:
    """A process of the suite."""

    def __init__(self, child: Child) -> None:
        self.child = child
        self.ready_at = 0

    def wait_ready(self) -> FaultProcess:
        assert self.child.line(30.0) == "ready", self.child.stderr
        self.ready_at = time.time_ns()
        return self

    def query(self, question: str, *arguments: Any, timeout_s: float = DEADLINE_S + 5.0) -> Any:
        self.send(question, *arguments)
        return self.receive(timeout_s)

    def send(self, question: str, *arguments: Any) -> None:
        self.child.send_line(json.dumps([question, *arguments]))

    def receive(self, timeout_s: float = DEADLINE_S + 5.0) -> Any:
        """The answer to a question that was told before."""
        return json.loads(self.child.line(timeout_s))

    def signal(self, number: int) -> None:
        self.child.process.send_signal(number)

    def kill(self) -> None:
        self.child.kill()


Start = Callable[..., FaultProcess]


def starter(spawn: Callable[..., Child]) -> Start:
    """``start(role, **options)``: a process that is ready; with ``wait=False`` perhaps not yet."""

    def start(role: str, *, wait: bool = True, **options: Any) -> FaultProcess:
        party = FaultProcess(spawn(_CODE, role, json.dumps(options)))
        return party.wait_ready() if wait else party

    return start


def client(*endpoints: str) -> dict[str, Any]:
    return {"mode": "client", "endpoints": endpoints}


def assert_no_growth(before: dict[str, int], after: dict[str, int], *, rss_kb: int = 30_000) -> None:
    """Nothing that a round of the fault leaves behind. Zenoh's pool of threads comes and goes by a few."""
    assert after["threads"] <= before["threads"] + 6, (before, after)
    assert after["fds"] <= before["fds"] + 3, (before, after)
    assert after["rss_kb"] <= before["rss_kb"] + rss_kb, (before, after)


def print_figures(title: str, seconds: list[float]) -> None:
    """What was measured, for `pytest -rP`."""
    ordered = sorted(seconds)
    print(
        f"{title}: median {ordered[len(ordered) // 2]:.3f} s, largest {ordered[-1]:.3f} s, of {len(ordered)}"
    )
