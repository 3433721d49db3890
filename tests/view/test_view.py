"""View: the draw loop continues whatever happens to the robots and their data."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until
from helpers.recording_builder import MS, START, RecordingBuilder, pose
from helpers.robots import RRBOT

pytest.importorskip("viser")

from zstate import StatePublisher, StaticPublisher, Transform, load_model
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.snapshot import FramePoses
from zstate.clouds import CloudPublisher
from zstate.net.streams import KeyPublisher
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.view.camera import Camera, Visibility, fit_camera
from zstate.view.data_source import ViewSource
from zstate.view.server import ViewServer
from zstate.view.view import View
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import to_block

CART = load_model("diffbot")
STILL = [0.0, 0.0, 0.0, 1.0]


@contextmanager
def drawing(view: View, page: ViewServer) -> Iterator[threading.Thread]:
    """``view.run`` in a thread, at full rate as if a browser showed the page."""
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


class FailingSource(ViewSource):
    """A source whose snapshots raise while ``fails``."""

    fails = False
    tries = 0

    def snapshot(self, at: int | None = None) -> FramePoses:
        self.tries += 1
        if self.fails:
            raise ValueError(f"try number {self.tries}")
        return super().snapshot(at)


def test_drawing_error_is_logged_once_shown_on_the_page_and_retried(page, caplog):
    buffer = TransformBuffer()
    buffer.insert_static(Transform("map", "camera", [1, 0, 0], STILL))
    with (
        FailingSource(None, buffer=buffer) as source,
        View(source, page) as view,
        drawing(view, page) as thread,
    ):
        until(lambda: source.tries > 3)
        assert not view.layout.fault
        source.fails = True
        until(lambda: "ValueError: try number" in view.layout.fault)
        tried = source.tries
        until(lambda: source.tries > tried + 3)
        source.fails = False
        until(lambda: not view.layout.fault)
        assert thread.is_alive()
    (logged,) = [record.getMessage() for record in caplog.records]
    assert "failed to draw a picture (ValueError: try number" in logged
    assert "test_view.py, line" in logged


def test_clouds_and_pictures_are_received_while_a_browser_shows_the_page(page, sessions):
    keys = [f"zstate/r1/{stream}" for stream in ("cloud/top", "image/wrist")]
    points = np.ones((5, 3))
    with (
        ViewSource(sessions[1]) as source,
        View(source, page) as view,
        CloudPublisher(sessions[0], "r1", "top", frame="lidar") as lidar,
        ExitStack() as opened,
    ):
        bulk = [opened.enter_context(KeyPublisher(sessions[0], key, "")) for key in keys]
        scans = opened.enter_context(KeyPublisher(sessions[0], "zstate/r1/scan/front", ""))
        view.draw()
        until(lambda: scans.has_readers)
        assert [one.has_readers for one in bulk] == [False, False]
        with drawing(view, page):
            until(lambda: all(one.has_readers for one in bulk))
            until(lambda: lidar.publish(points) or source.world.clouds)
            page.connected.clear()  # the last browser has left
            until(lambda: not any(one.has_readers for one in bulk))
            until(lambda: not source.world.clouds)
            page.connected.set()
            until(lambda: lidar.publish(points) or source.world.clouds)


@pytest.mark.long
def test_robots_can_appear_disappear_and_restart_while_they_are_drawn(page, sessions, caplog):
    """Random publishers of two models, and static edges that change their parent."""
    random = np.random.default_rng(7)
    publishers: dict[str, StatePublisher] = {}
    with ExitStack() as opened:
        source = opened.enter_context(FailingSource(sessions[1]))
        view = opened.enter_context(View(source, page))
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
            until(lambda since=source.tries: source.tries > since + 1)
        until(lambda: publishers.keys() <= source.models.keys())
        until(lambda since=source.tries: source.tries > since + 1)
    assert [record.getMessage() for record in caplog.records if "picture" in record.getMessage()] == []


def test_held_picture_shows_one_snapshot_with_the_camera_fitted_to_it(page):
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT, "r1")
    lifted, lowered = [0.0, 0.0], [2.0, 2.0]
    buffer.insert_joints(track, 1, lifted)
    with ViewSource(None, buffer=buffer) as source, View(source, page) as view:
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


def test_page_starts_with_the_requested_fixed_frame_and_camera(page):
    buffer = TransformBuffer()
    buffer.insert_joints(buffer.add_robot(RRBOT, "r1"), 1, [0.0, 0.0])
    camera = Camera((3.0, 2.0, 1.0), (0.0, 0.0, 0.5))
    with ViewSource(None, buffer=buffer) as source:
        with View(source, page, fixed_frame="r1/tool", camera=camera) as view:
            view.draw()
        at_tool = source.snapshot().poses_in("r1/tool")
        handle = page.server.scene.get_handle_by_name("/frames/0")
        assert handle is not None
        np.testing.assert_allclose(handle.position, at_tool[0, :3], atol=1e-6)
        np.testing.assert_allclose(page.server.initial_camera.position, camera.position)
        np.testing.assert_allclose(page.server.initial_camera.look_at, camera.look_at)


def test_recording_is_drawn_with_the_map_and_the_scans_of_the_instant(page, server, tmp_path: Path):
    from helpers.scene_drawing import handles, is_visible
    from viser import ImageHandle, PointCloudHandle

    path = tmp_path / "run.mcap"
    with RecordingBuilder(path) as builder:
        for n in range(21):  # the laser is at n metres, and measures 1 m ahead
            stamp = START + n * 100 * MS
            builder.edges("cart", stamp, {("odom", "laser"): pose(n)})
            ranges = to_float32_block([1.0])
            scan = LaserScan(stamp, n, 1, "laser", 0.0, 0.1, 0, 0, 0.1, 10.0, ranges)
            builder.encoder.write_message("cart", scan, stamp + MS, "front")
            if n == 10:
                origin = to_block([0, 0, 0, 0, 0, 0, 1])
                floor = OccupancyGrid(4, stamp, "odom", 1.0, 1, 1, origin, b"\x64")
                builder.encoder.write_message("cart", floor, stamp + MS, "floor")

    def drawn(n: int) -> tuple[list[float], int]:
        """The x of the visible scans, and the number of visible maps, once maps are encoded."""
        view.layout.cursor.seek(START + n * 100 * MS + 50 * MS)
        view.draw()
        until(lambda: view.draw() and not view.scene.busy)
        clouds, maps = (
            [node for path, node in handles(server, kind).items() if is_visible(server, path)]
            for kind in (PointCloudHandle, ImageHandle)
        )
        return sorted(float(cloud.points[0, 0]) for cloud in clouds), len(maps)

    with ViewSource.from_recording(path) as source, View(source, page, fixed_frame="cart/odom") as view:
        view.layout.cursor.pause()
        assert drawn(3) == ([1.0, 2.0, 3.0, 4.0], 0)
        assert drawn(15) == ([12.0, 13.0, 14.0, 15.0, 16.0], 1)
        assert drawn(6) == ([3.0, 4.0, 5.0, 6.0, 7.0], 0)  # backwards
        assert not view.scene.world.missing
