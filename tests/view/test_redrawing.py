"""The view goes on drawing, whatever happens to the robots that it draws."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT

pytest.importorskip("viser")

from zstate import StatePublisher, StaticPublisher, Transform, load_model
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.snapshot import FramePoses
from zstate.view.camera import Camera, Visibility, fit_camera
from zstate.view.data_source import ViewSource
from zstate.view.server import ViewServer
from zstate.view.view import View

CART = load_model("diffbot")
STILL = [0.0, 0.0, 0.0, 1.0]


@contextmanager
def drawing(view: View, page: ViewServer) -> Iterator[threading.Thread]:
    """``view.run`` in a thread of its own, at full rate as if a browser showed the page."""
    page.connected.set()
    stop = threading.Event()
    thread = threading.Thread(target=view.run, args=(stop,), daemon=True)
    thread.start()
    try:
        yield thread
    finally:
        stop.set()
        thread.join(5.0)
        page.connected.clear()


class FailingWorld(ViewSource):
    """A world that cannot be read while ``fails``."""

    fails = False
    tries = 0

    def snapshot(self, at: int | None = None) -> FramePoses:
        self.tries += 1
        if self.fails:
            raise ValueError(f"try number {self.tries}")
        return super().snapshot(at)


def test_a_picture_that_fails_is_logged_once_shown_on_the_page_and_tried_again(page, caplog):
    buffer = TransformBuffer()
    buffer.insert_static(Transform("map", "camera", [1, 0, 0], STILL))
    with FailingWorld(None, buffer=buffer) as world, View(world, page) as view, drawing(view, page) as thread:
        until(lambda: world.tries > 3)
        assert not view.fault
        world.fails = True
        until(lambda: "ValueError: try number" in view.fault)
        tried = world.tries
        until(lambda: world.tries > tried + 3)
        world.fails = False
        until(lambda: not view.fault)
        assert thread.is_alive()
    (logged,) = [record.getMessage() for record in caplog.records]
    assert "failed to draw a picture (ValueError: try number" in logged
    assert "test_redrawing.py, line" in logged


def test_robots_of_a_fleet_restart_come_and_go_while_they_are_drawn(page, sessions, caplog):
    """At random: publishers of two models, and static edges that are set again and elsewhere."""
    random = np.random.default_rng(7)
    publishers: dict[str, StatePublisher] = {}
    with ExitStack() as opened:
        world = opened.enter_context(FailingWorld(sessions[1]))
        view = opened.enter_context(View(world, page))
        opened.enter_context(drawing(view, page))
        hall = opened.enter_context(StaticPublisher(sessions[0], "hall"))
        opened.callback(lambda: [one.close() for one in publishers.values()])
        for step in range(40):
            name = f"r{random.integers(6)}"
            ended = publishers.pop(name, None)
            if ended is not None:
                ended.close()
            if ended is None or random.random() < 0.7:
                model = RRBOT if random.random() < 0.8 else CART
                publisher = publishers[name] = StatePublisher(sessions[0], model, name)
                publisher.publish(model.neutral)
                hall.set(Transform("hall/map", f"{name}/{model.root}", [step, 0, 0], STILL))
            for one in publishers.values():
                one.publish(one.model.neutral)
            until(lambda since=world.tries: world.tries > since + 1)
        until(lambda: publishers.keys() <= world.models.keys())
        until(lambda since=world.tries: world.tries > since + 1)
    assert [record.getMessage() for record in caplog.records if "picture" in record.getMessage()] == []


def test_a_picture_that_is_held_is_of_one_instant_with_the_camera_fitted_to_it(page):
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT, "r1")
    lifted, lowered = [0.0, 0.0], [2.0, 2.0]
    buffer.insert_joints(track, 1, lifted)
    with ViewSource(None, buffer=buffer) as world, View(world, page) as view:
        with drawing(view, page):
            assert view.hold(DEADLINE_S)
        snapshot = view.draw()
        camera = page.server.initial_camera
        before = np.array([camera.position, camera.look_at])
        for tick in range(1, 20):
            buffer.insert_joints(track, tick * 1_000_000_000, lowered)
            assert view.draw() is snapshot
        np.testing.assert_array_equal([camera.position, camera.look_at], before)
        assert view.visibility() == (Visibility("r1", True, "", "r1/world"),)
    placed = snapshot.poses_in("r1/world")
    corners = view.scene.corners(snapshot.tree, placed)
    framing = fit_camera(snapshot, placed, 1.0, corners)
    assert framing is not None
    assert len(corners) > 8
    np.testing.assert_allclose(before, [framing.position, framing.look_at])


def test_a_page_begins_with_the_frame_and_the_camera_that_were_asked_for(page):
    buffer = TransformBuffer()
    buffer.insert_joints(buffer.add_robot(RRBOT, "r1"), 1, [0.0, 0.0])
    camera = Camera((3.0, 2.0, 1.0), (0.0, 0.0, 0.5))
    with ViewSource(None, buffer=buffer) as world:
        with View(world, page, fixed_frame="r1/tool", camera=camera) as view:
            view.draw()
        at_tool = world.snapshot().poses_in("r1/tool")
        handle = page.server.scene.get_handle_by_name("/frames/0")
        assert handle is not None
        np.testing.assert_allclose(handle.position, at_tool[0, :3], atol=1e-6)
        np.testing.assert_allclose(page.server.initial_camera.position, camera.position)
        np.testing.assert_allclose(page.server.initial_camera.look_at, camera.look_at)
