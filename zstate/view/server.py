"""The page: a viser server behind access checks, and screenshots of it by a headless browser.

Neither connects to the internet.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import io
import logging
import math
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
import viser
import websockets.asyncio.server
from numpy.typing import NDArray
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from zstate._util.closeable import Closeable
from zstate.clock import wait_interruptible
from zstate.errors import InvalidInput, LibraryMissing, ZStateError
from zstate.view.browser_messages import Widget, accept_message
from zstate.web_access import AccessCheck, end_openings, is_websocket, listen

PORT = 8080
# A browser that has vanished (a suspended laptop, a lost network) does not answer the closing handshake.
_CLOSE_TIMEOUT_S = 0.3
_PING_PERIOD_S = 0.5
_ANSWER_WITHIN_S = 3.0
"""A browser without an answer to a ping for so long is cut off, suspended, or has too much to draw."""

_LOG = logging.getLogger("zstate")
# websockets logs a traceback for each connection that a browser opens and drops.
_SILENT = logging.getLogger("zstate.view.http")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False

# Held while websockets.asyncio.server.serve is replaced.
_opening = threading.Lock()

# Chromium-based browsers, first the one without windows.
_PROGRAMS = (
    "chromium-headless-shell",
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "microsoft-edge",
    "brave-browser",
)
# Draw without a graphics card, and connect to no other host.
_FLAGS = (
    "--headless=new",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1 , EXCLUDE localhost",
)
_EXIT_TIMEOUT_S = 3.0
_OPEN_TIMEOUT_S = 30.0
_DRAW_TIMEOUT_S = 30.0
# A browser unpacks meshes one after the other and reports none of them: a picture is complete when it hardly
# changes any more.
_UNPACK_PERIOD_S = 0.5
_MAX_CHANGED = 0.004  # share of pixels
_MAX_ATTEMPTS = 6

Pixels = NDArray[np.uint8]


class ViewServer(Closeable):
    """The page at ``host``; ``server`` is the viser server behind it.

    ``port`` None is the first free one from 8080 on; 0 is any. ``url`` is the address to open, with the token
    that is needed beyond loopback. Raises InvalidInput if ``host`` or ``port`` cannot be used.
    """

    def __init__(self, host: str = "127.0.0.1", port: int | None = None) -> None:
        self.host = host
        self._socket = listen(host, port, PORT)
        self.port: int = self._socket.getsockname()[1]
        self.access = AccessCheck.at(host, self.port)
        self.connected = threading.Event()
        """Set while at least one browser shows the page."""
        self._has_refused = False
        self._answered_at: dict[ServerConnection, float] = {}
        opened: list[int] = []
        try:
            with _opening, _no_output(), self._guarded_serve(opened):
                self.server = _Server(host, self.port, "zstate", verbose=False)
        except BaseException:
            if not opened:  # else the thread of viser closes it, at exit
                self._socket.close()
            raise
        if not opened:
            self.close()
            self._socket.close()
            raise RuntimeError("this version of viser opens its server in a way that is not guarded")
        self.server.gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self.server.on_client_connect(lambda _: self._update_connected())
        self.server.on_client_disconnect(lambda _: self._update_connected())

    @property
    def url(self) -> str:
        """The address to open in a browser."""
        return self.access.url("http")

    def is_answering(self, client_id: int) -> bool:
        """Whether the browser ``client_id`` shows the page, and has answered a ping in the last 3 s.

        viser closes the connection to a browser that is cut off after 20 to 40 s, and not sooner: a ping may
        wait for the meshes on a slow network.
        """
        connection = self.server._websock_server._live_connections.get(client_id)  # pyright: ignore[reportPrivateUsage]
        if connection is None:
            return False
        return time.monotonic() - self._answered_at.get(connection, -math.inf) < _ANSWER_WITHIN_S

    def close(self) -> None:
        """Stop the server, whose thread closes the socket. A second call does nothing."""
        with _no_output():
            self.server.stop()

    def _update_connected(self) -> None:
        (self.connected.set if self.server.get_clients() else self.connected.clear)()

    @contextlib.contextmanager
    def _guarded_serve(self, opened: list[int]) -> Generator[None]:
        """Makes a websockets server that is opened inside use our socket and the access checks.

        ``opened`` receives its port. viser has no option for this: it listens at a host and the next free
        port, and answers every request.
        """
        original = websockets.asyncio.server.serve

        def serve(
            handler: Any, host: str, port: int, *, process_request: Any, **options: Any
        ) -> websockets.asyncio.server.serve:
            opened.append(port)
            new_connection: Any = functools.partial(_Connection, self._accept)
            return _Serve(
                functools.partial(self._handle, handler),
                sock=self._socket,
                process_request=functools.partial(self._process_request, process_request),
                create_connection=new_connection,
                logger=_SILENT,
                close_timeout=_CLOSE_TIMEOUT_S,
                **options,
            )

        websockets.asyncio.server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = original

    def _accept(self, address: tuple[Any, ...], raw: bytes | str) -> bytes | None:
        """A message of the browser at ``address`` as viser may receive it; None if it is ignored."""
        accepted = accept_message(raw, self._widget)
        if accepted is None and not self._has_refused:
            self._has_refused = True
            text = "a browser at %s sent a message that this page does not send; such messages are ignored"
            _LOG.warning(text, address[0])
        return accepted

    def _widget(self, uuid: str) -> Widget | None:
        return self.server.gui._gui_input_handle_from_uuid.get(uuid)  # pyright: ignore[reportPrivateUsage]

    async def _handle(self, viser_handler: Any, connection: ServerConnection) -> None:
        self._answered_at[connection] = time.monotonic()
        pings = asyncio.create_task(self._ping(connection))
        try:
            await viser_handler(connection)
        finally:
            pings.cancel()
            await asyncio.gather(pings, return_exceptions=True)
            del self._answered_at[connection]

    async def _ping(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            while True:
                pong = await connection.ping()
                await pong
                self._answered_at[connection] = time.monotonic()
                await asyncio.sleep(_PING_PERIOD_S)

    def _process_request(
        self,
        viser_process_request: Any,
        connection: ServerConnection,
        request: Request,
    ) -> Response | None:
        denied = self.access.check(request.path, request.headers)
        if denied is not None:
            return connection.respond(denied.status, denied.text + "\n")
        if is_websocket(request.headers):
            return None
        response = viser_process_request(connection, request)
        response.headers.update(self.access.headers())
        return response


class _Connection(ServerConnection):
    """The connection of a browser, without the messages for which ``accept(address, raw)`` is None."""

    def __init__(
        self, accept: Callable[[tuple[Any, ...], bytes | str], bytes | None], *arguments: Any, **options: Any
    ) -> None:
        super().__init__(*arguments, **options)
        self._accept = accept

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            accepted = self._accept(self.remote_address, await super().recv(decode))
            if accepted is not None:
                return accepted


class _Serve(websockets.asyncio.server.serve):
    """The server that viser opens in a context, with an end that leaves no connection open."""

    async def __aexit__(self, *exception: Any) -> None:
        await end_openings(self.server)
        await super().__aexit__(*exception)


class _Server(viser.ViserServer):
    """viser's server without share URLs: a page may request one even without the button."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def _no_output() -> contextlib.redirect_stdout[io.StringIO]:
    """Hides what viser prints: addresses that are not the ones to open."""
    return contextlib.redirect_stdout(io.StringIO())


class ScreenshotFailed(ZStateError):
    """The browser did not open or draw the page."""


@contextlib.contextmanager
def _headless_browser(url: str, width: int, height: int) -> Generator[subprocess.Popen[bytes]]:
    """A browser that shows ``url`` in a window of ``width`` by ``height`` pixels that is on no screen.

    Raises LibraryMissing if no Chromium-based browser is installed.
    """
    program = next(filter(None, map(shutil.which, _PROGRAMS)), None)
    if program is None:
        raise LibraryMissing(
            "a picture needs a Chromium-based browser, and none is installed: apt-get install chromium"
        )
    with tempfile.TemporaryDirectory(prefix="zstate-view-", ignore_cleanup_errors=True) as profile:
        command = [program, *_FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}"]
        if os.geteuid() == 0:
            command.append("--no-sandbox")  # root has none
        silent = subprocess.DEVNULL
        process = subprocess.Popen(
            [*command, url], stdin=silent, stdout=silent, stderr=silent, start_new_session=True
        )
        try:
            yield process
        finally:
            # All processes of the session: the program may be a script that has started the browser.
            _signal_group(process, signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_EXIT_TIMEOUT_S)
            _signal_group(process, signal.SIGKILL)
            process.wait()


def _signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS permits no signal to ended ones
        os.killpg(process.pid, number)


def save_screenshot(
    page: ViewServer, path: Path, *, width: int, height: int, hold: Callable[[float], bool]
) -> None:
    """Write what ``page`` shows, without its panels, to ``path``.

    The view must be running in another thread; ``hold`` is its method. Raises LibraryMissing if no browser is
    installed, ScreenshotFailed if it does not draw in time, InvalidInput if the file cannot be written.
    """
    with _headless_browser(page.url, width, height) as browser:
        deadline = time.monotonic() + _OPEN_TIMEOUT_S
        while not wait_interruptible(page.connected, 0.2):
            if browser.poll() is not None or time.monotonic() > deadline:
                raise ScreenshotFailed(
                    "the browser did not open the page; does it start by itself, without a screen?"
                )
        client = next(iter(page.server.get_clients().values()))
        if not hold(_DRAW_TIMEOUT_S):
            raise ScreenshotFailed(f"no robot had a pose to be drawn within {_DRAW_TIMEOUT_S:g} s")
        pixels = _render(client, width, height)
        for _ in range(_MAX_ATTEMPTS):
            time.sleep(_UNPACK_PERIOD_S)
            before, pixels = pixels, _render(client, width, height)
            if before.shape == pixels.shape:
                difference = np.abs(before.astype(np.int16) - pixels.astype(np.int16)).max(axis=2)
                if float((difference > 16).mean()) < _MAX_CHANGED:
                    break
    from PIL import Image  # noqa: PLC0415 - only screenshots need it

    try:
        Image.fromarray(pixels).save(path, "png")
    except OSError as error:
        raise InvalidInput(f"the picture cannot be written: {error}") from None


def _render(client: viser.ClientHandle, width: int, height: int) -> Pixels:
    """The picture of a browser on a white background (H, W, 3)."""
    try:
        pixels: Pixels = client.get_render(height, width, transport_format="png", timeout=_DRAW_TIMEOUT_S)
    except (RuntimeError, TimeoutError) as error:
        raise ScreenshotFailed(f"the browser draws nothing: {error}") from None
    if pixels.shape[2] == 3:
        return pixels
    opacity = pixels[:, :, 3:].astype(np.float64) / 255.0
    return np.round(pixels[:, :, :3] * opacity + 255.0 * (1.0 - opacity)).astype(np.uint8)
