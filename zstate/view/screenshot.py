"""Picture: what a page shows, drawn by a browser that nobody sees, as a PNG.

Browser: one that nobody sees, to draw pictures with.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import imageio.v3
import numpy as np
import viser
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate.clock import wait_interruptible
from zstate.errors import InvalidInput, LibraryMissing, ZStateError
from zstate.view.server import ViewServer

_NAMES = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "microsoft-edge",
    "brave-browser",
)
# It draws without a graphics card, and asks nobody outside about anything.
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
_ENDS_WITHIN_S = 3.0


class HeadlessBrowser(Closeable):
    """Shows ``url`` in a window of ``width`` by ``height`` pixels that is on no screen.

    Raises LibraryMissing where no browser of Chromium's kind is installed.
    """

    def __init__(self, url: str, width: int, height: int) -> None:
        program = installed_browser()
        self._profile = tempfile.TemporaryDirectory(prefix="zstate-view-", ignore_cleanup_errors=True)
        command = [
            program,
            *_FLAGS,
            f"--user-data-dir={self._profile.name}",
            f"--window-size={width},{height}",
        ]
        if os.geteuid() == 0:
            command.append("--no-sandbox")  # root has none
        silent = subprocess.DEVNULL
        self._process = subprocess.Popen(
            [*command, url], stdin=silent, stdout=silent, stderr=silent, start_new_session=True
        )

    @property
    def has_ended(self) -> bool:
        """Whether it has ended by itself, which it never should."""
        return self._process.poll() is not None

    def close(self) -> None:
        """End it and what it started. A second call does nothing."""
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_ENDS_WITHIN_S)
        self._process.kill()
        self._process.wait()
        self._profile.cleanup()


def installed_browser() -> str:
    """The path of a browser that can be driven. Raises LibraryMissing."""
    for name in _NAMES:
        path = shutil.which(name)
        if path is not None:
            return path
    raise LibraryMissing(
        "a picture is drawn by a browser, and none of Chromium's kind is installed: apt-get install chromium"
    )


Pixels = NDArray[np.uint8]

_OPENS_WITHIN_S = 30.0
_DRAWS_WITHIN_S = 30.0
# Meshes are unpacked one after the other: all are when hardly anything changes any more.
_UNPACKS_S = 0.5
_COMPLETE_BELOW = 0.004
_PATIENCE = 6


class ScreenshotFailed(ZStateError):
    """A browser was there and drew nothing."""


def save_screenshot(
    page: ViewServer,
    path: Path,
    *,
    width: int = 1280,
    height: int = 800,
    hold: Callable[[float], bool],
) -> None:
    """Write what ``page`` shows, without its panels, to ``path``.

    The view that draws on the page has to be at work, in another thread; ``hold`` is its method. Raises
    LibraryMissing where no browser is installed, NoPicture when it shows nothing in time, InvalidInput for a
    file that cannot be.
    """
    with HeadlessBrowser(page.url, width, height) as browser:
        client = _client(page, browser)
        if not hold(_DRAWS_WITHIN_S):
            raise ScreenshotFailed(f"no robot had a pose to be drawn within {_DRAWS_WITHIN_S:g} s")
        pixels = _until_stable(lambda: _drawn(client, width, height))
    try:
        path.write_bytes(encode_png(pixels))
    except OSError as error:
        raise InvalidInput(f"the picture cannot be written: {error}") from None


def encode_png(pixels: Pixels) -> bytes:
    """(H, W, 3) as a PNG."""
    out = BytesIO()
    imageio.v3.imwrite(out, pixels, extension=".png")  # pyright: ignore[reportUnknownMemberType]
    return out.getvalue()


def _client(page: ViewServer, browser: HeadlessBrowser) -> viser.ClientHandle:
    deadline = time.monotonic() + _OPENS_WITHIN_S
    while not wait_interruptible(page.connected, 0.2):
        if browser.has_ended or time.monotonic() > deadline:
            raise ScreenshotFailed(
                "the browser did not open the page; does it start by itself, without a screen?"
            )
    return next(iter(page.server.get_clients().values()))


def _drawn(client: viser.ClientHandle, width: int, height: int) -> Pixels:
    try:
        drawn: Pixels = client.get_render(height, width, transport_format="png", timeout=_DRAWS_WITHIN_S)
    except (RuntimeError, TimeoutError) as error:
        raise ScreenshotFailed(f"the browser draws nothing: {error}") from None
    return _on_white(drawn)


def _on_white(pixels: Pixels) -> Pixels:
    """(H, W, 4), of which the last is how little of the background is seen, as (H, W, 3)."""
    if pixels.shape[2] == 3:
        return pixels
    opacity = pixels[:, :, 3:].astype(np.float64) / 255.0
    return np.round(pixels[:, :, :3] * opacity + 255.0 * (1.0 - opacity)).astype(np.uint8)


def _until_stable(draw: Callable[[], Pixels]) -> Pixels:
    """The first picture after which hardly anything changes, or the last of many."""
    last = draw()
    for _ in range(_PATIENCE):
        time.sleep(_UNPACKS_S)
        before, last = last, draw()
        if _change(before, last) < _COMPLETE_BELOW:
            break
    return last


def _change(before: Pixels, after: Pixels) -> float:
    """The share of pixels that look different."""
    if before.shape != after.shape:
        return 1.0
    difference = np.abs(before.astype(np.int16) - after.astype(np.int16)).max(axis=2)
    return float((difference > 16).mean())
