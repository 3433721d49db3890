"""MetricsEndpoint: answers scrapes over HTTP."""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Iterable, Sequence
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, cast
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from zstate import __version__, kernel
from zstate._util.endpoint import format_host
from zstate.closing import Closing
from zstate.errors import InvalidInput, PortBusy
from zstate.metrics.address import LOCAL
from zstate.metrics.library import (
    Collector,
    CollectorRegistry,
    InfoMetricFamily,
    Metric,
    ProcessCollector,
    exposition,
)
from zstate.metrics.pace import EVERY_S

if TYPE_CHECKING:
    from collections.abc import Callable
    from wsgiref.types import WSGIApplication

# How soon closing is noticed.
_POLL_S = 0.1
# Whoever asks and then says no more is not waited for.
_PATIENCE_S = 5.0


class MetricsEndpoint(Closing):
    """Serves what ``collectors`` find, each time it is asked, at ``url``; a context manager.

    Beside them CPU, memory and open files of this process, and the version of zstate. ``port`` 0 is a
    free one. Nothing is counted for it: it reads what is counted anyway. Raises PortBusy, and
    InvalidInput for a host that is not this one.
    """

    def __init__(self, collectors: Sequence[Collector], host: str = LOCAL, port: int = 0) -> None:
        registry = CollectorRegistry()
        for collector in (*collectors, _Build()):
            registry.register(collector)
        ProcessCollector(registry=registry)
        self._server = _bound(host, port)
        self._server.looks = [look for one in collectors if (look := getattr(one, "look", None)) is not None]
        # Its types leave the arguments of the application out.
        make = cast("Callable[[CollectorRegistry], WSGIApplication]", exposition.make_wsgi_app)  # pyright: ignore
        self._server.set_app(make(registry))
        self.url = f"http://{format_host(host)}:{self._server.server_port}/metrics"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_POLL_S,), name="zstate metrics", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Answer no more. A second call does nothing."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingMixIn, WSGIServer):
    """Also calls ``looks`` once a second, from the thread that waits for scrapes."""

    daemon_threads = True
    looks: Sequence[Callable[[], None]] = ()
    _looked_s = -EVERY_S

    def service_actions(self) -> None:
        super().service_actions()
        now_s = time.monotonic()
        if now_s - self._looked_s >= EVERY_S:
            self._looked_s = now_s
            for look in self.looks:
                look()


class _Server6(_Server):
    address_family = socket.AF_INET6


class _Handler(WSGIRequestHandler):
    timeout = _PATIENCE_S

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: scrapes come all the time."""


class _Build(Collector):
    def collect(self) -> Iterable[Metric]:
        facts = {"version": __version__, "kernel": str(kernel)}
        yield InfoMetricFamily("zstate_build", "Which zstate this is.", facts)


def _bound(host: str, port: int) -> _Server:
    try:
        return (_Server6 if ":" in host else _Server)((host, port), _Handler)
    except OSError as error:
        where = f"{host}:{port}"
        if error.errno == errno.EADDRINUSE:
            raise PortBusy(
                f"metrics cannot be served at {where!r}: somebody listens there already; choose another "
                "port, or 0 for a free one",
                endpoint=where,
            ) from None
        raise InvalidInput(
            f"metrics cannot be served at {where!r}: {error.strerror}; give an address of this host"
        ) from None
