"""Page: a viser server that shows itself to whom it should, and asks nobody outside."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import logging
import socket
import threading
from collections.abc import Generator
from typing import Any, NoReturn

import viser
import websockets.asyncio.server
from websockets.http11 import Request, Response

from zstate._util.closeable import Closeable
from zstate._util.endpoint import format_host
from zstate.errors import InvalidInput
from zstate.view.access import AccessCheck, is_websocket

PORT = 8080
_PORTS_TRIED = 100
# A browser that has vanished (a laptop that sleeps, a network that is gone) does not say goodbye.
_CLOSES_WITHIN_S = 0.3

# It tells of every browser that opens a connection and thinks better of it, with a traceback.
_SILENT = logging.getLogger("zstate.view.http")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False

# While one server opens, websockets' function that opens servers is not what it is for others.
_opening = threading.Lock()


class ViewServer(Closeable):
    """A page at ``host``, and what is in it: ``server`` is viser's.

    ``port`` None is the first free one from 8080 on; 0 is any. ``url`` is what to open, with the token
    that is wanted beyond loopback. Raises InvalidInput for a host or a port that cannot be had.
    """

    def __init__(self, host: str = "127.0.0.1", port: int | None = None, *, title: str = "zstate") -> None:
        self.host = host
        self._listening = _listen(host, port)
        self.port: int = self._listening.getsockname()[1]
        self.door = AccessCheck.at(host, self.port)
        self.connected = threading.Event()
        """Set while at least one browser shows the page."""
        try:
            self.server = self._open(title)
        except BaseException:
            self._listening.close()
            raise
        self.server.on_client_connect(lambda _: self._count())
        self.server.on_client_disconnect(lambda _: self._count())

    @property
    def url(self) -> str:
        """The address to open in a browser."""
        query = "" if self.door.token is None else f"/?token={self.door.token}"
        return f"http://{_named(self.host)}:{self.port}{query}"

    def close(self) -> None:
        """Show it to nobody any more. A second call does nothing."""
        with _quiet():
            self.server.stop()
        self._listening.close()

    def _open(self, title: str) -> viser.ViserServer:
        with _opening, _quiet(), self._opens_here() as opened:
            server = _Server(self.host, self.port, title, verbose=False)
            server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
            server.gui.main_panel.dock_right()
            if not opened:
                server.stop()
                raise RuntimeError("this version of viser opens its server in a way that is not guarded")
            return server

    def _count(self) -> None:
        (self.connected.set if self.server.get_clients() else self.connected.clear)()

    @contextlib.contextmanager
    def _opens_here(self) -> Generator[list[int]]:
        """The server that is opened meanwhile listens here, behind the door; its port is then in the list.

        viser has no place to put a check in front of its own: it listens to a host and the next free
        port, and answers whoever comes.
        """
        opens = websockets.asyncio.server.serve
        opened: list[int] = []

        def serve(
            handler: Any, host: str, port: int, *, process_request: Any, **options: Any
        ) -> websockets.asyncio.server.serve:
            opened.append(port)
            guarded = functools.partial(self._answer, process_request)
            return opens(
                handler,
                sock=self._listening,
                process_request=guarded,
                logger=_SILENT,
                close_timeout=_CLOSES_WITHIN_S,
                **options,
            )

        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield opened
        finally:
            websockets.asyncio.server.serve = opens

    def _answer(
        self, of_viser: Any, connection: websockets.asyncio.server.ServerConnection, request: Request
    ) -> Response | None:
        refused = self.door.check(request.path, request.headers)
        if refused is not None:
            response = connection.respond(refused.status, refused.text + "\n")
        elif is_websocket(request.headers):
            return None
        else:
            response = of_viser(connection, request)
            response.headers.update(self.door.headers())
        return response


class _Server(viser.ViserServer):
    """viser's server without its way to the internet: the page may ask for it, button or not."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def _listen(host: str, port: int | None) -> socket.socket:
    if port is not None:
        return _bound(host, port) or _refuse(f"port {port} is taken", host)
    for tried in range(PORT, PORT + _PORTS_TRIED):
        bound = _bound(host, tried)
        if bound is not None:
            return bound
    return _refuse(f"ports {PORT} to {PORT + _PORTS_TRIED - 1} are taken", host)


def _refuse(what: str, host: str) -> NoReturn:
    raise InvalidInput(f"{what} at {host!r}; name a free one with --port, or 0 for any")


def _bound(host: str, port: int) -> socket.socket | None:
    """A socket that listens there; None where somebody else does."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            return None
        raise InvalidInput(f"nobody can listen at {host!r}, port {port}: {error}") from None


def _named(host: str) -> str:
    """What others call this host."""
    if host in ("", "0.0.0.0", "::"):
        return socket.gethostname()
    return format_host(host)


@contextlib.contextmanager
def _quiet() -> Generator[None]:
    """Where viser prints addresses that are not the ones to open."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
