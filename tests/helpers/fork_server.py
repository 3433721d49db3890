"""Child processes without the imports: a server that has imported zstate, and forks for each of them.

A command computes 0.3 to 0.5 s before it does anything, nearly all of it imports. What the server starts
is a process like any other: with its own signals, streams, environment and exit code. It differs in what is
decided by imports (``ZSTATE_KERNEL``, ``PYTHON*``), and in its parent, which is the server.

``server()`` starts it once for the tests of one process; it ends with them, and its children with it.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TextIO

_LENGTH = struct.Struct("<I")
_CODE = struct.Struct("<i")

PRELOADED = (
    *("numpy", "zenoh", "msgspec", "click.shell_completion", "rich.live", "rich.table", "yaml", "ssl"),
    *("zstate", "zstate.cli.main", "zstate.net.session", "zstate.net.presence", "zstate.cli.waiting"),
    *("zstate.nodes.listener", "zstate.nodes.listener_diagnostics", "zstate.nodes.publisher"),
    *("zstate.nodes.clock", "zstate.net.rendezvous", "zstate.buffer.snapshot", "zstate.driving"),
    *("zstate.model.pinocchio_solver", "zstate.sources", "zstate.cli.session", "zstate.cli.processes"),
    *("zstate.odometry", "zstate.scans", "zstate.odometry.cli.rover", "zstate.wire.registry"),
)


class ForkedProcess:
    """A child of the server, with the methods of ``subprocess.Popen`` that tests use."""

    stdin: TextIO | None = None
    stdout: TextIO | None = None
    stderr: TextIO | None = None

    def __init__(self, status: int) -> None:
        self.returncode: int | None = None
        self._status = status
        self._lock = threading.Lock()
        self.pid = self._received()

    def _received(self) -> int:
        data = os.read(self._status, _CODE.size)
        assert len(data) == _CODE.size, "the server of child processes has ended"
        return int(_CODE.unpack(data)[0])

    def poll(self) -> int | None:
        """The exit code, minus the number of the signal that ended it; None while it runs."""
        with self._lock:
            if self.returncode is None and select.select([self._status], [], [], 0.0)[0]:
                self.returncode = self._received()
                os.close(self._status)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """The exit code, when it has ended; raises subprocess.TimeoutExpired after ``timeout`` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0.0:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            select.select([self._status], [], [], left)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """The server, as a process of its own."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._control, remote = socket.socketpair()
        with remote:
            self._process = subprocess.Popen(
                [sys.executable, "-u", __file__, str(remote.fileno())],
                pass_fds=[remote.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        atexit.register(self.close)

    def start(
        self, code: str, *arguments: str, terminal: int | None = None, imports: Sequence[str] = ()
    ) -> ForkedProcess:
        """Run ``code`` in a process, with the environment and the folder of this one.

        Its streams are pipes, or ``terminal``. The server imports ``imports`` first, if it has not yet.
        """
        request = {
            **{"code": code, "arguments": arguments, "imports": imports},
            **{"environment": dict(os.environ), "folder": str(Path.cwd())},
        }
        data = json.dumps(request).encode()
        ended, status = os.pipe()
        (stdin, to), (out, stdout), (err, stderr) = (os.pipe() for _ in range(3))
        theirs = [stdin, stdout, stderr] if terminal is None else [terminal] * 3
        try:
            with self._lock:
                socket.send_fds(self._control, [_LENGTH.pack(len(data))], [*theirs, status])
                self._control.sendall(data)
        finally:
            for one in (stdin, stdout, stderr, status):
                os.close(one)
        process = ForkedProcess(ended)
        process.stdin, process.stdout, process.stderr = os.fdopen(to, "w"), os.fdopen(out), os.fdopen(err)
        return process

    def close(self) -> None:
        """End the server, and its children with it."""
        self._control.close()
        self._process.wait()


@cache
def server() -> ForkServer:
    """The server of this process."""
    return ForkServer()


def _serve(control: socket.socket) -> Callable[[], None]:
    """Forks for each request until ``control`` ends. In a child it returns what the child runs."""
    running: dict[int, int] = {}
    woken, wakes = os.pipe()
    os.set_blocking(wakes, False)
    signal.set_wakeup_fd(wakes)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    while True:
        ready = select.select([control, woken], [], [])[0]
        if woken in ready:
            os.read(woken, 1024)
            with suppress(ChildProcessError):
                while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                    status = running.pop(ended[0])
                    with suppress(OSError):  # the test has ended
                        os.write(status, _CODE.pack(os.waitstatus_to_exitcode(ended[1])))
                    os.close(status)
        if control not in ready:
            continue
        head, descriptors, *_ = socket.recv_fds(control, _LENGTH.size, 4)
        if not head:
            for pid in running:
                os.kill(pid, signal.SIGKILL)
            raise SystemExit
        request = json.loads(_read(control, *_LENGTH.unpack(head)))
        *streams, status = descriptors
        for name in request["imports"]:
            with suppress(ModuleNotFoundError):  # the program reports it
                import_module(name)
        with warnings.catch_warnings():  # of threads, as numpy has them; they are ended by fork handlers
            warnings.simplefilter("ignore", DeprecationWarning)
            pid = os.fork()
        if pid == 0:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            for one in (woken, wakes, status, *running.values()):
                os.close(one)
            control.close()
            return lambda: _run(request, streams)
        with suppress(OSError):
            os.write(status, _CODE.pack(pid))
        running[pid] = status
        for one in streams:
            os.close(one)


def _read(control: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        data += control.recv(size - len(data))
    return data


def _run(request: dict[str, Any], streams: list[int]) -> None:
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.environ.clear()
    os.environ.update(request["environment"])
    time.tzset()
    os.chdir(request["folder"])
    sys.argv = ["-c", *request["arguments"]]
    sys.path[0] = ""
    exec(compile(request["code"], "<string>", "exec"), {"__name__": "__main__"})


def _main() -> None:
    for name in PRELOADED:
        with suppress(ModuleNotFoundError):  # of a plugin whose folder is removed
            import_module(name)
    gc.freeze()
    run = _serve(socket.socket(fileno=int(sys.argv[1])))
    run()


if __name__ == "__main__":
    _main()
