"""Writes view.webp, the moving picture of the front page: two robots in the page of `zstate view`.

python docs/moving_picture.py

The robots are published posture by posture, and each picture is taken after the page has drawn its posture:
a slow machine writes the same pictures. Needs Chromium, and pip install -e '.[robots,test]'.
"""

from __future__ import annotations

import io
import math
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Locator, Page, sync_playwright

import zstate

FILE = Path(__file__).with_name("view.webp")
SIZE = {"width": 960, "height": 540}
PICTURES = 40
PERIOD_S = 4.0
WARM_UP = PICTURES
"""Postures before the first picture, so that the trail of the hand is complete in it."""
DRAWN_WITHIN_S = 0.5
OPENED_WITHIN_S = 60.0
UNPACKED_WITHIN_S = 15.0
"""The browser unpacks meshes one after the other, and reports none of them."""
QUALITY = 55
FLAGS = [
    "--hide-scrollbars",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]

CAMERA = "3.3,1.5,1.5:0.1,0.3,0.82"
FLOOR = "hall/floor"
CHOSEN = {
    "Frame": "panda/panda_hand",
    "Pose of": "panda/panda_hand",
    "in frame": "talos/gripper_left_base_link",
}
ROOTS = {"panda": ("panda_link0", (0.55, 0.85, 0.0)), "talos": ("base_link", (0.0, -0.15, 1.02))}


def posture(phase: float) -> dict[str, dict[str, float]]:
    """The joint positions of both robots [rad], the others at zero; 0 and 2 pi are the same."""
    s, c = math.sin(phase), math.cos(phase)
    panda = {
        "panda_joint1": 0.6 * s,
        "panda_joint2": 0.35 * c - 0.5,
        "panda_joint4": 0.4 * c - 2.1,
        "panda_joint6": 0.25 * s + 1.7,
        "panda_joint7": 0.78,
        "panda_finger_joint1": 0.03,
    }
    talos = {
        "head_1_joint": 0.1 * s + 0.2,
        "head_2_joint": 0.5 * s,
        "torso_1_joint": 0.2 * s,
        "arm_left_1_joint": 0.2 * s + 0.3,
        "arm_left_2_joint": 0.35,
        "arm_left_4_joint": -0.4 * s - 1.5,
        "arm_right_1_joint": 0.2 * s - 0.3,
        "arm_right_2_joint": -0.35,
        "arm_right_4_joint": 0.4 * s - 1.5,
    }
    for side in ("left", "right"):
        bent = {"3": -0.4, "4": 0.8, "5": -0.4}
        talos |= {f"leg_{side}_{joint}_joint": angle for joint, angle in bent.items()}
    return {"panda": panda, "talos": talos}


class Robots:
    """Publishes both robots 50 times a second in the ``phase`` of their motion, until it is closed."""

    def __init__(self, session: zstate.Session) -> None:
        self.phase = 0.0
        self._opened = ExitStack()
        self._publishers: dict[str, zstate.StatePublisher] = {}
        edges = self._opened.enter_context(zstate.StaticPublisher(session, "hall"))
        for name, (root, xyz) in ROOTS.items():
            publisher = zstate.StatePublisher(session, zstate.load_model(name), name)
            self._publishers[name] = self._opened.enter_context(publisher)
            edges.set(zstate.Transform(FLOOR, f"{name}/{root}", xyz, (0, 0, 0, 1)))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.02):
            for name, positions in posture(self.phase).items():
                joints = self._publishers[name].model.joint_names
                self._publishers[name].publish(dict.fromkeys(joints, 0.0) | positions)

    def __enter__(self) -> Robots:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._opened.close()


@contextmanager
def view() -> Generator[str]:
    """The address of `zstate view`."""
    command = [
        sys.executable,
        "-u",
        "-m",
        "zstate",
        "view",
        "--port",
        "0",
        "--fixed-frame",
        FLOOR,
        "--camera",
        CAMERA,
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        try:
            yield process.stdout.readline().split()[-1]
        finally:
            process.terminate()


def field(page: Page, label: str) -> Locator:
    """The input with this label."""
    path = f'//label[normalize-space(.)="{label}"]/ancestor::div[2]//input[not(@type="hidden")]'
    return page.locator(f"xpath={path}").last


@contextmanager
def browser(url: str) -> Generator[Page]:
    """The page in a browser without a screen: a trail, and the pose of one robot's hand in the other's."""
    with sync_playwright() as playwright:
        flags = [*FLAGS, "--no-sandbox"] if os.geteuid() == 0 else FLAGS
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        page = chromium.new_page(viewport=SIZE)
        page.set_default_timeout(1e3 * OPENED_WITHIN_S)
        page.goto(url)
        page.locator(".mantine-Notification-closeButton").click()  # "Software WebGL rendering detected"
        page.get_by_text("Frames", exact=True).first.click()
        for label, frame in CHOSEN.items():
            field(page, label).click()
            field(page, label).fill(frame)
            page.get_by_role("option", name=frame, exact=True).click()
        field(page, "Trail").click()
        page.mouse.move(SIZE["width"] - 20, 250)  # over nothing that shows its name
        page.wait_for_timeout(1e3 * UNPACKED_WITHIN_S)
        yield page
        chromium.close()


def pictures(robots: Robots, page: Page) -> list[Image.Image]:
    """One period of the motion."""
    taken: list[Image.Image] = []
    for n in range(-WARM_UP, PICTURES):
        robots.phase = math.tau * n / PICTURES
        page.wait_for_timeout(1e3 * (DRAWN_WITHIN_S if n >= -1 else 0.2))
        if n >= 0:
            taken.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    return taken


def main() -> None:
    """Writes the file."""
    with zstate.connect() as session, Robots(session) as robots, view() as url, browser(url) as page:
        first, *others = pictures(robots, page)
    duration = round(1e3 * PERIOD_S / PICTURES)
    first.save(
        FILE, save_all=True, append_images=others, duration=duration, loop=0, quality=QUALITY, method=6
    )
    print(f"{FILE}: {len(others) + 1} pictures, {FILE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
