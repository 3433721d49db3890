"""Adds the finished files of a recording to a store, in the background, while the recording goes on.

Each file is added by a child process of low priority: neither its work nor its end concerns the recorder.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from zstate.errors import ZStateError
from zstate.recording.stores import new_store

_PROGRAM = "import sys; from zstate.recording.background_store import run; sys.exit(run(*sys.argv[1:]))"
_NICE = 10


def run(name: str, path: str = "") -> str | None:
    """The child process: adds ``path`` to the store ``name``, or checks it; the reason if that failed."""
    try:
        store = new_store(name)
        if path:
            store.add(Path(path))
        else:
            store.check()
    except ZStateError as error:
        return str(error)
    return None


class BackgroundStore:
    """Adds files to the store ``name``, one after the other.

    A file that could not be added is tried again after the next one, and at the end. ``added`` are the files
    that the store has, ``failed`` the reasons of the others that were tried, ``problem`` why the store cannot
    be used at all, if so. Raises InvalidInput if no plugin brings a store.
    """

    def __init__(self, name: str) -> None:
        new_store(name)
        self.name = name
        self.added: list[Path] = []
        self.failed: dict[Path, str] = {}
        self.problem = ""
        self._waiting: list[Path] = []
        self._changed = threading.Condition()
        self._is_closed = False
        # A daemon: a child process that was started completes its file also if this process ends.
        self._thread = threading.Thread(target=self._run, name="zstate background store", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> Collection[Path]:
        """The files that are not tried yet, or being added now."""
        with self._changed:
            return tuple(self._waiting)

    def add(self, path: Path) -> None:
        """Let a finished file be added."""
        with self._changed:
            self._waiting.append(path)
            self._changed.notify_all()

    def finish(self, timeout_s: float | None = None) -> bool:
        """Wait until all files were tried, those that failed once more; whether that is done."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        self.problem = self._child(self.name)
        while True:
            with self._changed:
                while not self._waiting and not self._is_closed:
                    self._changed.wait()
                path = self._waiting[0] if self._waiting else None
            if path is not None:
                self._try(path)
                with self._changed:
                    self._waiting.remove(path)
            for one in [one for one in self.failed if one != path]:
                self._try(one)
            if path is None:
                return

    def _try(self, path: Path) -> None:
        reason = self._child(self.name, str(path)) if path.exists() else "it was deleted before"
        if reason:
            self.failed[path] = reason
        else:
            self.failed.pop(path, None)
            self.added.append(path)

    def _child(self, *arguments: str) -> str:
        """Why the child process failed; empty if it did not."""
        command = [sys.executable, "-c", _PROGRAM, *arguments]
        try:
            with subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                start_new_session=True,  # Ctrl-C is for the recorder
            ) as child:
                with suppress(OSError):
                    os.setpriority(os.PRIO_PROCESS, child.pid, _NICE)
                _, log = child.communicate()
        except OSError as error:
            return f"no process could be started: {error.strerror or error}"
        last = (log.strip().splitlines() or [f"its process ended with {child.returncode}"])[-1]
        return last if child.returncode else ""
