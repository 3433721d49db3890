"""Picture: what a page shows, drawn by a browser that nobody sees, as a PNG."""

from __future__ import annotations

import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import imageio.v3
import numpy as np
import viser
from numpy.typing import NDArray

from zstate.clock import wait_in_slices
from zstate.errors import InvalidInput, ZStateError
from zstate.view.browser import Browser
from zstate.view.page import Page

Pixels = NDArray[np.uint8]

_OPENS_WITHIN_S = 30.0
_DRAWS_WITHIN_S = 30.0
# Meshes are unpacked one after the other: all are when hardly anything changes any more.
_UNPACKS_S = 0.5
_COMPLETE_BELOW = 0.004
_PATIENCE = 6


class NoPicture(ZStateError):
    """A browser was there and drew nothing."""


def take_picture(
    page: Page,
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
    with Browser(page.url, width, height) as browser:
        client = _client(page, browser)
        if not hold(_DRAWS_WITHIN_S):
            raise NoPicture(f"no robot had a pose to be drawn within {_DRAWS_WITHIN_S:g} s")
        pixels = _settled(lambda: _drawn(client, width, height))
    try:
        path.write_bytes(png_of(pixels))
    except OSError as error:
        raise InvalidInput(f"the picture cannot be written: {error}") from None


def png_of(pixels: Pixels) -> bytes:
    """(H, W, 3) as a PNG."""
    out = BytesIO()
    imageio.v3.imwrite(out, pixels, extension=".png")  # pyright: ignore[reportUnknownMemberType]
    return out.getvalue()


def _client(page: Page, browser: Browser) -> viser.ClientHandle:
    deadline = time.monotonic() + _OPENS_WITHIN_S
    while not wait_in_slices(page.connected, 0.2):
        if browser.has_ended or time.monotonic() > deadline:
            raise NoPicture("the browser did not open the page; does it start by itself, without a screen?")
    return next(iter(page.server.get_clients().values()))


def _drawn(client: viser.ClientHandle, width: int, height: int) -> Pixels:
    try:
        drawn: Pixels = client.get_render(height, width, transport_format="png", timeout=_DRAWS_WITHIN_S)
    except (RuntimeError, TimeoutError) as error:
        raise NoPicture(f"the browser draws nothing: {error}") from None
    return _on_white(drawn)


def _on_white(pixels: Pixels) -> Pixels:
    """(H, W, 4), of which the last is how little of the background is seen, as (H, W, 3)."""
    if pixels.shape[2] == 3:
        return pixels
    opacity = pixels[:, :, 3:].astype(np.float64) / 255.0
    return np.round(pixels[:, :, :3] * opacity + 255.0 * (1.0 - opacity)).astype(np.uint8)


def _settled(draw: Callable[[], Pixels]) -> Pixels:
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
