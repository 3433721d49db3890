"""Cost of the browser view: its own process, and its effect on a publisher and a listener.

    python -m bench.micro.view [--seconds 10] [--robots panda talos]

A publisher process (``zstate publish --source sine``, 100 Hz) and ``zstate view`` at 30 pictures a second,
read by a client that receives all messages of a browser and draws nothing, since drawing happens on
another machine. In the same run, viser's own ViserUrdf moves the same robot at 30 Hz, if its environment is
installed:

    python -m venv .bench/viser-urdf && .bench/viser-urdf/bin/pip install 'viser[urdf]>=1.1,<2' pycollada

Then ten robots of 30 links at 10 Hz; rate, CPU and latency of a publisher at 100 Hz and a listener that is
woken by each sample, without a view and with one; and the time from `zstate view panda --sliders` until an
open browser (headless chromium, no graphics card) shows the robot.

CPU is the process's own (all threads) over the window, in % of one core.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import subprocess
import sys
import threading
import time
import urllib.parse
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec
import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import sync_playwright
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as connect_websocket
from websockets.typing import Subprotocol

from bench.environments import venv_python
from bench.measure import cpu_ns
from bench.micro.processes import running_command, running_process, use_own_rendezvous
from zstate import SineSource, StatePublisher, StaticPublisher, Transform, connect, load_model
from zstate.clock import SystemClock
from zstate.model.mesh_paths import MeshPaths
from zstate.rate import Rate

RATE_HZ = 30.0
SETTLE_S = 5.0
ROWS = 300
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
FLEET = 10
LINKS = 30
FLEET_HZ = 10.0
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
LATENCY_RATE_HZ = 100.0


def main() -> None:
    """Print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--robots", nargs="+", default=["panda", "talos"])
    parser.add_argument("--role", choices=("fleet",), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        _publish_fleet()
        return
    use_own_rendezvous()
    for robot in options.robots:
        with running_command("publish", robot, "--source", "sine"):
            _report(f"{robot} at 30 Hz, zstate view", *_measure_zstate_view(options.seconds, "view", robot))
        _report(f"{robot} at 30 Hz, ViserUrdf", *_measure_viser_urdf(options.seconds, robot))
    with running_process(sys.executable, "-m", "bench.micro.view", "--role", "fleet"):
        what = f"{FLEET} robots of {LINKS} links at {FLEET_HZ:g} Hz, zstate view"
        _report(what, *_measure_zstate_view(options.seconds, "view"))
    for is_viewed in (False, True, False, True):
        _measure_chain(options.seconds, is_viewed=is_viewed)
    _first_picture()


def _report(what: str, cpu_percent: float | None, kilobytes_s: float = 0.0) -> None:
    figures = "not installed" if cpu_percent is None else f"{cpu_percent:5.1f} % CPU  {kilobytes_s:6.0f} kB/s"
    print(f"{what:52}  {figures}", flush=True)


def _measure_zstate_view(seconds: float, *command: str) -> tuple[float, float]:
    with running_command(*command, "--port", "0") as (pid, first_line):
        return _measure_page(seconds, pid, first_line.rpartition(" ")[2].strip())


def _measure_viser_urdf(seconds: float, robot: str) -> tuple[float | None, float]:
    python = venv_python("viser-urdf")
    if python is None:
        return None, 0.0
    script = str(Path(__file__).with_name("view_urdf.py"))
    with running_process(python, script, job=_job(robot)) as (pid, first_line):
        return _measure_page(seconds, pid, f"http://127.0.0.1:{int(first_line)}")


def _measure_page(seconds: float, pid: int, url: str) -> tuple[float, float]:
    """CPU of a process [%] with one client of its page, and the data sent to the client [kB/s]."""
    with ViewerClient(url) as client:
        time.sleep(SETTLE_S)
        begin, cpu, received = time.monotonic(), cpu_ns(pid), client.bytes
        time.sleep(seconds)
        lasted = time.monotonic() - begin
        return (cpu_ns(pid) - cpu) / lasted / 1e7, (client.bytes - received) / lasted / 1e3


class ViewerClient:
    """A client that behaves like a browser: sends its camera and receives all messages."""

    def __init__(self, url: str) -> None:
        address = urllib.parse.urlsplit(url)._replace(scheme="ws").geturl()
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        self._socket = connect_websocket(address, subprotocols=[protocol], compression=None, max_size=None)
        self.bytes = 0
        self._socket.send(msgspec.msgpack.encode(_CAMERA))
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


_CAMERA = {
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


def _job(robot: str) -> str:
    """The job of ``view_urdf.py``: the URDF with absolute mesh paths, and a motion."""
    model = load_model(robot)
    paths = MeshPaths(None)
    urdf = re.sub(r'(?<=filename=")[^"]+', lambda uri: str(paths.find(uri[0])), model.urdf)
    source = SineSource(model)
    rows = [source.read(round(tick * 1e9 / RATE_HZ)).positions.tolist() for tick in range(ROWS)]
    return json.dumps({"urdf": urdf, "joints": model.joint_names, "rows": rows, "rate_hz": RATE_HZ})


def _publish_fleet() -> None:
    """Publishes ten robots, each a chain of revolute joints with a box on every link."""
    model = load_model(_chain_urdf(LINKS))
    source = SineSource(model)
    with connect() as session, ExitStack() as opened:
        fleet = [opened.enter_context(StatePublisher(session, model, f"r{n}")) for n in range(FLEET)]
        for place, robot in enumerate(fleet):
            statics = opened.enter_context(StaticPublisher(session, robot.robot))
            statics.set(
                Transform("hall/floor", f"{robot.robot}/{model.root}", (0.0, float(place), 0.0), UPRIGHT)
            )
        print("publishing", flush=True)
        for stamp in Rate(FLEET_HZ, SystemClock(), threading.Event()):
            reading = source.read(stamp)
            for publisher in fleet:
                publisher.publish(reading.positions, stamp=stamp)


def _chain_urdf(links: int) -> str:
    box = '<visual><origin xyz="0 0 0.05"/><geometry><box size="0.04 0.04 0.1"/></geometry></visual>'
    parts = [f'<link name="link{n}">{box}</link>' for n in range(links)]
    parts += [
        f'<joint name="joint{n}" type="revolute"><parent link="link{n - 1}"/><child link="link{n}"/>'
        f'<origin xyz="0 0 0.1"/><axis xyz="{n % 2} {1 - n % 2} 0"/>'
        '<limit lower="-0.3" upper="0.3" velocity="1" effort="1"/></joint>'
        for n in range(1, links)
    ]
    return f'<robot name="chain">{"".join(parts)}</robot>'


def _measure_chain(seconds: float, *, is_viewed: bool) -> None:
    """A publisher at 100 Hz and a listener that is woken by each sample, with a view or without."""
    command = (sys.executable, "-m", "bench.micro.chain", "--rates", str(LATENCY_RATE_HZ))
    command += ("--seconds", str(seconds + SETTLE_S), "--role")
    with ExitStack() as opened:
        if is_viewed:
            view = running_command("view", "--port", "0")
            _, first_line = opened.enter_context(view)
            opened.enter_context(ViewerClient(first_line.rpartition(" ")[2].strip()))
        roles = {
            role: subprocess.Popen([*command, role], stdout=subprocess.PIPE, text=True)
            for role in ("awake", "publisher")
        }
        reports = {role: json.loads(process.communicate()[0]) for role, process in roles.items()}
    listener, publisher = reports["awake"], reports["publisher"]
    print(
        f"panda at {LATENCY_RATE_HZ:g} Hz, {'with' if is_viewed else 'without'} an open view: "
        f"publisher {publisher['rate_hz']:.3f} Hz, {publisher['cpu']:.1f} % CPU; "
        f"listener {listener['cpu']:.1f} % CPU, "
        f"latency p50 {listener['p50_us']:.0f} us, p99 {listener['p99_us']:.0f} us, lost {listener['lost']}",
        flush=True,
    )


# A notice about the missing graphics card covers the picture.
_WITHOUT_NOTICES = """addEventListener("DOMContentLoaded", () => {
    const style = document.createElement("style");
    style.textContent = ".mantine-Notifications-root { display: none !important }";
    document.head.append(style);
})"""


def _shows_robot(pixels: NDArray[np.uint8]) -> bool:
    """Whether the left half has dark pixels; without a robot it shows a floor with light lines."""
    picture = pixels[:, : pixels.shape[1] // 2, :3]
    return bool((picture.max(axis=2) < 90).mean() > 0.005)


def _first_picture() -> None:
    """Prints the time from the command to the first picture of the robot."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=FLAGS)
        tab = browser.new_page(viewport={"width": 800, "height": 500})
        tab.goto("about:blank")
        tab.add_init_script(_WITHOUT_NOTICES)
        begin = time.monotonic()
        with running_command("view", "panda", "--sliders", "--port", "0") as (_, first_line):
            address_s = time.monotonic() - begin
            tab.goto(first_line.rpartition(" ")[2].strip())
            while not _shows_robot(np.asarray(Image.open(io.BytesIO(tab.screenshot())))):
                time.sleep(0.02)
            picture_s = time.monotonic() - begin
        browser.close()
    print(f"zstate view panda --sliders: address after {address_s:.2f} s, picture after {picture_s:.2f} s")


if __name__ == "__main__":
    main()
