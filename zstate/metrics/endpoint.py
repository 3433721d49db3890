"""HTTP endpoint for Prometheus."""

from __future__ import annotations

import errno
import socket
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from email.message import Message
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, cast
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from zstate import __version__, kernel
from zstate._util.closeable import Closeable
from zstate._util.endpoint import format_host, parse_host_port
from zstate.errors import InvalidInput, LibraryMissing, PortBusy
from zstate.web_access import AccessCheck

if TYPE_CHECKING:
    from collections.abc import Callable
    from wsgiref.types import WSGIApplication

    from prometheus_client.core import Metric
    from prometheus_client.registry import Collector

LOCAL = "127.0.0.1"
_SHUTDOWN_POLL_S = 0.1
# A client that has not sent its whole request within this time is disconnected; so is one that does not read
# the response for so long.
_REQUEST_WITHIN_S = 5.0
_MAX_CONNECTIONS = 32
"""Beyond this number, the one that has waited longest without a whole request is closed."""


class BindAddress(NamedTuple):
    """A host address and a port; port 0 is a free one."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> BindAddress:
        """Parse "9100" (this host only), "0.0.0.0:9100" or "[::]:9100". Raises InvalidInput."""
        address = parse_host_port(text if ":" in text else f"{LOCAL}:{text}")
        if address is None:
            raise InvalidInput(f"{text!r} is not PORT or HOST:PORT; for instance 9100, or 0.0.0.0:9100")
        return cls(*address)


class MetricsCollector(Protocol):
    """Yields metrics at each scrape."""

    def collect(self) -> Iterable[Metric]:
        """The metrics now."""
        ...


def check_library() -> None:
    """Raise LibraryMissing without prometheus-client."""
    try:
        import prometheus_client  # noqa: F401, PLC0415  # pyright: ignore[reportUnusedImport]
    except ImportError as error:
        raise LibraryMissing(
            f"metrics need prometheus-client, which cannot be loaded ({error}): pip install 'zstate[metrics]'"
        ) from None


class MetricsEndpoint(Closeable):
    """Serves the metrics of ``collectors`` at ``url``; a context manager.

    Includes CPU, memory and open files of this process, and the version of zstate. Collectors read existing
    counters; nothing is counted for it. ``port`` 0 is a free one. On loopback, requests for another host are
    refused: a page of a site whose name resolves to 127.0.0.1 gets nothing.

    Raises PortBusy, LibraryMissing without prometheus-client, and InvalidInput if ``host`` is not an address
    of this host.
    """

    def __init__(self, collectors: Sequence[MetricsCollector], host: str = LOCAL, port: int = 0) -> None:
        check_library()
        from prometheus_client import CollectorRegistry, ProcessCollector, exposition  # noqa: PLC0415

        registry = CollectorRegistry()
        for collector in (*collectors, _BuildMetrics()):
            registry.register(cast("Collector", collector))
        ProcessCollector(registry=registry)
        try:
            self._server = (_Server6 if ":" in host else _Server)((host, port), _Handler)
        except OSError as error:
            endpoint = f"{host}:{port}"
            text = f"metrics cannot be served at {endpoint!r}:"
            if error.errno == errno.EADDRINUSE:
                text = f"{text} another program listens there; choose another port, or 0 for a free one"
                raise PortBusy(text, endpoint=endpoint) from None
            raise InvalidInput(f"{text} {error.strerror}; give an address of this host") from None
        self._server.access = AccessCheck(
            host, self._server.server_port, command="--metrics", host_option="HOST:PORT"
        )
        # The library's types leave out the arguments of the application.
        make = cast("Callable[[CollectorRegistry], WSGIApplication]", exposition.make_wsgi_app)  # pyright: ignore
        self._server.set_app(make(registry))
        self.url = f"http://{format_host(host)}:{self._server.server_port}/metrics"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_SHUTDOWN_POLL_S,), name="zstate metrics", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop the server. A second call does nothing."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingMixIn, WSGIServer):
    """The thread that accepts connections also shuts down those that send no whole request in time."""

    daemon_threads = True
    request_queue_size = 128  # connections to accept; with the 5 of socketserver a burst waits for seconds
    access: AccessCheck

    def server_activate(self) -> None:
        self._open = threading.BoundedSemaphore(_MAX_CONNECTIONS)
        self._waiting: dict[socket.socket, float] = {}  # when each has connected, the oldest first
        self._lock = threading.Lock()
        super().server_activate()

    def service_actions(self) -> None:
        super().service_actions()
        now_s = time.monotonic()
        with self._lock:
            for connection, since_s in self._waiting.items():
                if now_s - since_s >= _REQUEST_WITHIN_S:
                    _shut_down(connection)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._open.acquire(blocking=False):
            with self._lock:
                oldest = next(iter(self._waiting), None)
                if oldest is not None:
                    _shut_down(oldest)  # its thread ends, and leaves its place to a later connection
            self.shutdown_request(request)
            return
        with self._lock:
            self._waiting[request] = time.monotonic()
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.on_request(request)
            self._open.release()

    def on_request(self, connection: socket.socket) -> None:
        """A connection has sent its whole request, or has ended."""
        with self._lock:
            self._waiting.pop(connection, None)

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), OSError):  # that is a client that has gone, or reads too slowly
            super().handle_error(request, client_address)


def _shut_down(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _Server6(_Server):
    address_family = socket.AF_INET6


class _Headers:
    """The headers of a request, for the access check."""

    def __init__(self, message: Message) -> None:
        self._message = message

    def get_all(self, key: str, /) -> list[str]:
        return [str(one) for one in self._message.get_all(key, [])]


class _Handler(WSGIRequestHandler):
    timeout = _REQUEST_WITHIN_S

    def parse_request(self) -> bool:
        is_valid = super().parse_request()
        server = cast("_Server", self.server)
        server.on_request(self.connection)
        if not is_valid:
            return False
        denied = server.access.check(self.path, _Headers(self.headers))
        if denied is not None:
            self.send_error(denied.status, denied.text)
        return denied is None

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: scrapes are frequent."""


class _BuildMetrics:
    def collect(self) -> Iterable[Metric]:
        from prometheus_client.core import InfoMetricFamily  # noqa: PLC0415

        facts = {"version": __version__, "kernel": str(kernel)}
        yield InfoMetricFamily("zstate_build", "Version and kernel of zstate.", facts)
