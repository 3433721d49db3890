"""Cost of the browser view: its own process, and its effect on a publisher and a listener.

A publisher process (``zstate publish --source sine``, 100 Hz) and ``zstate view`` at 30 pictures a second,
read by a client that receives all messages of a browser and draws nothing, since drawing happens on another
machine. Then ten robots of 30 links at 10 Hz; the chain at 100 Hz without a view and with one; and the time
from `zstate view panda --sliders` until an open browser (headless chromium, no graphics card) shows the
robot.
"""

from __future__ import annotations

import io
import threading
import time
import urllib.parse
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import msgspec
import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import sync_playwright
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as connect_websocket
from websockets.typing import Subprotocol

from bench.measure import cpu_ns
from bench.micro.chain import run_chain
from bench.micro.form import Row, chain_urdf, end_of_input, running_role, send_event, use_own_rendezvous
from bench.process import running_command
from zstate import SineSource, StatePublisher, StaticPublisher, Transform, connect, load_model
from zstate.clock import SystemClock
from zstate.rate import Rate

RATE_HZ = 30.0
SETTLE_S = 5.0
ROWS = 300
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
FLEET, LINKS, FLEET_HZ = 10, 30, 10.0
LINK = '<visual><origin xyz="0 0 0.05"/><geometry><box size="0.04 0.04 0.1"/></geometry></visual>'


def measure(robots: tuple[str, ...] = ("panda", "talos"), seconds: float = 10.0) -> Iterator[Row]:
    """Rows of the view, of the chain, and of the first picture."""
    use_own_rendezvous()
    for robot in robots:
        with running_command("publish", robot, "--source", "sine"):
            yield from view_rows(f"{robot} at 30 Hz, zstate view", seconds, robot)
    with running_role(publish_fleet):
        yield from view_rows(f"{FLEET} robots of {LINKS} links at {FLEET_HZ:g} Hz, zstate view", seconds)
    for is_viewed in (False, True, False, True):
        with ExitStack() as opened:
            if is_viewed:
                _, line = opened.enter_context(running_command("view", "--port", "0", text="http"))
                opened.enter_context(ViewerClient(address(line)))
            how = "with" if is_viewed else "without"
            yield from run_chain(f"chain {how} an open view", "panda", 100.0, seconds, "woken")
    yield from first_picture()


def address(line: str) -> str:
    """The address at the end of the line that `zstate view` prints."""
    return line.rpartition(" ")[2].strip()


def view_rows(what: str, seconds: float, *robots: str) -> Iterator[Row]:
    """The costs of `zstate view`."""
    with running_command("view", *robots, "--port", "0", text="http") as (pid, line):
        yield from page_rows(what, seconds, pid, address(line))


def page_rows(what: str, seconds: float, pid: int, url: str) -> Iterator[Row]:
    """CPU of a process with one client of its page, and the data sent to the client."""
    with ViewerClient(url) as client:
        time.sleep(SETTLE_S)
        begin, cpu, received = time.monotonic(), cpu_ns(pid), client.bytes
        time.sleep(seconds)
        lasted = time.monotonic() - begin
        yield Row(f"{what}: CPU", "% of a core", [(cpu_ns(pid) - cpu) / lasted / 1e7])
        yield Row(f"{what}: to the page", "kB/s", [(client.bytes - received) / lasted / 1e3])


class ViewerClient:
    """A client that behaves like a browser: sends its camera and receives all messages."""

    def __init__(self, url: str) -> None:
        address = urllib.parse.urlsplit(url)._replace(scheme="ws").geturl()
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        self._socket = connect_websocket(address, subprotocols=[protocol], compression=None, max_size=None)
        self.bytes = 0
        self._socket.send(msgspec.msgpack.encode(CAMERA))
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        with suppress(ConnectionClosed):
            for message in self._socket:
                self.bytes += len(message)

    def __enter__(self) -> ViewerClient:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._thread.join()


CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (2.0, 2.0, 2.0),
    "fov": 0.8,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 500,
    "image_width": 800,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


def publish_fleet() -> None:
    """Publishes ten robots, each a chain of revolute joints with a box on every link."""
    ended, model = end_of_input(), load_model(chain_urdf(LINKS - 1, LINK, '<origin xyz="0 0 0.1"/>'))
    source = SineSource(model)
    with connect() as session, ExitStack() as opened:
        fleet = [opened.enter_context(StatePublisher(session, model, f"r{n}")) for n in range(FLEET)]
        for place, robot in enumerate(fleet):
            statics = opened.enter_context(StaticPublisher(session, robot.robot))
            pose = ((0.0, float(place), 0.0), (0.0, 0.0, 0.0, 1.0))
            statics.set(Transform("hall/floor", f"{robot.robot}/{model.root}", *pose))
        send_event("ready")
        for stamp in Rate(FLEET_HZ, SystemClock(), ended):
            reading = source.read(stamp)
            for publisher in fleet:
                publisher.publish(reading.positions, stamp=stamp)


# A notice about the missing graphics card covers the picture.
WITHOUT_NOTICES = """addEventListener("DOMContentLoaded", () => {
    const style = document.createElement("style");
    style.textContent = ".mantine-Notifications-root { display: none !important }";
    document.head.append(style);
})"""


def shows_robot(pixels: NDArray[np.uint8]) -> bool:
    """Whether the left half has dark pixels; without a robot it shows a floor with light lines."""
    picture = pixels[:, : pixels.shape[1] // 2, :3]
    return bool((picture.max(axis=2) < 90).mean() > 0.005)


def first_picture() -> Iterator[Row]:
    """The time from the command to its address, and to the first picture of the robot."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=FLAGS)
        tab = browser.new_page(viewport={"width": 800, "height": 500})
        tab.goto("about:blank")
        tab.add_init_script(WITHOUT_NOTICES)
        begin = time.monotonic()
        with running_command("view", "panda", "--sliders", "--port", "0", text="http") as (_, line):
            address_s = time.monotonic() - begin
            tab.goto(address(line))
            while not shows_robot(np.asarray(Image.open(io.BytesIO(tab.screenshot())))):
                time.sleep(0.02)
            picture_s = time.monotonic() - begin
        browser.close()
    yield Row("zstate view panda --sliders: address", "s", [address_s])
    yield Row("zstate view panda --sliders: first picture", "s", [picture_s])
