"""Robots in a real browser: they are drawn where they are, by whoever looks."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, repeated, until
from numpy.typing import NDArray

from zstate import StatePublisher, load_model
from zstate.model.geometry import parse_shapes
from zstate.net.session import Session
from zstate.view.camera import FIELD_OF_VIEW, CameraPose, fit_camera
from zstate.view.data_source import ViewSource
from zstate.view.server import ViewServer
from zstate.view.view import View

pytest.importorskip("viser")

# Without a graphics card, and with others at work, a picture takes seconds.
pytestmark = [pytest.mark.browser, pytest.mark.processes, pytest.mark.timeout(300)]

Mask = NDArray[np.bool_]
PATIENCE_S = 4 * DEADLINE_S
NEAR = 25
"""A link's frame is inside its mesh, or not far from it: so many pixels."""


@contextmanager
def standing(session: Session, robot: str) -> Iterator[None]:
    """A robot that publishes all the time where it stands."""
    model = load_model(robot)
    with (
        StatePublisher(session, model, robot) as publisher,
        repeated(lambda: publisher.publish(model.neutral), every_s=0.05),
    ):
        yield


def field(looker, label: str):
    return looker.tab.locator(f'xpath=//label[normalize-space(.)="{label}"]/ancestor::div[2]//input').last


def picture(looker) -> NDArray[np.int16]:
    """What is drawn, once it stands still."""
    box = looker.tab.locator("canvas").first.bounding_box()
    last = np.zeros(0)
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        pixels = looker.pixels()[: round(box["height"]), : round(box["width"])].astype(np.int16)
        if last.shape == pixels.shape and changed(last, pixels).mean() < 1e-4:
            return pixels
        last = pixels
    raise AssertionError("the picture does not stand still")


def changed(before: NDArray[np.int16], after: NDArray[np.int16]) -> Mask:
    return np.abs(before - after).max(axis=2) > 10


def pixels_of(points: NDArray[np.float64], framing: CameraPose, size: tuple[int, int]) -> NDArray[np.float64]:
    """Where a camera that stands and looks so sees points, in pixels: right, down."""
    width, height = size
    ahead = np.subtract(framing.look_at, framing.position)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    rays = points - framing.position
    seen = np.stack((rays @ right, rays @ down), axis=1) / (rays @ ahead)[:, None]
    return seen * 0.5 * height / math.tan(0.5 * FIELD_OF_VIEW) + (0.5 * width, 0.5 * height)


@pytest.mark.robots
@pytest.mark.parametrize("robot", ["panda", "talos"])
def test_a_robot_is_drawn_with_its_meshes_where_its_links_are(robot: str, look, show, sessions):
    with standing(sessions[0], robot):
        shown = show(sessions[1])
        until(lambda: robot in shown.world.models)
        looker = look(shown.page.url)
        until(lambda: not shown.view.scene.busy, PATIENCE_S)
        full = picture(looker)
        looker.keep(f"{robot}")
        field(looker, "Visuals").click()
        until(lambda: not shown.view.scene.visuals)
        bare = picture(looker)
        surface = changed(full, bare)

        assert shown.view.scene.missing_meshes(robot) == ()
        moment = shown.world.moment()
        fixed = f"{robot}/{load_model(robot).root}"
        placed = moment.poses_in(fixed)
        framing = fit_camera(moment, placed, 1.0, shown.view.scene.corners(moment.tree, placed))
        assert framing is not None
        height, width = surface.shape
        drawn = {shape.link for shape in parse_shapes(shown.world.models[robot]) if shape.role == "visual"}
        rows = [row for row, name in enumerate(moment.tree.names) if name.partition("/")[2] in drawn]
        places = pixels_of(placed[rows, :3], framing, (width, height))
        # Every link that has a mesh is seen where its frame is ...
        for row, (x, y) in zip(rows, places.round().astype(int).tolist(), strict=True):
            near = surface[max(0, y - NEAR) : y + NEAR, max(0, x - NEAR) : x + NEAR]
            assert near.any(), f"nothing is drawn at {moment.tree.names[row]}"
        # ... nothing is drawn far from all of them, and there is light and dark in it.
        down, right = np.nonzero(surface)
        far = np.linalg.norm(np.stack((right, down), axis=1)[:, None] - places[None], axis=2).min(axis=1)
        assert np.percentile(far, 99) < 0.2 * height
        assert 0.03 < surface.mean() < 0.5
        assert full[surface].max(axis=1).min() < 80
        assert full[surface].min(axis=1).max() > 180


def test_several_browsers_look_at_once_and_nothing_is_drawn_for_nobody(look, show, sessions):
    with standing(sessions[0], "rrbot"):
        shown = show(sessions[1], "rrbot")
        assert not shown.page.connected.is_set()
        lookers = [look(shown.page.url, 640, 400), look(shown.page.url, 700, 500)]
        for looker in lookers:
            looker.text("rrbot")
            looker.text("live,")
        until(lambda: len(shown.page.server.get_clients()) == 2)
        lookers[0].tab.close()
        until(lambda: len(shown.page.server.get_clients()) == 1)
        assert shown.page.connected.is_set()
        # What is chosen in one is seen in the other: it is one page.
        field(lookers[1], "Names").click()
        until(lambda: shown.view.scene.names)
        third = look(shown.page.url, 640, 400)
        until(lambda: field(third, "Names").is_checked())
        third.tab.close()
        lookers[1].tab.close()
        until(lambda: not shown.page.connected.is_set())


def test_beyond_loopback_a_browser_needs_the_address_with_the_token(browser, look, sessions):
    with (
        ViewSource(sessions[1], ["rrbot"]) as world,
        ViewServer("0.0.0.0", 0) as page,
        View(world, page) as view,
    ):
        view.draw()
        stranger = browser.new_page()
        stranger.goto(f"http://127.0.0.1:{page.port}/")
        assert "asks for its token" in stranger.locator("body").inner_text()
        stranger.close()
        looker = look(f"http://127.0.0.1:{page.port}/?token={page.door.token}", 640, 400)
        until(page.connected.is_set)
        view.draw()
        looker.text("No robot is announced")
