"""A browser that looks at views, and sees to it that they have no errors and ask nobody outside."""

from __future__ import annotations

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

CHROMIUM = "/usr/bin/chromium"
FLAGS = (
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-sync",
    "--no-first-run",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1 , EXCLUDE localhost",
)
SLOWLY_MS = 45_000.0
"""A browser without a graphics card, on a busy machine."""
LOOPBACK = ("127.0.0.1", "localhost")


@dataclass
class Looker:
    """One tab of a browser, with all that went wrong in it and everything it asked for."""

    tab: Tab
    errors: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    def text(self, text: str, *, exact: bool = False) -> Locator:
        """Where the page says something, once it does."""
        found = self.tab.get_by_text(text, exact=exact).first
        found.wait_for(timeout=SLOWLY_MS)
        return found

    def pixels(self) -> NDArray[np.uint8]:
        """The picture: (H, W, 3)."""
        import imageio.v3

        shot = self.tab.screenshot(timeout=SLOWLY_MS)
        return imageio.v3.imread(shot, extension=".png")[:, :, :3]

    def keep(self, name: str) -> None:
        """Leave a screenshot where ZSTATE_SCREENSHOTS says, for somebody to look at."""
        folder = os.environ.get("ZSTATE_SCREENSHOTS")
        if folder:
            self.tab.screenshot(path=Path(folder, f"{name}.png"), timeout=SLOWLY_MS)

    def outside(self) -> list[str]:
        """What it asked for that is not on this machine."""
        parts = [(urlsplit(url), url) for url in self.asked]
        return [
            url
            for part, url in parts
            if part.scheme not in ("data", "blob") and part.hostname not in LOOPBACK
        ]


@pytest.fixture(scope="module")
def page() -> Iterator[ViewServer]:
    """A page that no browser shows."""
    pytest.importorskip("viser")
    from zstate.view.server import ViewServer

    with ViewServer(port=0) as opened:
        yield opened


@pytest.fixture
def server(page: ViewServer) -> Iterator[ViserServer]:
    """The server of that page, with nothing on it."""
    page.server.scene.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # viser warns of nodes that are removed twice
        yield page.server


@pytest.fixture(scope="module")  # not longer: while it is open, no other test of this thread can run asyncio
def browser() -> Iterator[Browser]:
    sync_api = pytest.importorskip("playwright.sync_api")
    if not Path(CHROMIUM).exists():
        pytest.skip("needs Debian's chromium")
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield opened
        opened.close()


@pytest.fixture
def look(browser: Browser) -> Iterator[Callable[..., Looker]]:
    """``look(url)`` opens it; at the end no page has had an error, or asked for anything outside."""
    lookers: list[Looker] = []

    def opened(url: str, width: int = 800, height: int = 500) -> Looker:
        tab = browser.new_page(viewport={"width": width, "height": height})
        looker = Looker(tab)
        lookers.append(looker)
        tab.on("pageerror", lambda error: looker.errors.append(str(error)))
        tab.on("console", lambda said: looker.errors.append(said.text) if said.type == "error" else None)
        tab.on("request", lambda request: looker.asked.append(request.url))
        tab.on("websocket", lambda socket: looker.asked.append(socket.url))
        tab.goto(url, timeout=SLOWLY_MS)
        tab.locator("canvas").first.wait_for(timeout=SLOWLY_MS)
        # It lies over the picture, and says that there is no graphics card.
        tab.locator(".mantine-Notification-closeButton").first.click(timeout=SLOWLY_MS)
        return looker

    yield opened
    for looker in lookers:
        looker.tab.close()
    assert [looker.errors for looker in lookers if looker.errors] == []
    assert [looker.outside() for looker in lookers if looker.outside()] == []
    assert all(url for looker in lookers for url in looker.asked)


@dataclass
class Shown:
    """A view at work."""

    world: ViewSource
    page: ViewServer
    view: View


@pytest.fixture
def show() -> Iterator[Callable[..., Shown]]:
    """``show(session, *robots)`` draws them on a page, for as long as the test lasts."""
    from contextlib import ExitStack

    with ExitStack() as opened:

        def shown(session: Session, *robots: str, sliders: Sequence[SliderPublisher] = ()) -> Shown:
            return opened.enter_context(_shown(session, robots, sliders))

        yield shown


@contextmanager
def _shown(session: Session, robots: Sequence[str], sliders: Sequence[SliderPublisher]) -> Generator[Shown]:
    from zstate.view.data_source import ViewSource
    from zstate.view.server import ViewServer
    from zstate.view.view import View

    stop = threading.Event()
    with (
        ViewSource(session, robots) as world,
        ViewServer(port=0) as page,
        View(world, page, sliders=sliders) as view,
    ):
        drawing = threading.Thread(target=view.run, args=(stop,), daemon=True)
        drawing.start()
        try:
            yield Shown(world, page, view)
        finally:
            stop.set()
            drawing.join(5.0)
