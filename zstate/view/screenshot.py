"""Screenshots of the page as PNG files, drawn by a headless browser."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path

import imageio.v3
import numpy as np
import viser
from numpy.typing import NDArray

from zstate.clock import wait_interruptible
from zstate.errors import InvalidInput, LibraryMissing, ZStateError
from zstate.view.server import ViewServer

_PROGRAMS = (
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


class ScreenshotFailed(ZStateError):
    """The browser did not open or draw the page."""


@contextmanager
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
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(_EXIT_TIMEOUT_S)
            process.kill()
            process.wait()


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
    try:
        out = BytesIO()
        imageio.v3.imwrite(out, pixels, extension=".png")  # pyright: ignore[reportUnknownMemberType]
        path.write_bytes(out.getvalue())
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
