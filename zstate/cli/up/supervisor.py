"""Supervisor: starts processes in order, starts them again where that is wanted, and ends them in order."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Sequence
from typing import Literal

from zstate.cli.output.console import print_status
from zstate.cli.processes import END_WITHIN_S, ChildProcess
from zstate.cli.up.starts import Start
from zstate.clock import LONGEST_WAIT_S

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 30.0
_PATIENCE_S = 5.0

# What a program ends with that was asked to: the user's own need not catch Ctrl-C.
_ENDED_AS_ASKED = (0, 130, 143, -2, -15)


class Part:
    """One process of several, through all its lives."""

    def __init__(self, start: Start) -> None:
        self.start = start
        self.child: ChildProcess | None = None
        self.is_ready = False
        self.is_over = False
        self.due = time.monotonic()
        self._began = 0.0
        self._pause_s = FIRST_PAUSE_S

    def begin(self, child: ChildProcess) -> None:
        """It lives again."""
        self.child, self._began = child, time.monotonic()
        self.is_ready = self.is_ready or self.start.ready is None

    def pause(self) -> float:
        """How long to wait before its next life [s]: twice as long each time it lived but shortly."""
        if time.monotonic() - self._began > LONGEST_PAUSE_S:
            self._pause_s = FIRST_PAUSE_S
        pause_s, self._pause_s = self._pause_s, min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        self.child, self.due = None, time.monotonic() + pause_s
        return pause_s


class Supervisor:
    """Runs ``starts`` until all have ended, or one has failed for good.

    ``on_line(name, line, is_error)`` is called from several threads.
    """

    def __init__(self, starts: Sequence[Start], on_line: Callable[[str, str, bool], None]) -> None:
        self._parts = {start.name: Part(start) for start in starts}
        self._on_line = on_line
        self._events: queue.SimpleQueue[tuple[Literal["ready", "end"], Part]] = queue.SimpleQueue()
        self._is_ending = False

    def run(self) -> str:
        """Why it ended: the failure of a part, or "" when all have done what they were to do."""
        failure = ""
        impatient_at = time.monotonic() + _PATIENCE_S
        try:
            while not failure and not all(part.is_over for part in self._parts.values()):
                self._start_due()
                failure = self._take_event()
                if time.monotonic() > impatient_at:
                    impatient_at = float("inf")
                    self._name_the_waiting()
        finally:
            self._end_all()
        return failure

    def _start_due(self) -> None:
        for part in self._parts.values():
            is_due = part.child is None and not part.is_over and time.monotonic() >= part.due
            if is_due and not self._awaited(part):
                part.begin(self._child(part))

    def _child(self, part: Part) -> ChildProcess:
        start = part.start

        def on_line(line: str, is_error: bool) -> None:
            if not (self._is_ending and is_error and start.is_program):
                self._on_line(start.name, line, is_error)
            # Without a text of its own any result is the sign: what goes on is told on standard error.
            if start.ready is not None and (start.ready in line if start.ready else not is_error):
                self._events.put(("ready", part))

        return ChildProcess(
            start.name,
            start.arguments,
            on_end=lambda _: self._events.put(("end", part)),
            on_line=on_line,
            is_program=start.is_program,
            folder=start.folder,
            environment=start.environment,
        )

    def _awaited(self, part: Part) -> list[str]:
        return [name for name in part.start.after if not self._parts[name].is_ready]

    def _take_event(self) -> str:
        """What happens next, if it happens soon; the text of a failure that ends everything."""
        dues = [part.due - time.monotonic() for part in self._parts.values() if part.child is None]
        timeout_s = min([LONGEST_WAIT_S, *(due for due in dues if due > 0.0)])
        try:
            what, part = self._events.get(timeout=timeout_s)
        except queue.Empty:
            return ""
        if what == "end":
            return self._take_end(part)
        part.is_ready = True
        return ""

    def _take_end(self, part: Part) -> str:
        child, restart = part.child, part.start.restart
        assert child is not None
        is_well = child.exit_code == 0
        if restart == "always" or (restart == "on-failure" and not is_well):
            text = f"{_end_text(child)}; it starts again in {part.pause():g} s"
            print_status(text, event="restart", level="warning")
        elif is_well:
            part.is_over = part.is_ready = True
        else:
            return _end_text(child)
        return ""

    def _name_the_waiting(self) -> None:
        for part in self._parts.values():
            awaited = self._awaited(part)
            if part.child is None and awaited:
                print_status(f"{part.start.name!r} waits for {', '.join(map(repr, awaited))}, not ready yet")

    def _end_all(self) -> None:
        """Whoever started after another ends before it; those that may end together do."""
        self._is_ending = True
        living = [part for part in self._parts.values() if part.child and part.child.exit_code is None]
        while living:
            needed = {name for part in living for name in part.start.after}
            ending = [part for part in living if part.start.name not in needed]
            for part in ending:
                assert part.child is not None
                part.child.ask_to_end()
            deadline = time.monotonic() + END_WITHIN_S
            for part in ending:
                assert part.child is not None
                part.child.wait(deadline)
                if part.start.is_program and part.child.exit_code not in _ENDED_AS_ASKED:
                    print_status(_end_text(part.child))
            living = [part for part in living if part not in ending]


def _end_text(child: ChildProcess) -> str:
    return f"{child.name!r} ended with exit code {child.exit_code}: {child.last_error or 'it said nothing'}"
