"""Cameras: the newest picture of each, and frustums at the frames of the cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.pictures import jpeg, video  # noqa: E402
from helpers.scene_drawing import at, handles, is_visible, pose_in_fixed, sent_messages, tree  # noqa: E402

from zstate.buffer.buffer import TransformBuffer  # noqa: E402
from zstate.cameras import Camera  # noqa: E402
from zstate.transform import Transform  # noqa: E402
from zstate.view.pictures import Packet  # noqa: E402
from zstate.view.scene.cameras import Cameras, field_of_view  # noqa: E402
from zstate.view.scene.world import STALE_COLOR, DrawnFrames  # noqa: E402
from zstate.view.world_source import LiveSensor, WorldSource, WriterName  # noqa: E402

WRIST = WriterName("r1", "wrist")
TREE = tree({"odom": None, "r1/lens": "odom"})
PLACE = DrawnFrames(TREE, np.array([at(), at(1.0, 2.0, 3.0)]), "odom")
STRAIGHT = (0.0, 0.0, 0.0, 1.0)
CAMERA = Camera(64, 48, (60.0, 60.0, 31.5, 23.5), frame="r1/lens")
KEY = "zstate/r1/camera_info/wrist"


class Clock:
    """A monotonic clock that a test sets [s]."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Shown:
    """Cameras on a page, of a source that a test fills."""

    def __init__(self, server) -> None:
        self.server = server
        self.clock = Clock()
        self.cameras = Cameras(server.scene, self.clock)
        self.source = WorldSource(None)
        self.source._cameras[KEY] = WRIST, CAMERA
        self.sensor = self.source._pictures[WRIST] = LiveSensor(self.clock)
        self.buffer = TransformBuffer()
        self.buffer.insert_static(Transform("odom", "r1/lens", (1.0, 2.0, 3.0), STRAIGHT))
        self.count = 0

    def add(self, data: bytes, form="jpeg", frame: str = "r1/lens") -> None:
        self.sensor.keep(Packet(self.count, frame, form, data, (1, self.count)))
        self.count += 1

    def show(self, stamp: int | None = None, place: DrawnFrames = PLACE) -> None:
        self.clock.now_s += 0.11
        self.cameras.read(self.source, self.buffer, {}, stamp)
        self.cameras.show(self.buffer, place)

    def frustum(self):
        """The visible frustum; None if there is none."""
        found = handles(self.server, viser.CameraFrustumHandle)
        return next((one for path, one in found.items() if is_visible(self.server, path)), None)


@pytest.fixture
def shown(server) -> Shown:
    return Shown(server)


def test_frustum_has_the_bytes_of_the_picture_and_stands_at_the_frame(shown):
    data = jpeg()
    shown.add(data)
    shown.show()
    frustum = shown.frustum()
    assert frustum._image_data is data
    assert frustum._format == "jpeg"
    (path,) = handles(shown.server, viser.CameraFrustumHandle)
    assert pose_in_fixed(shown.server, path)[:3] == (1.0, 2.0, 3.0)
    assert frustum.fov == pytest.approx(2.0 * math.atan(24.0 / 60.0))
    assert frustum.aspect == pytest.approx(64 / 48)


def test_frustum_stands_where_the_camera_was_at_the_stamp_of_its_picture(shown):
    """The camera is at x = 1 m + 1 m/s t; its picture is of 0.2 s, and drawn at 0.5 s: there x is 1.5 m."""
    buffer = shown.buffer = TransformBuffer(history_s=10.0)
    place = DrawnFrames(TREE, np.array([at(), at(1.5)]), "odom")

    def drive(*milliseconds: int) -> None:
        for one in milliseconds:
            position = (1.0 + 0.001 * one, 0.0, 0.0)
            buffer.insert(Transform("odom", "r1/lens", position, STRAIGHT, stamp=one * 1_000_000))

    def drawn_x() -> float:
        shown.show(place=place)
        (path,) = handles(shown.server, viser.CameraFrustumHandle)
        return pose_in_fixed(shown.server, path)[0]

    drive(0, 100)
    shown.sensor.keep(Packet(200_000_000, "r1/lens", "jpeg", jpeg(), (1, 0)))
    assert drawn_x() == pytest.approx(1.1)  # its pose has not arrived
    drive(300, 500)
    assert drawn_x() == pytest.approx(1.2)
    drive(20_000, 20_010)
    drawn_x()
    assert shown.frustum() is None
    ((what, why),) = shown.cameras.missing
    assert (what, "history" in why) == ("frustum of r1/wrist", True)


def test_picture_is_sent_once_and_at_most_ten_times_a_second(shown):
    shown.add(jpeg())
    shown.show()
    with sent_messages(shown.server) as messages:
        shown.show()
        shown.add(jpeg(brightness=50))
        shown.clock.now_s -= 0.11
        shown.show()
    assert messages == []
    shown.show()
    assert shown.frustum()._image_data == jpeg(brightness=50)


def test_picture_of_an_earlier_instant_is_shown(shown):
    for brightness in (0, 50, 100):
        shown.add(jpeg(brightness=brightness))
    shown.show(stamp=1)
    assert shown.frustum()._image_data == jpeg(brightness=50)


def test_video_is_decoded_on_the_frustum(shown):
    for data in video(3):
        shown.add(data, "h264")
    shown.show()
    assert shown.frustum()._image_data.startswith(b"\xff\xd8")
    assert shown.cameras.shown[WRIST].picture.size == (64, 48)


def test_camera_that_stops_is_marked_as_old(shown):
    for _ in range(3):
        shown.add(jpeg())
        shown.show()
    assert not shown.cameras.shown[WRIST].is_old
    assert tuple(shown.frustum().color) != STALE_COLOR
    shown.clock.now_s += 2.0  # more than ten periods
    shown.show()
    assert shown.cameras.shown[WRIST].is_old
    assert tuple(shown.frustum().color) == STALE_COLOR


def test_camera_without_a_calibration_of_this_size_has_a_picture_and_no_frustum(shown):
    shown.add(jpeg(80, 40))
    shown.show()
    assert shown.frustum() is None
    assert shown.cameras.shown[WRIST].camera is None
    assert shown.cameras.missing == [
        ("frustum of r1/wrist", "its calibration, or one of this size, is not known")
    ]


def test_camera_without_a_pose_is_listed_with_its_frame(shown):
    shown.add(jpeg(), frame="r1/elsewhere")
    shown.show()
    assert shown.frustum() is None
    assert shown.cameras.missing == [
        ("frustum of r1/wrist", "its frame 'r1/elsewhere' has no pose in 'odom'")
    ]


def test_frustums_vanish_with_their_cameras_and_by_the_checkbox(shown):
    shown.add(jpeg())
    shown.show()
    shown.cameras.frustums = False
    shown.show()
    assert shown.frustum() is None
    shown.cameras.frustums = True
    shown.show()
    assert shown.frustum() is not None
    del shown.source._pictures[WRIST]
    shown.show()
    assert handles(shown.server, viser.CameraFrustumHandle) == {}


def test_wide_lens_has_a_frustum_of_140_degrees():
    def seen(focal_length: float) -> tuple[float, float]:
        k = (focal_length, focal_length, 499.5, 499.5)
        return field_of_view(Camera(1000, 1000, k, model="equidistant"))

    # Without distortion the angle from the axis is the distance over the focal length.
    assert seen(500.0) == pytest.approx((2.0, 1.0))
    assert seen(400.0) == pytest.approx((math.radians(140.0), 1.0))
