"""Fixtures of the view: a page, a running view, and a browser that checks for errors and outside requests."""

from __future__ import annotations

import io
import os
import threading
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
from helpers.requirements import CHROMIUM

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from playwright.sync_api import Browser, Locator
    from playwright.sync_api import Page as Tab
    from viser import ViserServer

    from zstate.net.session import Session
    from zstate.view.data_source import ViewSource
    from zstate.view.server import ViewServer
    from zstate.view.sliders import SliderPublisher
    from zstate.view.view import View

FLAGS = (
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-sync",
    "--no-first-run",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    # Half of the time that a processor takes to draw, and a fifth of that for the whole page.
    "--webgl-antialiasing-mode=none",
    "--webgl-msaa-sample-count=0",
    "--disable-gpu-compositing",
    "--disable-features=SpareRendererForSitePerProcess",  # a process for each tab that is not opened
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1 , EXCLUDE localhost",
)
FRAMES_ON_REQUEST = """
    const onNextFrame = window.requestAnimationFrame.bind(window);
    const waiting = new Map();
    let last = 0;
    window.requestAnimationFrame = (draw) => { waiting.set(++last, draw); return last; };
    window.cancelAnimationFrame = (number) => waiting.delete(number);
    window.drawFrame = () => new Promise((drawn) => onNextFrame((now) => {
        const draws = [...waiting.values()];
        waiting.clear();
        draws.forEach((draw) => draw(now));
        drawn();
    }));
    setInterval(window.drawFrame, 500);
"""
"""The page draws in a loop, which would keep the processors busy that other tests wait for. It draws here
when a picture is taken of it, and now and then for what it does while it draws."""
TIMEOUT_MS = 45_000.0
"""A browser without a graphics card, on a busy machine."""
LOOPBACK = ("127.0.0.1", "localhost")


@dataclass
class BrowserTab:
    """One tab of a browser, with its errors and the URLs it has requested."""

    tab: Tab
    errors: list[str] = field(default_factory=list)
    requested_urls: list[str] = field(default_factory=list)

    def text(self, text: str, *, exact: bool = False) -> Locator:
        """The first element with this text, when it has appeared."""
        found = self.tab.get_by_text(text, exact=exact).first
        found.wait_for(timeout=TIMEOUT_MS)
        return found

    def pixels(self) -> NDArray[np.uint8]:
        """A screenshot: (H, W, 3), of a frame that is drawn now."""
        import numpy as np
        from PIL import Image

        self.tab.evaluate("drawFrame()")
        shot = self.tab.screenshot(timeout=TIMEOUT_MS)
        return np.asarray(Image.open(io.BytesIO(shot)))[:, :, :3]

    def save_screenshot(self, name: str) -> None:
        """Save a screenshot in the folder ZSTATE_SCREENSHOTS, for inspection by a person."""
        folder = os.environ.get("ZSTATE_SCREENSHOTS")
        if folder:
            self.tab.screenshot(path=Path(folder, f"{name}.png"), timeout=TIMEOUT_MS)

    def outside(self) -> list[str]:
        """The requested URLs that are not on this machine."""
        parts = [(urlsplit(url), url) for url in self.requested_urls]
        return [
            url
            for part, url in parts
            if part.scheme not in ("data", "blob") and part.hostname not in LOOPBACK
        ]


@pytest.fixture(scope="module")
def page() -> Iterator[ViewServer]:
    """A page without a browser."""
    pytest.importorskip("viser")
    from zstate.view.server import ViewServer

    with ViewServer(port=0) as opened:
        yield opened


@pytest.fixture
def server(page: ViewServer) -> Iterator[ViserServer]:
    """The viser server of that page, with an empty scene."""
    page.server.scene.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # viser warns of nodes that are removed twice
        yield page.server


@pytest.fixture(scope="module")  # not longer: while it is open, no other test of this thread can run asyncio
def browser() -> Iterator[Browser]:
    from playwright import sync_api

    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield opened
        opened.close()


@pytest.fixture
def open_tab(browser: Browser) -> Iterator[Callable[..., BrowserTab]]:
    """``open_tab(url)`` opens it; at the end, no page has had an error or requested anything outside."""
    view_tabs: list[BrowserTab] = []

    def opened(url: str, width: int = 800, height: int = 500) -> BrowserTab:
        tab = browser.new_page(viewport={"width": width, "height": height})
        tab.add_init_script(FRAMES_ON_REQUEST)
        view_tab = BrowserTab(tab)
        view_tabs.append(view_tab)
        tab.on("pageerror", lambda error: view_tab.errors.append(str(error)))
        tab.on("console", lambda line: view_tab.errors.append(line.text) if line.type == "error" else None)
        tab.on("request", lambda request: view_tab.requested_urls.append(request.url))
        tab.on("websocket", lambda socket: view_tab.requested_urls.append(socket.url))
        tab.goto(url, timeout=TIMEOUT_MS)
        tab.locator("canvas").first.wait_for(timeout=TIMEOUT_MS)
        # Close the warning about a missing graphics card: it covers the picture.
        tab.locator(".mantine-Notification-closeButton").first.click(timeout=TIMEOUT_MS)
        return view_tab

    yield opened
    for view_tab in view_tabs:
        view_tab.tab.close()
    assert [view_tab.errors for view_tab in view_tabs if view_tab.errors] == []
    assert [view_tab.outside() for view_tab in view_tabs if view_tab.outside()] == []
    assert all(url for view_tab in view_tabs for url in view_tab.requested_urls)


@dataclass
class RunningView:
    """A view with its draw loop running."""

    source: ViewSource
    page: ViewServer
    view: View


@pytest.fixture
def show_view() -> Iterator[Callable[..., RunningView]]:
    """``show_view(session, *robots)`` draws them on a page until the end of the test."""
    from contextlib import ExitStack

    with ExitStack() as opened:

        def shown(
            session: Session,
            *robots: str,
            sliders: Sequence[SliderPublisher] = (),
            can_command: bool = False,
        ) -> RunningView:
            return opened.enter_context(_shown(session, robots, sliders, can_command))

        yield shown


@contextmanager
def _shown(
    session: Session, robots: Sequence[str], sliders: Sequence[SliderPublisher], can_command: bool
) -> Generator[RunningView]:
    from zstate.view.data_source import ViewSource
    from zstate.view.server import ViewServer
    from zstate.view.view import View

    stop = threading.Event()
    with (
        ViewSource(session, robots) as source,
        ViewServer(port=0) as page,
        View(source, page, sliders=sliders, can_command=can_command) as view,
    ):
        drawing = threading.Thread(target=view.run, args=(stop,), daemon=True)
        drawing.start()
        try:
            yield RunningView(source, page, view)
        finally:
            stop.set()
            drawing.join(5.0)
