"""A TCP proxy that counts the bytes of one link."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from types import TracebackType


class LinkMeter:
    """Forwards connections from ``endpoint`` to a local port; a context manager.

    ``received`` and ``sent`` count the bytes to and from the connecting program.
    """

    def __init__(self, port: int) -> None:
        self.received = 0
        self.sent = 0
        self._port = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self._sockets = [self._server]
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> LinkMeter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for one in self._sockets:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection(("127.0.0.1", self._port))
                self._sockets += [near, far]
                threading.Thread(target=self._forward, args=(near, far, "sent"), daemon=True).start()
                threading.Thread(target=self._forward, args=(far, near, "received"), daemon=True).start()

    def _forward(self, incoming: socket.socket, outgoing: socket.socket, counter: str) -> None:
        with suppress(OSError):
            while data := incoming.recv(65_536):
                outgoing.sendall(data)
                setattr(self, counter, getattr(self, counter) + len(data))
            outgoing.shutdown(socket.SHUT_WR)
