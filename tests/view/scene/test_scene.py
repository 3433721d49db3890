"""Scene: what of robots and frames is drawn, and when."""

from __future__ import annotations

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.scene_drawing import at, drawn, handles, in_fixed, is_seen, moment, sent_messages, tree  # noqa: E402

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
    """Where the shapes are that are seen."""
    return sorted(path for path in handles(server, viser.GlbHandle) if is_seen(server, path))


def places(server) -> list[tuple[float, ...]]:
    return sorted(tuple(np.round(in_fixed(server, path)[:3], 6).tolist()) for path in bodies(server))


@pytest.fixture
def scene(server) -> Scene:
    """A cart with one box and one wheel to be seen, and one sphere to bump into."""
    made = Scene(server)
    made.set_robot("cart", CART)
    drawn(made, moment(TREE, POSES))
    return made


def test_each_visual_is_drawn_where_its_link_is(scene, server):
    # The box is 1 m above base, which is at x = 1; the wheel is 2 m to its side.
    assert places(server) == [(1, 0, 1), (1, 2, 0)]


def test_a_shape_goes_with_its_link_without_being_sent_again(scene, server):
    with sent_messages(server) as messages:
        scene.axes = False
        scene.show(moment(TREE, POSES | {"cart/base": at(3, 0, 0)}), "map")
    assert [type(message).__name__ for message in messages if "Visibility" not in type(message).__name__] == [
        "SetPositionMessage"
    ]
    assert places(server) == [(3, 0, 1), (3, 2, 0)]


def test_what_cannot_be_drawn_is_listed_and_the_rest_is_drawn(scene):
    (faulty, why), (uri, where) = scene.missing_meshes("cart")
    assert faulty == "cart, line 9"
    assert "box size: '1 1' has 2 of 3 numbers" in why
    assert uri == "package://nowhere/rim.stl"
    assert "there is no package 'nowhere'" in where
    assert scene.missing_meshes("nobody") == ()


def test_collisions_are_drawn_when_they_are_asked_for(scene, server):
    shown = moment(TREE, POSES)
    scene.collisions = True
    drawn(scene, shown)
    assert len(bodies(server)) == 3
    scene.visuals = False
    scene.show(shown, "map")
    assert places(server) == [(1, 0, 0)]
    scene.visuals, scene.collisions = True, False
    scene.show(shown, "map")
    assert places(server) == [(1, 0, 1), (1, 2, 0)]


def test_a_silent_robot_is_drawn_in_grey_and_says_since_when(scene, server):
    shown = moment(TREE, POSES)
    own = bodies(server)
    scene.grey("cart", "silent for 4.2 s")
    drawn(scene, shown)
    grey = bodies(server)
    assert places(server) == [(1, 0, 1), (1, 2, 0)]
    assert set(grey).isdisjoint(own)
    assert [label.text for label in handles(server, viser.LabelHandle).values()] == ["cart: silent for 4.2 s"]
    scene.grey("cart", "silent for 5.0 s")
    scene.show(shown, "map")
    assert [label.text for label in handles(server, viser.LabelHandle).values()] == ["cart: silent for 5.0 s"]
    scene.grey("cart", None)
    scene.show(shown, "map")
    assert bodies(server) == own
    assert handles(server, viser.LabelHandle) == {}


def test_only_the_silent_robot_is_grey(scene, server):
    scene.set_robot("tug", CART)
    drawn(scene, moment(TWO, POSES))
    both = bodies(server)
    scene.grey("tug", "silent")
    drawn(scene, moment(TWO, POSES))
    assert len(both) == len(bodies(server)) == 4
    assert len(set(both) & set(bodies(server))) == 2


def test_robots_that_look_the_same_share_their_meshes(scene, server):
    scene.set_robot("tug", CART)
    drawn(scene, moment(TWO, POSES))
    files = [handle.glb_data for handle in handles(server, viser.GlbHandle).values()]
    assert len(files) == 4
    assert len({id(file) for file in files}) == 2


def test_a_robot_that_goes_is_drawn_no_more(scene, server):
    scene.remove_robot("cart")
    scene.show(moment(TREE, POSES), "map")
    assert bodies(server) == []
    scene.remove_robot("cart")


def test_a_robot_that_goes_with_its_frames_and_comes_back_is_drawn_again(scene, server):
    scene.remove_robot("cart")
    scene.show(moment(tree({"map": None}), {}), "map")
    scene.set_robot("cart", CART)
    drawn(scene, moment(TREE, POSES))
    assert places(server) == [(1, 0, 1), (1, 2, 0)]


def test_frames_may_go_before_their_robot_does(scene, server):
    scene.names = True
    scene.grey("cart", "silent")
    drawn(scene, moment(TREE, POSES))
    scene.show(moment(tree({"map": None}), {}), "map")
    assert bodies(server) == []
    scene.remove_robot("cart")
    scene.show(moment(tree({"map": None}), {}), "map")


def test_another_model_of_the_same_robot_takes_its_place(scene, server):
    other = parse_urdf(URDF.replace('xyz="0 0 1"', 'xyz="0 0 7"'), "cart.urdf")
    scene.set_robot("cart", other)
    drawn(scene, moment(TREE, POSES))
    assert places(server) == [(1, 0, 7), (1, 2, 0)]


def test_links_without_a_place_are_not_drawn(scene, server):
    scene.show(moment(TREE, POSES, unknown=["cart/wheel"]), "map")
    assert places(server) == [(1, 0, 1)]
    # Seen from the wheel, it is the rest that has no place.
    scene.show(moment(TREE, POSES, unknown=["cart/wheel"]), "cart/wheel")
    assert places(server) == [(0, 0, 0)]


def the_axes(server):
    (axes,) = handles(server, viser.BatchedAxesHandle).values()
    return axes


def test_all_axes_are_one_node_with_one_for_each_frame_that_has_a_place(scene, server):
    assert np.sort(the_axes(server).batched_positions, axis=0).tolist() == [[0, 0, 0], [1, 0, 0], [1, 2, 0]]
    scene.show(moment(TREE, POSES, unknown=["cart/wheel"]), "map")
    assert the_axes(server).batched_positions.tolist() == [[0, 0, 0], [1, 0, 0]]
    scene.axes = False
    scene.show(moment(TREE, POSES), "map")
    assert not the_axes(server).visible
    scene.axes = True
    scene.show(moment(TREE, POSES), "map")
    assert the_axes(server).visible
    assert len(the_axes(server).batched_positions) == 3


def test_parent_lines_join_each_frame_with_its_parent(scene, server):
    assert handles(server, viser.LineSegmentsHandle) == {}
    scene.parent_lines = True
    scene.show(moment(TREE, POSES), "map")
    (lines,) = handles(server, viser.LineSegmentsHandle).values()
    assert lines.points.tolist() == [[[0, 0, 0], [1, 0, 0]], [[1, 0, 0], [1, 2, 0]]]
    scene.parent_lines = False
    scene.show(moment(TREE, POSES), "map")
    assert not lines.visible


def texts(server) -> set[str]:
    return {label.text for path, label in handles(server, viser.LabelHandle).items() if is_seen(server, path)}


def test_names_hang_on_their_frames(scene, server):
    scene.names = True
    scene.show(moment(TREE, POSES), "map")
    assert texts(server) == {"map", "base", "wheel"}
    with sent_messages(server) as messages:
        scene.axes = False
        scene.show(moment(TREE, POSES | {"cart/base": at(3, 0, 0)}), "map")
    assert not any("Label" in type(message).__name__ for message in messages)
    scene.names = False
    scene.show(moment(TREE, POSES), "map")
    assert texts(server) == set()


def test_frames_of_several_robots_are_called_in_full(scene, server):
    scene.names = True
    scene.show(moment(TWO, POSES), "map")
    assert texts(server) == {"map", "cart/base", "cart/wheel", "tug/base", "tug/wheel"}


def test_frames_in_one_place_share_a_label_until_they_part(scene, server):
    scene.names = True
    together = {"cart/base": at(1, 0, 0), "cart/wheel": at(0, 0.001, 0, 1.0)}
    scene.show(moment(TREE, together), "map")
    assert texts(server) == {"map", "base\nwheel"}
    scene.show(moment(TREE, POSES), "map")
    assert texts(server) == {"map", "base", "wheel"}


def test_many_labels_are_as_large_as_things_are(scene, server):
    def modes() -> set[str]:
        labels = handles(server, viser.LabelHandle).items()
        return {label.font_size_mode for path, label in labels if is_seen(server, path)}

    scene.names = True
    names = ["map", *(f"f{k}" for k in range(60))]
    many = tree({name: None if name == "map" else "map" for name in names})
    poses = {name: at(k) for k, name in enumerate(names)}
    scene.show(moment(many, poses), "map")
    assert modes() == {"scene"}
    scene.show(moment(TREE, POSES), "map")
    assert modes() == {"screen"}
