"""View in a real browser: pixels at the links, shared widgets, and the token."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, repeated, until
from numpy.typing import NDArray

from zstate import StatePublisher, StaticPublisher, Transform, load_model
from zstate.cameras import Camera, CameraPublisher
from zstate.clouds import CloudPublisher
from zstate.model.geometry import read_shapes
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.odometry import OdometryPublisher
from zstate.scans import Grid, MapPublisher
from zstate.view.camera import FIELD_OF_VIEW, CameraPose, fit_camera
from zstate.view.data_source import ViewSource
from zstate.view.server import ViewServer
from zstate.view.view import View

pytest.importorskip("viser")

# Without a graphics card, and on a busy machine, a picture takes seconds.
pytestmark = [pytest.mark.browser, pytest.mark.processes, pytest.mark.timeout(300)]

Mask = NDArray[np.bool_]
PATIENCE_S = 4 * DEADLINE_S
NEAR = 25
"""A link's frame is inside its mesh, or at most so many pixels outside."""


@contextmanager
def standing(session: Session, robot: str) -> Iterator[None]:
    """A robot that publishes its neutral positions."""
    model = load_model(robot)
    with (
        StatePublisher(session, model, robot) as publisher,
        repeated(lambda: publisher.publish(model.neutral), every_s=0.05),
    ):
        yield


def field(view_tab, label: str):
    path = f'//label[normalize-space(.)="{label}"]/ancestor::div[2]//input[not(@type="hidden")]'
    return view_tab.tab.locator(f"xpath={path}").last


def choose(view_tab, label: str, option: str) -> None:
    """Selects an option of a dropdown by typing it."""
    field(view_tab, label).click()
    field(view_tab, label).fill(option)
    view_tab.tab.get_by_role("option", name=option, exact=True).click()


def shape_of(view_tab) -> tuple[int, int]:
    """The height and width of the canvas, in pixels."""
    box = view_tab.tab.locator("canvas").first.bounding_box()
    return round(box["height"]), round(box["width"])


def docked_shape_of(view_tab) -> tuple[int, int]:
    """The same, once the panel has taken its part of the window: the canvas has all of it before."""
    until(lambda: shape_of(view_tab)[1] < view_tab.tab.viewport_size["width"], PATIENCE_S)
    return shape_of(view_tab)


def picture(view_tab) -> NDArray[np.int16]:
    """The pixels of the canvas, when four pictures in a row are the same: a page shows a change late."""
    height, width = shape_of(view_tab)
    last, same = np.zeros(0), 1
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        pixels = view_tab.pixels()[:height, :width].astype(np.int16)
        same = same + 1 if last.shape == pixels.shape and changed(last, pixels).mean() < 1e-4 else 1
        if same == 4:
            return pixels
        last = pixels
    raise AssertionError("the picture keeps changing")


def until_fitted(shown) -> None:
    """Waits until the camera fits all frames, meshes and maps; the view fits it again after each."""

    def is_fitted() -> bool:
        scene, fitted = shown.view.scene, shown.view._fitted_to
        if scene.busy or shown.view._fitted_busy or fitted is None:
            return False
        tracks = tuple(shown.source.snapshot().tree.tracks_of)
        return (fitted[1][1], *fitted[2:]) == (tracks, scene.layout.version, scene.world.version)

    until(is_fitted, PATIENCE_S)


def changed(before: NDArray[np.int16], after: NDArray[np.int16]) -> Mask:
    return np.abs(before - after).max(axis=2) > 10


def pixels_of(points: NDArray[np.float64], framing: CameraPose, size: tuple[int, int]) -> NDArray[np.float64]:
    """Projects points into the picture of a camera, in pixels: right, down."""
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
@pytest.mark.parametrize("robot", ["panda", pytest.param("talos", marks=pytest.mark.soak)])
def test_robot_meshes_are_drawn_at_the_poses_of_their_links(robot: str, open_tab, show_view, sessions):
    with standing(sessions[0], robot):
        shown = show_view(sessions[1])
        until(lambda: robot in shown.source.models)
        view_tab = open_tab(shown.page.url)
        until_fitted(shown)

        def toggled(shows: bool):
            field(view_tab, "Visuals").click()
            until(lambda: shown.view.scene.visuals == shows)
            return picture(view_tab)

        # The camera is the fitted one once it does not move between two pictures without meshes. A page shows
        # a change some time after it was made: then the picture with meshes is another one.
        bare, full, again = toggled(False), toggled(True), toggled(False)
        deadline = time.monotonic() + DEADLINE_S
        while (changed(bare, again).any() or not changed(full, bare).any()) and time.monotonic() < deadline:
            bare, full, again = again, toggled(True), toggled(False)
        toggled(True)
        view_tab.save_screenshot(f"{robot}")
        surface = changed(full, bare)

        assert shown.view.scene.missing_meshes(robot) == ()
        snapshot = shown.source.snapshot()
        fixed = f"{robot}/{load_model(robot).root}"
        placed = snapshot.poses_in(fixed)
        framing = fit_camera(snapshot, placed, 1.0, shown.view.scene.corners(snapshot.tree, placed))
        assert framing is not None
        height, width = surface.shape
        drawn = {shape.link for shape in read_shapes(shown.source.models[robot])[0] if shape.role == "visual"}
        rows = [row for row, name in enumerate(snapshot.tree.names) if name.partition("/")[2] in drawn]
        places = pixels_of(placed[rows, :3], framing, (width, height))
        # Every link with a mesh is drawn at its frame ...
        for row, (x, y) in zip(rows, places.round().astype(int).tolist(), strict=True):
            near = surface[max(0, y - NEAR) : y + NEAR, max(0, x - NEAR) : x + NEAR]
            assert near.any(), f"nothing is drawn at {snapshot.tree.names[row]}"
        # ... nothing is drawn far from all of them, and there is light and dark in it.
        down, right = np.nonzero(surface)
        far = np.linalg.norm(np.stack((right, down), axis=1)[:, None] - places[None], axis=2).min(axis=1)
        assert np.percentile(far, 99) < 0.2 * height
        assert 0.03 < surface.mean() < 0.5
        assert full[surface].max(axis=1).min() < 80
        assert full[surface].min(axis=1).max() > 180


SLEDGE = """<robot name="sledge"><link name="rail"/>
<link name="plate"><visual><geometry><box size="0.02 0.3 0.3"/></geometry>
<material name="pink"><color rgba="1 0 1 1"/></material></visual></link>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="plate"/><origin xyz="0 0 1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="10" effort="1"/></joint></robot>"""


def test_axes_and_mesh_of_a_moving_link_are_of_one_instant(open_tab, show_view, sessions):
    model = parse_urdf(SLEDGE, "sledge.urdf")
    with (
        StatePublisher(sessions[0], model, "sledge") as publisher,
        repeated(lambda: publisher.publish([0.6 * math.sin(6.0 * time.monotonic())])),
    ):
        shown = show_view(sessions[1], "sledge")
        until(lambda: "sledge" in shown.source.models)
        view_tab = open_tab(shown.page.url)
        until_fitted(shown)
        height, width = docked_shape_of(view_tab)
        places: list[float] = []
        apart: list[float] = []

        def measure() -> bool:
            """The column of the plate, and how far its red axis, which begins there, is from it."""
            red, green, blue = np.moveaxis(view_tab.pixels()[:height, :width].astype(int), 2, 0)
            rows, plate = np.nonzero((red > 90) & (blue > 90) & (green < 60))
            if len(rows) > 100 and plate.min() > 0 and plate.max() < width - 1:  # it is in the picture
                beside = slice(rows.min(), rows.max())
                _, axis = np.nonzero(((red > 120) & (green < 60) & (blue < 60))[beside])
                if len(axis):
                    places.append(plate.mean())
                    apart.append(np.abs(axis - plate.mean()).min() / np.ptp(plate))
            return len(places) >= 6 and np.ptp(places) > 0.1 * width

        until(measure, PATIENCE_S)
        assert max(apart) < 0.25, "of the width of the plate"


def test_several_browsers_share_one_page_until_the_last_disconnects(open_tab, show_view, sessions):
    with standing(sessions[0], "rrbot"):
        shown = show_view(sessions[1], "rrbot")
        assert not shown.page.connected.is_set()
        view_tabs = [open_tab(shown.page.url, 640, 400), open_tab(shown.page.url, 700, 500)]
        for view_tab in view_tabs:
            view_tab.text("rrbot")
            view_tab.text("live,")
        until(lambda: len(shown.page.server.get_clients()) == 2)
        view_tabs[0].tab.close()
        until(lambda: len(shown.page.server.get_clients()) == 1)
        assert shown.page.connected.is_set()
        # All browsers share the widgets of one page.
        third = open_tab(shown.page.url, 640, 400)
        assert not field(third, "Names").is_checked()
        field(view_tabs[1], "Names").click()
        choose(view_tabs[1], "Fixed frame", "rrbot/tool")
        until(lambda: shown.view.scene.names)
        until(lambda: field(third, "Names").is_checked())
        until(lambda: field(third, "Fixed frame").input_value() == "rrbot/tool")
        third.tab.close()
        view_tabs[1].tab.close()
        until(lambda: not shown.page.connected.is_set())


def test_beyond_loopback_a_browser_needs_the_token(browser, open_tab, sessions):
    with (
        ViewSource(sessions[1], ["rrbot"]) as source,
        ViewServer("0.0.0.0", 0) as page,
        View(source, page) as view,
    ):
        view.draw()
        without_token = browser.new_page()
        without_token.goto(f"http://127.0.0.1:{page.port}/")
        assert "requires its token" in without_token.locator("body").inner_text()
        without_token.close()
        view_tab = open_tab(f"http://127.0.0.1:{page.port}/?token={page.access.token}", 640, 400)
        until(page.connected.is_set)
        view.draw()
        view_tab.text("No robot is announced")


def test_ellipse_of_a_base_is_drawn_where_it_is(open_tab, show_view, sessions):
    # sqrt(5.991) times the standard deviations: 0.73 and 0.37 m.
    half_axes = np.sqrt(5.991 * np.array([0.09, 0.0225]))
    covariance = np.diag([0.09, 0.0225, 0.01, 0.01, 0.01, 0.01])
    world = Transform("odom", "world", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)).with_covariance(covariance)
    still = ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    with (
        standing(sessions[0], "rrbot"),
        OdometryPublisher(sessions[0], "rrbot") as odometry,
        repeated(lambda: odometry.publish(world, *still), every_s=0.05),
    ):
        shown = show_view(sessions[1], "rrbot")
        until(lambda: {"rrbot/odom", "rrbot/tool"} <= set(shown.source.snapshot().tree.names))
        view_tab = open_tab(shown.page.url)
        until_fitted(shown)
        # The page has the fitted camera when a click has come through it.
        field(view_tab, "Odometry").click()
        until(lambda: not shown.view.scene.odometry.is_on)
        bare = picture(view_tab)
        field(view_tab, "Odometry").click()
        until(lambda: shown.view.scene.odometry.is_on)

        snapshot = shown.source.snapshot()
        placed = snapshot.poses_in("rrbot/odom")
        framing = fit_camera(snapshot, placed, 1.0, shown.view.scene.corners(snapshot.tree, placed))
        assert framing is not None
        angles = np.linspace(0.0, 2.0 * math.pi, 40)
        ring = np.stack((np.cos(angles) * half_axes[0], np.sin(angles) * half_axes[1], 0.0 * angles), axis=1)
        height, width = bare.shape[:2]
        pixels = pixels_of(ring, framing, (width, height)).round().astype(int).tolist()

        def drawn_part() -> float:
            drawn = changed(bare, picture(view_tab))
            return np.mean([drawn[max(0, y - 3) : y + 4, max(0, x - 3) : x + 4].any() for x, y in pixels])

        until(lambda: drawn_part() > 0.9, PATIENCE_S)
        view_tab.save_screenshot("ellipse")


def test_map_and_scan_are_drawn_where_they_are(open_tab, show_view, sessions):
    # 2 x 2 m around the arm; the cells with x > 0 and y > 0 are occupied, those with x < 0 and y < 0 unknown.
    grid = Grid([[-1, 0], [0, 100]], 1.0, (-1.0, -1.0, 0.0), "rrbot/world")
    with standing(sessions[0], "rrbot"), MapPublisher(sessions[0], "room", grid):
        shown = show_view(sessions[1], "rrbot")
        world = shown.view.scene.world
        until(lambda: shown.source.world.maps_at(None) and "rrbot" in shown.source.models)
        view_tab = open_tab(shown.page.url)
        until(lambda: world.version == 1, PATIENCE_S)
        until_fitted(shown)
        snapshot = shown.source.snapshot()
        placed = snapshot.poses_in("rrbot/world")
        corners = np.array([(x, y, 0.0) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
        meshes = shown.view.scene.corners(snapshot.tree, placed)
        framing = fit_camera(snapshot, placed, 1.0, meshes, corners)
        assert framing is not None
        height, width = docked_shape_of(view_tab)
        middles = np.array([(0.7, 0.7, 0.0), (-0.7, -0.7, 0.0), (0.7, -0.7, 0.0)])
        occupied, unknown, free = pixels_of(middles, framing, (width, height)).round().astype(int).tolist()

        def lightness(at: list[int]) -> list[int]:
            return view_tab.pixels()[at[1], at[0]].tolist()

        # A page shows a change late: each picture is awaited, with the map, without and with it again.
        until(lambda: max(lightness(occupied)) < 60, PATIENCE_S)
        field(view_tab, "Maps").click()
        until(lambda: not world.maps)
        until(lambda: min(lightness(occupied)) > 180, PATIENCE_S)
        field(view_tab, "Maps").click()
        until(lambda: world.maps)
        until(lambda: max(lightness(occupied)) < 60, PATIENCE_S)
        view_tab.save_screenshot("map")
        for place in (unknown, free):
            assert min(lightness(place)) > 180


def test_cloud_is_drawn_where_it_is_and_vanishes_by_the_checkbox(open_tab, show_view, sessions):
    # A wall of points a millimetre apart, 0.2 x 0.2 m, beside the arm.
    across, up = np.meshgrid(np.linspace(0.5, 0.7, 200), np.linspace(0.5, 0.7, 200))
    points = np.stack([np.zeros(across.size), across.ravel(), up.ravel()], axis=1)
    middle = np.array([[0.0, 0.6, 0.6]])
    with (
        standing(sessions[0], "rrbot"),
        CloudPublisher(sessions[0], "rrbot", "lidar", frame="world") as lidar,
        repeated(lambda: lidar.publish(points), every_s=0.1),
    ):
        shown = show_view(sessions[1], "rrbot")
        clouds = shown.view.scene.clouds
        until(lambda: "rrbot" in shown.source.models, PATIENCE_S)
        view_tab = open_tab(shown.page.url)
        until(lambda: clouds.has_any, PATIENCE_S)
        until_fitted(shown)
        snapshot = shown.source.snapshot()
        placed = snapshot.poses_in("rrbot/world")
        framing = fit_camera(snapshot, placed, 1.0, shown.view.scene.corners(snapshot.tree, placed))
        assert framing is not None
        height, width = docked_shape_of(view_tab)
        ((x, y),) = pixels_of(middle, framing, (width, height)).round().astype(int).tolist()

        def is_drawn() -> bool:
            pixel = view_tab.pixels()[y, x].astype(int)
            return pixel.max() - pixel.min() > 60  # coloured

        until(is_drawn, PATIENCE_S)
        view_tab.save_screenshot("cloud")
        field(view_tab, "Draw clouds").click()
        until(lambda: not clouds.is_on, PATIENCE_S)
        until(lambda: not is_drawn(), PATIENCE_S)


def test_picture_is_shown_in_the_tab_and_on_the_frustum(open_tab, show_view, sessions):
    # A red picture of a camera beside the arm, which looks at it along -y of the world.
    red = np.tile(np.array([200, 20, 20], np.uint8), (48, 64, 1))
    camera = Camera(64, 48, (60.0, 60.0, 31.5, 23.5), frame="lens")
    turn = (0.0, math.sqrt(0.5), -math.sqrt(0.5), 0.0)
    with (
        standing(sessions[0], "rrbot"),
        StaticPublisher(sessions[0], "rrbot", "mount") as mount,
        CameraPublisher(sessions[0], "rrbot", "wrist", camera) as publisher,
        repeated(lambda: publisher.publish(red), every_s=0.1),
    ):
        mount.set(Transform("world", "lens", (0.0, 3.0, 1.0), turn))
        shown = show_view(sessions[1], "rrbot")
        until(lambda: "rrbot" in shown.source.models)
        view_tab = open_tab(shown.page.url)
        until(lambda: shown.view.scene.cameras.shown)
        until_fitted(shown)

        def red_parts() -> tuple[bool, bool]:
            """Whether there is red in the scene, and in the panels."""
            height, width = shape_of(view_tab)
            pixels = view_tab.pixels().astype(int)
            is_red = (pixels[:, :, 0] > 150) & (pixels[:, :, 1:].max(axis=2) < 60)
            return is_red[:height, : width - 20].sum() > 200, is_red[:, width:].sum() > 2000

        view_tab.text("Cameras", exact=True).click()
        until(lambda: all(red_parts()), PATIENCE_S)
        view_tab.text("64 x 48 jpeg")
        view_tab.save_screenshot("picture")

        # The outline of the arm, which the camera sees, is green.
        def has_green() -> bool:
            _, width = shape_of(view_tab)
            red, green, blue = np.moveaxis(view_tab.pixels().astype(int)[150:, width:], -1, 0)
            return (green - np.maximum(red, blue) > 40).sum() > 30

        assert not has_green()
        field(view_tab, "Model over picture").click()
        until(lambda: shown.view.scene.cameras.models)
        until(has_green, PATIENCE_S)
        view_tab.save_screenshot("picture_model")
        field(view_tab, "Model over picture").click()
        field(view_tab, "Frustums").click()
        until(lambda: not shown.view.scene.cameras.frustums)
        until(lambda: red_parts() == (False, True), PATIENCE_S)


def test_map_without_any_frame_is_drawn_in_its_own(open_tab, show_view, sessions):
    grid = Grid(np.full((4, 4), 100), 0.5, (30.0, 20.0, 0.0), "map")
    with MapPublisher(sessions[0], "room", grid):
        shown = show_view(sessions[1])
        view_tab = open_tab(shown.page.url)
        until(lambda: shown.view.scene.world.version == 1, PATIENCE_S)
        until(lambda: np.count_nonzero(picture(view_tab).max(axis=2) < 60) > 5000, PATIENCE_S)
