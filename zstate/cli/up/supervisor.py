"""Supervisor: starts processes in order of their dependencies, restarts them, and ends them in order."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Sequence
from typing import Literal

from zstate.cli.output.console import print_status
from zstate.cli.processes import END_WITHIN_S, ChildProcess
from zstate.cli.signals import deferred_signals
from zstate.cli.up.processes import ProcessSpec
from zstate.clock import LONGEST_WAIT_S

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
_REPORT_AFTER_S = 5.0

# Exit codes of a program that was asked to end: one of the user's need not catch Ctrl-C.
_REQUESTED_EXIT_CODES = (0, 130, 143, -2, -15)


class ManagedProcess:
    """One process, over all its restarts; times are those of ``time.monotonic`` [s]."""

    def __init__(self, spec: ProcessSpec) -> None:
        self.spec = spec
        self.child: ChildProcess | None = None
        self.is_ready = False
        self.is_over = False
        self.due = time.monotonic()
        self.started = 0.0
        self._pause_s = FIRST_PAUSE_S

    def pause(self) -> float:
        """Set the time of the restart and return the pause [s], which doubles after each short run."""
        if time.monotonic() - self.started > LONGEST_PAUSE_S:
            self._pause_s = FIRST_PAUSE_S
        pause_s, self._pause_s = self._pause_s, min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        self.child, self.due = None, time.monotonic() + pause_s
        return pause_s


class Supervisor:
    """Runs processes until all have ended, or one has failed for good.

    ``on_line(name, line, is_error)`` is called from several threads.
    """

    def __init__(self, specs: Sequence[ProcessSpec], on_line: Callable[[str, str, bool], None]) -> None:
        self._processes = {spec.name: ManagedProcess(spec) for spec in specs}
        self._on_line = on_line
        self._events: queue.SimpleQueue[tuple[Literal["ready", "end"], ManagedProcess]] = queue.SimpleQueue()
        self._is_ending = False

    def run(self) -> str:
        """Run to the end and return the failure of a process, or "" if all have succeeded."""
        failure = ""
        report_at = time.monotonic() + _REPORT_AFTER_S
        try:
            while not failure and not all(process.is_over for process in self._processes.values()):
                for process in self._processes.values():
                    is_due = process.child is None and not process.is_over and time.monotonic() >= process.due
                    if is_due and not self._not_ready(process):
                        with deferred_signals():  # _end_all ends a process that has started
                            process.child, process.started = self._start(process), time.monotonic()
                        process.is_ready = process.is_ready or process.spec.ready is None
                failure = self._next_event()
                if time.monotonic() > report_at:
                    report_at = float("inf")
                    for process in self._processes.values():
                        awaited = ", ".join(map(repr, self._not_ready(process)))
                        if process.child is None and awaited:
                            print_status(f"{process.spec.name!r} waits for {awaited}, not ready yet")
        finally:
            self._end_all()
        return failure

    def _start(self, process: ManagedProcess) -> ChildProcess:
        spec = process.spec

        def on_line(line: str, is_error: bool) -> None:
            if not (self._is_ending and is_error and spec.is_program):
                self._on_line(spec.name, line, is_error)
            # Without a text for readiness any result will do: progress goes to standard error.
            if spec.ready is not None and (spec.ready in line if spec.ready else not is_error):
                self._events.put(("ready", process))

        return ChildProcess(
            spec.name,
            spec.arguments,
            on_end=lambda _: self._events.put(("end", process)),
            on_line=on_line,
            is_program=spec.is_program,
            folder=spec.folder,
            environment=spec.environment,
        )

    def _not_ready(self, process: ManagedProcess) -> list[str]:
        return [name for name in process.spec.after if not self._processes[name].is_ready]

    def _next_event(self) -> str:
        """Wait for the next event or restart; the text of a failure that ends everything, else ""."""
        pauses_s = [one.due - time.monotonic() for one in self._processes.values() if one.child is None]
        try:
            within_s = min([LONGEST_WAIT_S, *(pause_s for pause_s in pauses_s if pause_s > 0.0)])
            event, process = self._events.get(timeout=within_s)
        except queue.Empty:
            return ""
        if event == "ready":
            process.is_ready = True
            return ""
        child, restart = process.child, process.spec.restart
        assert child is not None
        has_failed = child.exit_code != 0
        if restart == "always" or (restart == "on-failure" and has_failed):
            text = f"{_end_text(child)}; it starts again in {process.pause():g} s"
            print_status(text, event="restart", level="warning")
        elif has_failed:
            return _end_text(child)
        else:
            process.is_over = process.is_ready = True
        return ""

    def _end_all(self) -> None:
        """End every process before those that it depends on; independent ones end together."""
        self._is_ending = True
        running = {
            process.spec.name: (process.spec, process.child)
            for process in self._processes.values()
            if process.child and process.child.exit_code is None
        }
        while running:
            needed = {name for spec, _ in running.values() for name in spec.after}
            ending = [running[name] for name in running if name not in needed]
            for _, child in ending:
                child.request_exit()
            deadline = time.monotonic() + END_WITHIN_S
            for spec, child in ending:
                child.wait(deadline)
                if spec.is_program and child.exit_code not in _REQUESTED_EXIT_CODES:
                    print_status(_end_text(child))
                del running[spec.name]


def _end_text(child: ChildProcess) -> str:
    return (
        f"{child.name!r} ended with exit code {child.exit_code}: {child.last_error or 'it printed no error'}"
    )
