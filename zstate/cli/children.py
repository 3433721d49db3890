"""Other zstate commands as processes of this one: their lines, their end, and ours with theirs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence

from zstate.cli.logs import text_in
from zstate.closing import Closing

END_WITHIN_S = 0.8


class ChildCommand(Closing):
    """``zstate ARGUMENTS`` in a process of its own, which ends with this one, however that ends.

    Each line it says goes to ``on_line``, from a thread; ``on_end`` is called once it is gone and all
    its lines are heard. ``last_error`` is what it said last on its standard error.
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[str],
        *,
        on_end: Callable[[ChildCommand], None],
        on_line: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.name = name
        self.last_error = ""
        # A session of its own: Ctrl-C at the terminal reaches this process alone, which ends the others.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "zstate", "--until-eof", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        self.pid = self._process.pid
        self._on_line = on_line
        self._on_end = on_end
        threading.Thread(target=self._follow, name=f"zstate {name}", daemon=True).start()

    @property
    def exit_code(self) -> int | None:
        """None while it runs."""
        return self._process.poll()

    def close(self) -> None:
        """End it and wait for that, less than a second. A second call does nothing."""
        self.ask_to_end()
        try:
            self._process.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def ask_to_end(self) -> None:
        """End it without waiting."""
        if self._process.poll() is None:
            self._process.terminate()

    def _follow(self) -> None:
        errors = threading.Thread(target=self._follow_errors, daemon=True)
        errors.start()
        for line in self._process.stdout or ():
            self._on_line(line.rstrip("\n"))
        errors.join()
        self._process.wait()
        self._on_end(self)

    def _follow_errors(self) -> None:
        for line in self._process.stderr or ():
            if line.strip():
                self.last_error = text_in(line.strip())
                self._on_line(line.rstrip("\n"))


def end_with_parent() -> None:
    """End this process when its standard input does: whoever started it is gone."""

    main = threading.get_ident()

    def watch() -> None:
        while os.read(sys.stdin.fileno(), 1024):
            pass
        # To the process, it could reach this thread, and the main thread would go on waiting.
        signal.pthread_kill(main, signal.SIGTERM)

    threading.Thread(target=watch, name="zstate parent", daemon=True).start()
