"""Clouds: the points of the last seconds at their places in the fixed frame, thinned out and in colours."""

from __future__ import annotations

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.processes import until  # noqa: E402
from helpers.scene_drawing import at, handles, is_visible, sent_messages, tree  # noqa: E402

from zstate.buffer.buffer import TransformBuffer  # noqa: E402
from zstate.clouds import Cloud  # noqa: E402
from zstate.transform import Transform  # noqa: E402
from zstate.view.scene.clouds import Clouds, spectrum  # noqa: E402
from zstate.view.scene.world import DrawnFrames  # noqa: E402
from zstate.view.thinned_cloud import thinned_cloud  # noqa: E402
from zstate.view.world_source import LiveSensor, WorldSource, WriterName  # noqa: E402

MS = 1_000_000
TOP = WriterName("r1", "top")
TREE = tree({"odom": None, "r1/lidar": "odom"})
HERE = np.array([at(), at()])
PLACE = DrawnFrames(TREE, HERE, "odom")
POINT = [(name, "<f4") for name in "xyz"]


def lidar_at(stamp: int) -> Transform:
    """A lidar that drives along x with 1 m a millisecond."""
    return Transform("odom", "r1/lidar", (stamp / MS, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp=stamp)


def cloud_at(stamp: int, points, **fields) -> Cloud:
    """Points x y z; ``fields`` are further ones of each point."""
    kinds = [(name, np.asarray(values).dtype) for name, values in fields.items()]
    array = np.zeros(len(points), POINT + kinds)
    for name, column in zip("xyz", np.reshape(points, (-1, 3)).T, strict=True):
        array[name] = column
    for name, values in fields.items():
        array[name] = values
    return Cloud(stamp, "r1/lidar", array)


class FixedClouds(WorldSource):
    """Clouds of sensors that a test sets."""

    def __init__(self) -> None:
        super().__init__(None)
        self.limits: dict[WriterName, int] = {}

    def add(self, cloud: Cloud, name: WriterName = TOP, most: int = 200_000) -> None:
        self._clouds.setdefault(name, LiveSensor(max_bytes=10**9)).add(thinned_cloud(cloud, most))

    def limit_clouds(self, name: WriterName, points: int) -> None:
        self.limits[name] = points

    def remove(self, name: WriterName = TOP) -> None:
        del self._clouds[name]


class Shown:
    """Clouds on a page, with a buffer of the poses from 0 to 10 s."""

    def __init__(self, server) -> None:
        self.server = server
        self.clouds = Clouds(server.scene)
        self.source = FixedClouds()
        self.buffer = TransformBuffer(history_s=3600.0)
        for stamp in (0, 10_000 * MS):
            self.buffer.insert(lidar_at(stamp))

    def show(self, at: int | None = None, place: DrawnFrames = PLACE) -> None:
        self.clouds.show(self.source, self.buffer, place, at)

    def nodes(self) -> list[viser.PointCloudHandle]:
        """The visible clouds, by the x of their first points."""
        found = handles(self.server, viser.PointCloudHandle)
        visible = [node for path, node in found.items() if is_visible(self.server, path)]
        return sorted(visible, key=lambda node: float(node.points[0, 0]))

    def count(self) -> int:
        return sum(len(node.points) for node in self.nodes())


@pytest.fixture
def shown(server) -> Shown:
    return Shown(server)


def test_each_point_is_drawn_at_the_pose_of_its_own_stamp_in_float32(shown):
    t = np.array([0, 1 * MS, 2 * MS], np.uint32)
    shown.source.add(cloud_at(2 * MS, [(1, 0, 0), (0, 1, 0), (0, 0, 1)], t=t))
    shown.show()
    (node,) = shown.nodes()
    # From lidar positions of 2, 3 and 4 m.
    assert np.allclose(node.points, [[3, 0, 0], [3, 1, 0], [4, 0, 1]], atol=1e-6)
    assert node.points.dtype == np.float32


def test_points_that_are_not_finite_are_not_drawn(shown):
    shown.source.add(cloud_at(2 * MS, [(np.nan, 0, 0), (0, 1, 0), (0, np.inf, 1)]))
    shown.show()
    assert np.allclose(shown.nodes()[0].points, [[2, 1, 0]], atol=1e-6)


def test_clouds_of_the_last_seconds_remain_in_the_fixed_frame(shown):
    shown.clouds.window_s = 0.2
    for stamp in (100, 200, 300, 400):
        shown.source.add(cloud_at(stamp * MS, [(0, 0, 0)]))
    shown.show()
    assert [node.points[0, 0] for node in shown.nodes()] == pytest.approx([200, 300, 400])
    shown.clouds.window_s = 0.0
    shown.show()
    assert [node.points[0, 0] for node in shown.nodes()] == pytest.approx([400])
    shown.clouds.window_s = 0.1
    shown.show(at=250 * MS)
    assert [node.points[0, 0] for node in shown.nodes()] == pytest.approx([100, 200])


def test_cloud_is_sent_once_and_its_node_is_used_again(shown):
    shown.clouds.window_s = 0.1
    for stamp in (100, 200):
        shown.source.add(cloud_at(stamp * MS, [(0, 0, 0)] * 4))
    shown.show()
    with sent_messages(shown.server) as messages:
        shown.show()
    assert messages == []
    shown.source.add(cloud_at(300 * MS, [(0, 0, 0)] * 3))
    shown.show()
    assert len(handles(shown.server, viser.PointCloudHandle)) == 2
    assert [node.points[0, 0] for node in shown.nodes()] == pytest.approx([200, 300])
    assert [len(node.colors) for node in shown.nodes()] == [4, 3]


def test_points_of_all_sensors_and_clouds_are_at_most_those_asked_for(shown):
    shown.clouds.points, shown.clouds.window_s = 1000, 1.0
    other = WriterName("r1", "front")
    drawn = []
    for stamp in range(0, 4000, 100):
        for name in (TOP, other):
            cloud = cloud_at(stamp * MS, np.ones((5000, 3)))
            shown.source.add(cloud, name, shown.source.limits.get(name, 5000))
        shown.show()
        drawn.append(shown.count())
    assert max(drawn) <= 1000
    assert min(drawn[11:]) > 500  # once the window is full


def test_many_points_are_drawn_over_several_pictures_the_newest_first(shown):
    shown.clouds.points, shown.clouds.window_s = 2_000_000, 1.0
    for stamp in range(0, 500, 100):
        shown.source.add(cloud_at(stamp * MS, np.ones((150_000, 3))))
    shown.show()
    assert shown.clouds.busy
    newest = [node.points[0, 0] for node in shown.nodes()]
    assert newest == pytest.approx([301, 401])
    while shown.clouds.busy:
        before = shown.count()
        shown.show()
        assert 0 < shown.count() - before <= 2 * 150_000
    assert len(shown.nodes()) == 5


def test_more_points_are_drawn_when_they_are_asked_for(shown):
    shown.clouds.points = 100
    shown.source.add(cloud_at(0, np.ones((5000, 3))))
    shown.show()
    assert shown.count() == 100
    shown.clouds.points = 3000
    shown.show()
    assert shown.count() == 3000


def test_thinning_selects_points_of_all_lasers(shown):
    rings = np.tile(np.arange(128), 1000).astype(np.uint16)
    cloud = thinned_cloud(cloud_at(0, np.ones((len(rings), 3)), ring=rings), 1000)
    assert len(cloud) == 1000
    counts = np.bincount(cloud.ring.astype(int), minlength=128)
    # Each laser has a binomial number, 7.8 on average: more than 30 have a probability of 1e-9.
    assert np.count_nonzero(counts) > 120
    assert counts.max() < 30


def colors_of(shown: Shown, color) -> list[list[int]]:
    shown.clouds.color = color
    shown.show()
    (node,) = shown.nodes()
    return np.broadcast_to(node.colors, node.points.shape).tolist()


def test_colours_are_of_height_intensity_ring_and_rgb(shown):
    n = 101
    ramp = np.arange(n, dtype=np.float32)
    points = np.stack([0 * ramp, 0 * ramp, ramp], axis=1)
    rgb = np.full(n, 0x0A141E, np.uint32).view(np.float32)
    shown.source.add(cloud_at(0, points, intensity=ramp[::-1].copy(), ring=ramp.astype(np.uint16), rgb=rgb))
    blue, red = spectrum(np.array([0.0, 1.0], np.float32), 0.0, 1.0).tolist()
    by_height, by_intensity = colors_of(shown, "height"), colors_of(shown, "intensity")
    assert (by_height[0], by_height[-1]) == (blue, red)
    assert by_intensity == by_height[::-1]
    assert colors_of(shown, "ring") == by_height
    assert colors_of(shown, "rgb") == [[10, 20, 30]] * n
    assert len({tuple(color) for color in colors_of(shown, "sensor")}) == 1


def test_sensor_without_the_value_has_one_colour(shown):
    shown.source.add(cloud_at(0, np.ones((3, 3))))
    assert colors_of(shown, "ring") == colors_of(shown, "sensor")


def test_all_clouds_have_one_scale_of_colours(shown):
    for stamp, height in ((100, 1.0), (200, 2.0), (300, 1.0)):
        shown.source.add(cloud_at(stamp * MS, [(0, 0, 0), (0, 0, height)]))
        shown.show()
    first, middle, last = (node.colors.tolist() for node in shown.nodes())
    assert first == last
    assert first[0] == middle[0]
    assert first[1] != middle[1]


def test_cloud_waits_for_the_pose_of_its_last_point(shown):
    t = np.array([0, 2 * MS], np.uint32)
    shown.source.add(cloud_at(9_999 * MS, [(1, 0, 0), (1, 0, 0)], t=t))
    shown.show()
    assert shown.nodes() == []
    assert shown.clouds.missing == []
    shown.buffer.insert(lidar_at(10_001 * MS))
    shown.show()
    assert shown.nodes()[0].points[1] == pytest.approx([10_002.0, 0.0, 0.0])


def test_cloud_whose_pose_does_not_come_is_reported(shown):
    shown.source.add(cloud_at(20_000 * MS, [(1, 0, 0)]))

    def is_reported() -> bool:
        shown.show()
        return bool(shown.clouds.missing)

    until(is_reported)
    ((name, why),) = shown.clouds.missing
    assert name == "clouds of r1/top"
    assert why.startswith("1 dropped: ")


def test_clouds_are_placed_again_in_another_fixed_frame(shown):
    shown.source.add(cloud_at(2 * MS, [(1, 0, 0)]))
    shown.show()
    shown.show(place=DrawnFrames(TREE, HERE, "r1/lidar"))
    assert np.allclose(shown.nodes()[0].points, [[1, 0, 0]], atol=1e-6)


def test_clouds_vanish_with_their_sensor_and_by_the_checkbox(shown):
    assert not shown.clouds.has_any
    shown.source.add(cloud_at(2 * MS, [(1, 0, 0)]))
    shown.show()
    assert shown.clouds.has_any
    shown.clouds.is_on = False
    shown.show()
    assert shown.nodes() == []
    shown.clouds.is_on = True
    shown.show()
    assert len(shown.nodes()) == 1
    shown.source.remove()
    shown.show()
    assert handles(shown.server, viser.PointCloudHandle) == {}
