"""The panels in a real browser: typing, dragging and reading."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
import viser
from helpers.processes import repeated
from helpers.processes import until as until_then

from zstate import Transform, TransformPublisher
from zstate.model.load import load_model
from zstate.model.urdf import parse_urdf
from zstate.net.discovery import discover
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.sources import OdometrySource, SquareDrive, WheelPair, WheelSource
from zstate.view.sliders import SliderPublisher

pytestmark = [pytest.mark.browser, pytest.mark.processes]

TIMEOUT_S = 45.0
"""A browser without a graphics card, on a busy machine."""

RRBOT = load_model("rrbot")
SHOULDER, ELBOW = RRBOT.joint_names

DRIVER = """
    from zstate import SineSource, StatePublisher, connect, load_model
    model = load_model("rrbot")
    with connect() as session, StatePublisher(session, model, "r1", program="driver") as publisher:
        publisher.publish([0.0, 0.0])
        print("writing", flush=True)
        publisher.run(SineSource(model), 50.0)
"""


def until(condition: Callable[[], object]) -> None:
    until_then(condition, TIMEOUT_S)


class Panels:
    """The panels of one page; inputs are found by their labels."""

    def __init__(self, view_tab) -> None:
        self.view_tab = view_tab
        self.tab = view_tab.tab
        self.tab.set_default_timeout(TIMEOUT_S * 1e3)
        view_tab.text("Frames", exact=True)

    def open(self, name: str) -> None:
        """Select a tab of the panels."""
        self.tab.get_by_text(name, exact=True).first.click()

    def field(self, label: str):
        """The input with this label; for a slider, its number box."""
        path = f'//label[normalize-space(.)="{label}"]/ancestor::div[2]//input[not(@type="hidden")]'
        return self.tab.locator(f"xpath={path}").last

    def choose(self, label: str, option: str) -> None:
        """Select an option of a dropdown by typing it."""
        self.field(label).click()
        self.field(label).fill(option)
        self.tab.get_by_role("option", name=option, exact=True).click()

    def press(self, button: str) -> None:
        self.tab.get_by_role("button", name=button, exact=True).click()

    def row(self, name: str, place: int = 0) -> str:
        """The value next to a name in a table of the panels; empty if there is none."""
        cells = self.tab.locator(f'xpath=//td[normalize-space(.)="{name}"]/following-sibling::td[1]')
        return cells.nth(place).inner_text() if cells.count() > place else ""

    def numbers(self, name: str, place: int = 0) -> list[float]:
        return [float(text) for text in self.row(name, place).split()]


@pytest.fixture
def panels(open_tab, show_view) -> Callable[..., Panels]:
    def opened(session, *robots: str, **options: Any) -> Panels:
        return Panels(open_tab(show_view(session, *robots, **options).page.url))

    return opened


def test_slider_moves_the_joint_and_the_displayed_link_pose(panels, sessions):
    with SliderPublisher(sessions[0], RRBOT, "r1") as sliders:
        page = panels(sessions[1], "r1", sliders=[sliders])
        page.field(SHOULDER).fill("0.5")
        page.field(ELBOW).fill("-0.25")
        until(lambda: sliders.positions.tolist() == [0.5, -0.25])
        page.open("Frames")
        page.choose("Pose of", "r1/lower")
        page.choose("in frame", "r1/base")
        # Both joints rotate about y: the angles add up to the pitch.
        until(lambda: page.numbers("rpy [rad]", 1) == [0.0, 0.5 - 0.25, 0.0])
        page.view_tab.save_screenshot("panels_readout")
        page.open("Joints")
        page.choose("Angles in", "deg")
        until(lambda: page.field(SHOULDER).input_value() == f"{math.degrees(0.5):.1f}")
        page.press("Home")
        until(lambda: sliders.positions.tolist() == [0.0, 0.0])
        until(lambda: page.field(SHOULDER).input_value() == "0")
        page.press("Sine")
        until(lambda: sliders.sine_enabled)
        page.choose("Joint", SHOULDER)
        page.tab.locator(".uplot canvas").first.wait_for()
        page.view_tab.save_screenshot("panels_joints")


def test_conflicting_writer_is_named_by_the_sliders(panels, sessions):
    with (
        StatePublisher(sessions[0], RRBOT, "r1", program="driver") as driver,
        SliderPublisher(sessions[1], RRBOT, "r1") as sliders,
    ):
        driver.publish([0.0, 0.0])
        page = panels(sessions[1], "r1", sliders=[sliders])
        assert "driver@" in page.view_tab.text("r1 is not published").inner_text()
        page.view_tab.save_screenshot("panels_refused")
        driver.close()
        until(lambda: not discover(sessions[0], 0.2))
        page.press("Try again")
        page.view_tab.text("Publishing r1 at 50 Hz")


def test_sliders_command_a_driver_only_in_control_and_the_stop_button_ends_that(
    panels, sessions, host_driver
):
    host = host_driver()
    page = panels(sessions[1], "arm", can_command=True)
    page.view_tab.text("Driver of arm: ready")
    page.view_tab.text("The sliders follow the joints")
    page.field(ELBOW).fill("0.5")
    until(lambda: page.field(ELBOW).input_value() == "0")
    page.press("Command arm by sliders")
    page.view_tab.text("In control: nothing is sent until a slider is moved.")
    assert host.report().written == 0
    page.field(ELBOW).fill("0.25")
    with TransformListener(sessions[1], "arm") as listener:
        listener.buffer.wait("base", "lower", timeout_s=TIMEOUT_S)
        until(lambda: listener.buffer.joint_positions("arm")[0].tolist() == [0.0, 0.25])
    page.view_tab.text("Driver of arm: active, commanded by zstate view@")
    page.view_tab.save_screenshot("panels_driver")
    page.press("STOP arm")
    assert "the stop button" in page.view_tab.text("Driver of arm: stopped by").inner_text()
    page.press("Command arm by sliders")
    page.view_tab.text("In control of a stopped driver")
    page.view_tab.save_screenshot("panels_driver_stopped")
    written = host.report().written
    page.press("Release the stop")
    page.view_tab.text("Driver of arm: ready: released by zstate view@")
    assert host.report().written == written
    page.field(ELBOW).fill("-0.25")
    until(lambda: host.state == "active")
    page.tab.close()
    until(lambda: host.state == "holding")


def test_stop_button_works_after_another_browser_has_tried_to_switch_it_off(
    open_tab, show_view, sessions, host_driver
):
    host = host_driver()
    shown = show_view(sessions[1], "arm")
    mine, theirs = (Panels(open_tab(shown.page.url, 640, 480)) for _ in range(2))
    theirs.view_tab.text("Driver of arm: ready")
    gui = shown.page.server.gui
    (stop,) = [one for one in gui._gui_input_handle_from_uuid.values() if one.label == "STOP arm"]
    hostile = """([url, protocol, messages]) => new Promise((done) => {
        const socket = new WebSocket(url, protocol);
        socket.onopen = () => {
            messages.forEach((bytes) => socket.send(new Uint8Array(bytes)));
            socket.onmessage = () => done();
        };
    })"""
    messages = [
        list(
            msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": stop._impl.uuid, "updates": updates})
        )
        for updates in ({"update_cb": []}, {"removed": True})
    ]
    address = shown.page.url.replace("http:", "ws:")
    mine.tab.evaluate(hostile, [address, f"viser-v{viser.__version__}", messages])
    theirs.press("STOP arm")
    assert "the stop button" in theirs.view_tab.text("Driver of arm: stopped by").inner_text()
    assert host.state == "stopped"


def test_frame_search_selects_a_frame_and_its_pose_follows_the_fixed_frame(panels, sessions):
    panda = load_model("panda")
    with StatePublisher(sessions[0], panda, "panda", program="driver") as driver:
        driver.publish(panda.neutral)
        page = panels(sessions[1], "panda")
        page.open("Frames")
        page.field("Search").fill("leftfing")
        until(lambda: page.field("Frame").input_value() == "panda/panda_leftfinger")
        until(lambda: page.row("parent") == "panda/panda_hand")
        assert page.row("in") == "panda/panda_link0"
        assert page.row("kind") == "joint"
        assert page.row("writer").startswith("driver@")
        page.open("View")
        page.choose("Fixed frame", "panda/panda_hand")
        page.open("Frames")
        until(lambda: page.row("in") == "panda/panda_hand")
        (finger,) = [joint for joint in panda.joints if joint.child == "panda_leftfinger"]
        # At home the finger is at the origin of its joint.
        until(lambda: page.numbers("xyz [m]") == [round(value, 4) for value in finger.origin[:3]])
        page.view_tab.save_screenshot("panels_frames")


def test_robot_of_a_killed_publisher_is_shown_as_silent(panels, sessions, spawn):
    driver = spawn(DRIVER)
    assert driver.line() == "writing"
    page = panels(sessions[1], "r1")
    page.view_tab.text("live,")
    driver.kill()
    text = page.view_tab.text("silent for").inner_text()
    assert re.search(r"silent for \d+ s, since \d\d:\d\d:\d\d", text)
    page.view_tab.save_screenshot("panels_silent")


def test_tracked_object_without_a_model_is_shown_and_becomes_stale(panels, sessions):
    with TransformPublisher(sessions[0], "cam", "tracker") as tracker:
        cup, box = (
            Transform("room", name, (x, 0.2, 0.4), (0.0, 0.0, 0.0, 1.0))
            for name, x in (("cup", 0.3), ("box", -0.3))
        )
        with repeated(lambda: tracker.publish([cup, box]), every_s=0.05):
            page = panels(sessions[1])
            until(lambda: re.fullmatch(r"live, [\d.]+ Hz, transforms only", page.row("cam")))
            page.view_tab.save_screenshot("panels_transforms_only")
        until(lambda: re.match(r"silent for [1-9]", page.row("cam")))
        page.view_tab.text("2 edges are stale", exact=True)
        page.view_tab.save_screenshot("panels_transforms_silent")


def test_mobile_robot_is_stale_without_its_odometry(panels, sessions):
    drive, model = SquareDrive(WheelPair(0.08, 0.32)), load_model("diffbot")
    with (
        StatePublisher(sessions[0], model, "rover") as wheels,
        TransformPublisher(sessions[0], "rover", "odometry") as odometry,
    ):
        source, edge = WheelSource(drive), OdometrySource(drive, "odom", model.root)
        with repeated(lambda: wheels.publish(source.read(time.time_ns()).positions), every_s=0.05):
            with repeated(lambda: odometry.publish(edge.read(time.time_ns())), every_s=0.05):
                page = panels(sessions[1])
                until(lambda: page.row("rover").startswith("live, "))
                page.view_tab.save_screenshot("panels_rover")
            until(lambda: re.match(r"its place: silent for [1-9]", page.row("rover")))
            page.view_tab.text("rover/odom -> rover/base_footprint: silent for")
            page.view_tab.save_screenshot("panels_rover_without_odometry")


def test_time_is_paused_and_returns_to_live(panels, sessions, spawn):
    assert spawn(DRIVER).line() == "writing"
    page = panels(sessions[1], "r1")
    page.open("Time")
    page.press("Pause")
    page.view_tab.text("Paused at")
    page.open("Frames")
    page.field("Search").fill("lower")
    until(lambda: page.row("parent"))

    def still() -> bool:
        # The page is updated five times a second.
        before = page.row("quat xyzw")
        page.tab.wait_for_timeout(1000)
        return page.row("quat xyzw") == before

    until(still)
    page.open("Time")
    page.press("Live")
    page.view_tab.text("Live", exact=True)
    page.open("Frames")
    before = page.row("quat xyzw")
    until(lambda: page.row("quat xyzw") != before)


def test_names_from_the_network_are_shown_and_not_executed(panels, sessions):
    name = "<img src=x onerror=document.title=1>"
    quoted = name.replace("<", "&lt;").replace(">", "&gt;")
    urdf = f"""<robot name="r1"><link name="base"/><link name="{quoted}"/>
        <joint name="j" type="continuous"><parent link="base"/><child link="{quoted}"/></joint></robot>"""
    with StatePublisher(sessions[0], parse_urdf(urdf, "r1.urdf"), "r1") as publisher:
        publisher.publish([0.0])
        page = panels(sessions[1], "r1")
        page.open("Frames")
        page.field("Search").fill("onerror")
        until(lambda: "onerror" in page.field("Frame").input_value())
        until(lambda: page.row("parent") == "r1/base")
        assert page.tab.locator('img[src="x"]').count() == 0
        assert page.tab.title() != "1"


def test_graph_tab_lists_writers_of_streams(panels, sessions):
    with StatePublisher(sessions[0], RRBOT, "r1", program="driver") as driver:
        driver.publish([0.0, 0.0])
        page = panels(sessions[1], "r1")
        page.open("Graph")
        until(lambda: page.row("written by").startswith("driver@"))
        page.view_tab.save_screenshot("panels_graph")
