"""The supervisor of `zstate up`, where its processes cannot show it."""

from __future__ import annotations

import signal
import sys
import threading
from typing import Any

import pytest
from helpers.processes import DEADLINE_S

from zstate.cli.processes import ChildProcess
from zstate.cli.up import supervisor
from zstate.cli.up.processes import ProcessSpec
from zstate.cli.up.supervisor import Supervisor

WAITS = (
    "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}); print('runs', flush=True); "
    "signal.sigwait({signal.SIGINT}); print('ends')"
)
"""A program that ends by Ctrl-C only, and says so."""


@pytest.mark.processes
def test_a_process_that_ctrl_c_meets_while_it_starts_is_ended_in_order(monkeypatch: pytest.MonkeyPatch):
    started: list[ChildProcess] = []
    lines: list[str] = []
    runs = threading.Event()

    def on_line(name: str, line: str, is_error: bool) -> None:
        lines.append(line)
        runs.set()

    class Interrupted(ChildProcess):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(self)
            assert runs.wait(DEADLINE_S)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(supervisor, "ChildProcess", Interrupted)
    spec = ProcessSpec("program", (sys.executable, "-c", WAITS), is_program=True)
    with pytest.raises(KeyboardInterrupt):
        Supervisor([spec], on_line).run()
    assert started[0].exit_code == 0
    assert lines == ["runs", "ends"]
