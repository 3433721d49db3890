"""World: scans as point clouds and maps as images, at their places in the fixed frame."""

from __future__ import annotations

import math

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.processes import until  # noqa: E402
from helpers.scene_drawing import at, handles, is_visible, pose_in_fixed, sent_messages, tree  # noqa: E402

from zstate.buffer.buffer import TransformBuffer  # noqa: E402
from zstate.scans import Grid, Scan  # noqa: E402
from zstate.transform import Transform  # noqa: E402
from zstate.view.scene.world import DrawnFrames, World  # noqa: E402
from zstate.view.world_source import LiveSensor, WorldSource, WriterName  # noqa: E402

MS = 1_000_000
FRONT, HALL = WriterName("r1", "front"), WriterName("hall", "map")
TREE = tree({"odom": None, "r1/laser": "odom"})
HERE = np.array([at(), at()])


def laser_at(stamp: int) -> Transform:
    """A laser that drives along x with 1 m a millisecond."""
    return Transform("odom", "r1/laser", (stamp / MS, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp=stamp)


def scan_at(stamp: int, *ranges: float) -> Scan:
    """Rays along x, y and -x, a millisecond apart."""
    return Scan(stamp, 0.0, math.pi / 2, MS, ranges or (1.0, 1.0, 1.0), 0.1, 10.0, "r1/laser")


class FixedSource(WorldSource):
    """Scans of one sensor and maps that a test sets."""

    def __init__(self) -> None:
        super().__init__(None)
        self._sensors[FRONT] = LiveSensor()
        self.front = self._sensors[FRONT]

    def set_map(self, grid: Grid) -> None:
        self._maps["key"] = HALL, grid

    def remove_sensor(self) -> None:
        del self._sensors[FRONT]

    def refuse_sensor(self) -> None:
        self._refusals.count("too many sensors", "r65/front is not drawn")

    def withdraw_map(self) -> None:
        self._on_withdrawn("key")


class Shown:
    """A world on a page, with a buffer of the poses from 0 to 10 ms."""

    def __init__(self, server) -> None:
        self.server = server
        self.world = World(server.scene)
        self.source = FixedSource()
        self.buffer = TransformBuffer(history_s=3600.0)
        for stamp in (0, 10 * MS):
            self.buffer.insert(laser_at(stamp))

    def show(self, at: int | None = None, place: DrawnFrames | None = None) -> None:
        self.world.show(self.source, self.buffer, place or DrawnFrames(TREE, HERE, "odom"), at)

    def show_maps(self, place: DrawnFrames | None = None) -> None:
        def complete() -> bool:
            self.show(place=place)
            return not self.world.busy

        self.show(place=place)
        until(complete)
        self.show(place=place)

    def clouds(self) -> list[viser.PointCloudHandle]:
        """The visible clouds, by the x of their first points."""
        found = handles(self.server, viser.PointCloudHandle)
        visible = [cloud for path, cloud in found.items() if is_visible(self.server, path)]
        return sorted(visible, key=lambda cloud: float(cloud.points[0, 0]))

    def images(self) -> dict[str, viser.ImageHandle]:
        found = handles(self.server, viser.ImageHandle)
        return {path: image for path, image in found.items() if is_visible(self.server, path)}


@pytest.fixture
def shown(server) -> Shown:
    return Shown(server)


def test_each_ray_is_drawn_at_the_pose_of_its_own_stamp_in_float32(shown):
    shown.source.front.add(scan_at(2 * MS))
    shown.show()
    (cloud,) = shown.clouds()
    # From laser positions of 2, 3 and 4 m along x, y and -x.
    assert np.allclose(cloud.points, [[3.0, 0.0, 0.0], [3.0, 1.0, 0.0], [3.0, 0.0, 0.0]], atol=1e-6)
    assert cloud.points.dtype == np.float32


def test_rays_without_a_measurement_are_not_drawn(shown):
    shown.source.front.add(scan_at(2 * MS, math.inf, 1.0, math.nan))
    shown.show()
    assert np.allclose(shown.clouds()[0].points, [[3.0, 1.0, 0.0]], atol=1e-6)


def test_last_scans_are_drawn_and_older_ones_are_paler(shown):
    shown.world.scan_count = 3
    for stamp in range(1, 6):
        shown.source.front.add(scan_at(stamp * MS))
    shown.show()
    clouds = shown.clouds()
    assert [cloud.points[0, 0] for cloud in clouds] == pytest.approx([4.0, 5.0, 6.0])
    shades = [int(cloud.colors.sum()) for cloud in clouds]
    assert shades == sorted(shades, reverse=True)
    assert len(set(shades)) == 3
    shown.world.scan_count = 1
    shown.show()
    assert [cloud.points[0, 0] for cloud in shown.clouds()] == pytest.approx([6.0])


def test_scan_is_sent_once_and_its_node_is_used_again(shown):
    shown.world.scan_count = 2
    for stamp in (1, 2):
        shown.source.front.add(scan_at(stamp * MS))
    shown.show()
    with sent_messages(shown.server) as messages:
        shown.show()
    assert messages == []
    nodes = len(handles(shown.server, viser.PointCloudHandle))
    shown.source.front.add(scan_at(3 * MS))
    shown.show()
    assert len(handles(shown.server, viser.PointCloudHandle)) == nodes
    assert [cloud.points[0, 0] for cloud in shown.clouds()] == pytest.approx([3.0, 4.0])


def test_scan_waits_for_the_pose_of_its_last_ray(shown):
    shown.source.front.add(scan_at(9 * MS))  # until 11 ms
    shown.show()
    assert shown.clouds() == []
    assert shown.world.missing == []
    shown.buffer.insert(laser_at(11 * MS))
    shown.show()
    assert shown.clouds()[0].points[2] == pytest.approx([10.0, 0.0, 0.0])


def test_scan_whose_pose_does_not_come_is_dropped_with_the_reason(shown):
    shown.source.front.add(scan_at(9 * MS))

    def is_dropped() -> bool:
        shown.show()
        return shown.source.front.dropped == 1

    until(is_dropped)
    ((name, why),) = shown.world.missing
    assert name == "scans of r1/front"
    assert why.startswith("1 dropped: ")
    assert "r1/laser" in why
    shown.source.front.add(scan_at(3 * MS))
    shown.show()
    assert shown.world.missing == []


def test_clouds_of_a_removed_sensor_vanish_and_refused_sensors_are_reported(shown):
    shown.source.front.add(scan_at(2 * MS))
    shown.show()
    shown.source.remove_sensor()
    shown.show()
    assert handles(shown.server, viser.PointCloudHandle) == {}
    shown.source.refuse_sensor()
    shown.show()
    assert shown.world.missing == [
        ("scans of further sensors", "1 refused; the first: r65/front is not drawn")
    ]


def test_scans_until_an_instant_of_the_past_are_drawn(shown):
    for stamp in (1, 4):
        shown.source.front.add(scan_at(stamp * MS))
    shown.show(at=5 * MS)  # the second one ends at 6 ms
    assert [cloud.points[0, 0] for cloud in shown.clouds()] == pytest.approx([2.0])


def test_scans_begin_again_if_time_is_set_back(shown):
    second = 1000 * MS
    shown.buffer.insert(laser_at(3 * second))
    shown.source.front.add(scan_at(2 * second))
    shown.source.front.add(scan_at(2 * MS))
    shown.show()
    assert [cloud.points[0, 0] for cloud in shown.clouds()] == pytest.approx([3.0])


def test_clouds_are_placed_again_in_another_fixed_frame(shown):
    shown.source.front.add(scan_at(2 * MS))
    shown.show()
    shown.show(place=DrawnFrames(TREE, HERE, "r1/laser"))
    # In the moving laser itself each ray is as measured.
    assert np.allclose(shown.clouds()[0].points, [[1, 0, 0], [0, 1, 0], [-1, 0, 0]], atol=1e-6)


def test_scans_of_an_unconnected_robot_are_drawn_where_it_is(shown):
    apart = tree({"map": None, "odom": None, "r1/laser": "odom"})
    shown.buffer.insert_static(Transform("map", "camera", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    shown.source.front.add(scan_at(2 * MS))
    shown.show(place=DrawnFrames(apart, np.array([at(), at(0, 5, 0), at(0, 5, 0)]), "map"))
    (path,) = handles(shown.server, viser.PointCloudHandle)
    assert pose_in_fixed(shown.server, path)[:3] == pytest.approx((0.0, 5.0, 0.0))
    assert shown.clouds()[0].points[1] == pytest.approx([3.0, 1.0, 0.0])


def test_scans_vanish_with_their_frame_and_by_the_checkbox(shown):
    shown.source.front.add(scan_at(2 * MS))
    shown.show()
    shown.show(place=DrawnFrames(tree({"odom": None}), HERE[:1], "odom"))
    assert shown.clouds() == []
    shown.show()
    assert len(shown.clouds()) == 1
    shown.world.scans = False
    shown.show()
    assert shown.clouds() == []


def test_clouds_of_a_sensor_that_stops_turn_grey(shown):
    for stamp in (1, 2, 3):
        shown.source.front.add(scan_at(stamp * MS))
    shown.show()
    red, green, blue = shown.clouds()[-1].colors.tolist()
    assert max(red, green, blue) - min(red, green, blue) > 100

    def is_grey() -> bool:
        shown.show()
        color = shown.clouds()[-1].colors.astype(int)
        return color.max() - color.min() < 20

    until(is_grey)
    shown.source.front.add(scan_at(4 * MS))
    assert not is_grey()


def test_map_is_one_image_at_its_origin_with_yaw(shown):
    # 4 x 2 cells of 0.5 m: the middle is 1 m along and 0.5 m across in axes that are turned by a quarter.
    shown.source.set_map(Grid(np.zeros((2, 4), int), 0.5, (3.0, 1.0, math.pi / 2), "odom"))
    shown.show_maps()
    ((path, image),) = shown.images().items()
    assert (image.render_width, image.render_height) == (2.0, 1.0)
    x, y, z, *turn = pose_in_fixed(shown.server, path)
    assert (x, y) == pytest.approx((2.5, 2.0))
    assert -0.01 < z < 0.0  # below the lines of the floor
    assert turn == pytest.approx([0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)])


def test_row_0_of_a_map_has_the_smallest_y_and_unknown_cells_are_transparent(shown):
    shown.source.set_map(Grid([[100, 0], [-1, 50]], 1.0, (0.0, 0.0, 0.0), "odom"))
    shown.show_maps()
    ((_, image),) = shown.images().items()
    # The browser draws the first row of an image at the smallest y.
    assert image.image[0].tolist() == [[0, 0, 0, 255], [255, 255, 255, 255]]
    assert image.image[1, 0, 3] == 0


def test_map_is_encoded_once_for_each_change_and_vanishes_when_it_is_withdrawn(shown):
    shown.source.set_map(Grid([[100]], 1.0, (0.0, 0.0, 0.0), "odom"))
    shown.show_maps()
    first = shown.images()
    with sent_messages(shown.server) as messages:
        shown.show_maps()
    assert messages == []
    shown.source.set_map(Grid([[0]], 1.0, (0.0, 0.0, 0.0), "odom"))
    shown.show_maps()
    assert first.keys().isdisjoint(shown.images())
    assert len(shown.images()) == 1
    shown.source.withdraw_map()
    shown.show_maps()
    assert handles(shown.server, viser.ImageHandle) == {}


def test_map_follows_its_frame_and_is_hidden_by_the_checkbox(shown):
    shown.source.set_map(Grid([[100]], 2.0, (0.0, 0.0, 0.0), "odom"))
    shown.show_maps(DrawnFrames(TREE, np.array([at(5, 0, 0), at()]), "r1/laser"))
    (path,) = shown.images()
    assert pose_in_fixed(shown.server, path)[:2] == pytest.approx((6.0, 1.0))
    shown.world.maps = False
    shown.show_maps()
    assert shown.images() == {}


def test_map_in_an_unknown_frame_is_listed_with_the_reason(shown):
    shown.source.set_map(Grid([[100]], 2.0, (0.0, 0.0, 0.0), "hall/map"))
    shown.show_maps()
    assert shown.images() == {}
    assert shown.world.missing == [("map hall/map", "its frame 'hall/map' has no pose in 'odom'")]
