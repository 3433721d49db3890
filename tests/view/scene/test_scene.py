"""Scene: which parts of robots and frames are drawn, and when."""

from __future__ import annotations

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.scene_drawing import at, drawn, handles, is_visible, pose_in_fixed, sent_messages, snapshot, tree  # noqa: E402

from zstate.model.urdf import parse_urdf  # noqa: E402
from zstate.view.scene.scene import Scene  # noqa: E402

URDF = """<robot name="cart">
<link name="base">
  <visual><origin xyz="0 0 1"/><geometry><box size="1 1 1"/></geometry></visual>
  <collision><geometry><sphere radius="1"/></geometry></collision>
</link>
<link name="wheel">
  <visual><geometry><cylinder radius="0.5" length="0.1"/></geometry></visual>
  <visual><geometry><mesh filename="package://nowhere/rim.stl"/></geometry></visual>
  <visual><geometry><box size="1 1"/></geometry></visual>
</link>
<joint name="axle" type="continuous"><parent link="base"/><child link="wheel"/></joint>
</robot>"""
CART = parse_urdf(URDF, "cart.urdf")
TREE = tree({"map": None, "cart/base": "map", "cart/wheel": "cart/base"})
TWO = tree(
    {"map": None, "cart/base": "map", "cart/wheel": "cart/base", "tug/base": "map", "tug/wheel": "tug/base"}
)
POSES = {
    "cart/base": at(1, 0, 0),
    "cart/wheel": at(0, 2, 0),
    "tug/base": at(0, 5, 0),
    "tug/wheel": at(0, 1, 0),
}


def bodies(server) -> list[str]:
    """The paths of the visible shapes."""
    return sorted(path for path in handles(server, viser.GlbHandle) if is_visible(server, path))


def places(server) -> list[tuple[float, ...]]:
    return sorted(tuple(np.round(pose_in_fixed(server, path)[:3], 6).tolist()) for path in bodies(server))


@pytest.fixture
def scene(server) -> Scene:
    """A cart with a box and a wheel as visuals, and a sphere as collision."""
    made = Scene(server)
    made.set_robot("cart", CART)
    drawn(made, snapshot(TREE, POSES))
    return made


def test_visuals_are_drawn_at_their_links(scene, server):
    # The box is 1 m above base, which is at x = 1; the wheel is 2 m to its side.
    assert places(server) == [(1, 0, 1), (1, 2, 0)]


def test_shape_moves_with_its_link_without_being_sent_again(scene, server):
    with sent_messages(server) as messages:
        scene.show(snapshot(TREE, POSES | {"cart/base": at(3, 0, 0)}), "map")
    assert [type(message).__name__ for message in messages] == ["SetPositionMessage"]
    assert places(server) == [(3, 0, 1), (3, 2, 0)]


def test_missing_files_are_listed_and_other_shapes_are_drawn(scene):
    (faulty, why), (uri, where) = scene.missing_meshes("cart")
    assert faulty == "cart, line 9"
    assert "box size: '1 1' has 2 of 3 numbers" in why
    assert uri == "package://nowhere/rim.stl"
    assert "there is no package 'nowhere'" in where
    assert scene.missing_meshes("unknown") == ()


def test_collisions_are_drawn_on_request(scene, server):
    shown = snapshot(TREE, POSES)
    scene.collisions = True
    drawn(scene, shown)
    assert len(bodies(server)) == 3
    scene.visuals = False
    scene.show(shown, "map")
    assert places(server) == [(1, 0, 0)]
    scene.visuals, scene.collisions = True, False
    scene.show(shown, "map")
    assert places(server) == [(1, 0, 1), (1, 2, 0)]


def test_stale_robot_is_drawn_in_grey_with_its_text(scene, server):
    shown = snapshot(TREE, POSES)
    own = bodies(server)
    scene.set_stale("cart", "silent for 4.2 s")
    drawn(scene, shown)
    grey = bodies(server)
    assert places(server) == [(1, 0, 1), (1, 2, 0)]
    assert set(grey).isdisjoint(own)
    assert [label.text for label in handles(server, viser.LabelHandle).values()] == ["cart: silent for 4.2 s"]
    scene.set_stale("cart", "silent for 5.0 s")
    scene.show(shown, "map")
    assert [label.text for label in handles(server, viser.LabelHandle).values()] == ["cart: silent for 5.0 s"]
    scene.set_stale("cart", None)
    scene.show(shown, "map")
    assert bodies(server) == own
    assert handles(server, viser.LabelHandle) == {}


def test_text_of_a_stale_robot_is_at_its_model_or_at_its_first_frame(scene, server):
    odometry = tree(
        {
            "map": None,
            "cart/odom": "map",
            "cart/base": "cart/odom",
            "cart/wheel": "cart/base",
            "cam/cup": "map",
        }
    )
    poses = POSES | {"cart/odom": at(0, 0, 0), "cam/cup": at(0, 7, 0)}
    scene.set_stale("cart", "silent")
    scene.set_stale("cam", "silent")
    drawn(scene, snapshot(odometry, poses))
    labels = handles(server, viser.LabelHandle)
    found = {one.text: tuple(pose_in_fixed(server, path)[:3]) for path, one in labels.items()}
    assert found == {"cart: silent": (1.0, 0.0, 0.0), "cam: silent": (0.0, 7.0, 0.0)}


def test_only_the_stale_robot_is_grey(scene, server):
    scene.set_robot("tug", CART)
    drawn(scene, snapshot(TWO, POSES))
    both = bodies(server)
    scene.set_stale("tug", "silent")
    drawn(scene, snapshot(TWO, POSES))
    assert len(both) == len(bodies(server)) == 4
    assert len(set(both) & set(bodies(server))) == 2


def test_identical_robots_share_their_meshes(scene, server):
    scene.set_robot("tug", CART)
    drawn(scene, snapshot(TWO, POSES))
    files = [handle.glb_data for handle in handles(server, viser.GlbHandle).values()]
    assert len(files) == 4
    assert len({id(file) for file in files}) == 2


def test_removed_robot_is_not_drawn(scene, server):
    scene.remove_robot("cart")
    scene.show(snapshot(TREE, POSES), "map")
    assert bodies(server) == []
    scene.remove_robot("cart")


def test_robot_removed_with_its_frames_can_be_added_again(scene, server):
    scene.remove_robot("cart")
    scene.show(snapshot(tree({"map": None}), {}), "map")
    scene.set_robot("cart", CART)
    drawn(scene, snapshot(TREE, POSES))
    assert places(server) == [(1, 0, 1), (1, 2, 0)]


def test_frames_may_disappear_before_their_robot(scene, server):
    scene.names = True
    scene.set_stale("cart", "silent")
    drawn(scene, snapshot(TREE, POSES))
    scene.show(snapshot(tree({"map": None}), {}), "map")
    assert bodies(server) == []
    scene.remove_robot("cart")
    scene.show(snapshot(tree({"map": None}), {}), "map")


def test_new_model_replaces_the_robot(scene, server):
    other = parse_urdf(URDF.replace('xyz="0 0 1"', 'xyz="0 0 7"'), "cart.urdf")
    scene.set_robot("cart", other)
    drawn(scene, snapshot(TREE, POSES))
    assert places(server) == [(1, 0, 7), (1, 2, 0)]


def test_links_without_a_pose_are_not_drawn(scene, server):
    scene.show(snapshot(TREE, POSES, unknown=["cart/wheel"]), "map")
    assert places(server) == [(1, 0, 1)]
    # In the frame of the wheel, the other links have no pose.
    scene.show(snapshot(TREE, POSES, unknown=["cart/wheel"]), "cart/wheel")
    assert places(server) == [(0, 0, 0)]


def the_axes(server):
    (axes,) = handles(server, viser.BatchedAxesHandle).values()
    return axes


def axes_on_nodes(server) -> list[tuple[float, ...]]:
    """The places of the nodes with axes."""
    nodes = handles(server, viser.FrameHandle).items()
    paths = [path for path, node in nodes if node.show_axes and is_visible(server, path)]
    return sorted(tuple(np.round(pose_in_fixed(server, path)[:3], 6).tolist()) for path in paths)


def test_axes_of_a_robot_are_on_the_nodes_of_its_meshes_while_their_poses_are_known(scene, server):
    assert axes_on_nodes(server) == [(1, 0, 0), (1, 2, 0)]
    scene.show(snapshot(TREE, POSES | {"cart/base": at(3, 0, 0)}), "map")
    assert axes_on_nodes(server) == [(3, 0, 0), (3, 2, 0)]
    scene.show(snapshot(TREE, POSES, unknown=["cart/wheel"]), "map")
    assert axes_on_nodes(server) == [(1, 0, 0)]
    scene.axes = False
    scene.show(snapshot(TREE, POSES), "map")
    assert axes_on_nodes(server) == []
    scene.axes = True
    scene.show(snapshot(TREE, POSES), "map")
    assert axes_on_nodes(server) == [(1, 0, 0), (1, 2, 0)]


def test_axes_of_other_frames_are_one_node(server):
    scene = Scene(server)
    scene.show(snapshot(TREE, POSES), "map")
    assert axes_on_nodes(server) == []
    assert np.sort(the_axes(server).batched_positions, axis=0).tolist() == [[0, 0, 0], [1, 0, 0], [1, 2, 0]]
    scene.show(snapshot(TREE, POSES, unknown=["cart/wheel"]), "map")
    assert the_axes(server).batched_positions.tolist() == [[0, 0, 0], [1, 0, 0]]
    scene.axes = False
    scene.show(snapshot(TREE, POSES), "map")
    assert not the_axes(server).visible
    scene.axes = True
    scene.show(snapshot(TREE, POSES), "map")
    assert the_axes(server).visible
    assert len(the_axes(server).batched_positions) == 3
    scene.set_robot("cart", CART)
    drawn(scene, snapshot(TREE, POSES))
    assert the_axes(server).batched_positions.tolist() == [[0, 0, 0]]
    assert axes_on_nodes(server) == [(1, 0, 0), (1, 2, 0)]


def test_parent_lines_connect_each_frame_to_its_parent(scene, server):
    assert handles(server, viser.LineSegmentsHandle) == {}
    scene.parent_lines = True
    scene.show(snapshot(TREE, POSES), "map")
    (lines,) = handles(server, viser.LineSegmentsHandle).values()
    assert lines.points.tolist() == [[[0, 0, 0], [1, 0, 0]], [[1, 0, 0], [1, 2, 0]]]
    scene.parent_lines = False
    scene.show(snapshot(TREE, POSES), "map")
    assert not lines.visible


def texts(server) -> set[str]:
    return {
        label.text for path, label in handles(server, viser.LabelHandle).items() if is_visible(server, path)
    }


def test_name_labels_move_with_their_frames(scene, server):
    scene.names = True
    scene.show(snapshot(TREE, POSES), "map")
    assert texts(server) == {"map", "base", "wheel"}
    with sent_messages(server) as messages:
        scene.axes = False
        scene.show(snapshot(TREE, POSES | {"cart/base": at(3, 0, 0)}), "map")
    assert not any("Label" in type(message).__name__ for message in messages)
    scene.names = False
    scene.show(snapshot(TREE, POSES), "map")
    assert texts(server) == set()


def test_name_labels_of_several_robots_include_the_robot(scene, server):
    scene.names = True
    scene.show(snapshot(TWO, POSES), "map")
    assert texts(server) == {"map", "cart/base", "cart/wheel", "tug/base", "tug/wheel"}


def test_frames_at_one_place_share_a_label_until_they_separate(scene, server):
    scene.names = True
    together = {"cart/base": at(1, 0, 0), "cart/wheel": at(0, 0.001, 0, 1.0)}
    scene.show(snapshot(TREE, together), "map")
    assert texts(server) == {"map", "base\nwheel"}
    scene.show(snapshot(TREE, POSES), "map")
    assert texts(server) == {"map", "base", "wheel"}


def test_many_labels_have_a_size_in_the_scene(scene, server):
    def modes() -> set[str]:
        labels = handles(server, viser.LabelHandle).items()
        return {label.font_size_mode for path, label in labels if is_visible(server, path)}

    scene.names = True
    names = ["map", *(f"f{k}" for k in range(60))]
    many = tree({name: None if name == "map" else "map" for name in names})
    poses = {name: at(k) for k, name in enumerate(names)}
    scene.show(snapshot(many, poses), "map")
    assert modes() == {"scene"}
    scene.show(snapshot(TREE, POSES), "map")
    assert modes() == {"screen"}
