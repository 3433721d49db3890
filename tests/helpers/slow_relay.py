"""A TCP relay with the rate of a slow link, which can be cut; what does not fit waits in the kernel."""

from __future__ import annotations

import queue
import random
import socket
import threading
import time
from contextlib import suppress
from functools import partial

from helpers.processes import find_free_port

_CHUNK_S = 0.02
_LEAST_BYTES = 64
_STALL_S = 0.5


class SlowRelay:
    """Relays connections to ``port`` of this host, ``bytes_per_s`` each way; a context manager.

    Nothing is read from a socket before it can be passed on, so both kernels' buffers fill, as before a slow
    modem. While ``is_cut`` nothing is read; what was sent meanwhile arrives once it is False again.
    All arrives ``delay_s`` later, and this part of the chunks stalls for half a second, with all behind it:
    ``stalls``, between 0 and 1.
    """

    def __init__(self, port: int, bytes_per_s: float, delay_s: float = 0.0, stalls: float = 0.0) -> None:
        self.port = find_free_port()
        self.is_cut = False
        self.passed_at = time.monotonic()
        """When bytes of a client have arrived last."""
        self.passed = 0
        """How many of them."""
        self._target = port
        self._rate = bytes_per_s
        self._delay_s, self._stalls = delay_s, stalls
        self._sockets: list[socket.socket] = []
        self._near: set[socket.socket] = set()
        self._closed = False
        self._server = socket.create_server(("127.0.0.1", self.port))
        self._threads: list[threading.Thread] = []
        self._start(self._accept)

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    def __enter__(self) -> SlowRelay:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        for one in (self._server, *self._sockets):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        for thread in self._threads:
            thread.join()

    def _start(self, run, *arguments) -> None:
        thread = threading.Thread(target=run, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection(("127.0.0.1", self._target))
                far.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._sockets += [near, far]
                self._near.add(near)
                self._start(self._pass_on, near, far)
                self._start(self._pass_on, far, near)

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        late: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        send = sink.sendall
        if self._delay_s or self._stalls:
            self._start(self._send_late, late, sink)
            send = partial(self._delay, late, random.Random(1))
        most = max(_LEAST_BYTES, round(self._rate * _CHUNK_S))
        free_at = time.monotonic()
        with suppress(OSError):
            while not self._closed:
                if self.is_cut:
                    time.sleep(_CHUNK_S)
                    continue
                data = source.recv(most)
                if not data:
                    break
                # The last byte arrives when the link has carried all of them.
                free_at = max(free_at, time.monotonic()) + len(data) / self._rate
                time.sleep(max(0.0, free_at - time.monotonic()))
                while self.is_cut and not self._closed:
                    time.sleep(_CHUNK_S)
                send(data)
                if source in self._near:
                    self.passed_at, self.passed = time.monotonic(), self.passed + len(data)
        late.put((0.0, b""))
        if send == sink.sendall:
            with suppress(OSError):
                sink.shutdown(socket.SHUT_WR)

    def _delay(
        self, late: queue.SimpleQueue[tuple[float, bytes]], chance: random.Random, data: bytes
    ) -> None:
        stall_s = _STALL_S if chance.random() < self._stalls else 0.0
        late.put((time.monotonic() + self._delay_s + stall_s, data))

    def _send_late(self, late: queue.SimpleQueue[tuple[float, bytes]], sink: socket.socket) -> None:
        """Sends each chunk when it is due, in order, until an empty one."""
        with suppress(OSError):
            while (item := late.get())[1]:
                time.sleep(max(0.0, item[0] - time.monotonic()))
                sink.sendall(item[1])
        with suppress(OSError):
            sink.shutdown(socket.SHUT_WR)
