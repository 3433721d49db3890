"""FrameNodes: only poses that changed are sent to viser."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.scene_drawing import at, is_visible, pose_in_fixed, sent_messages, snapshot, tree  # noqa: E402

from zstate import se3  # noqa: E402
from zstate.view.scene.frames import FrameNodes  # noqa: E402

ARM = tree({"map": None, "arm/base": "map", "arm/upper": "arm/base", "arm/tool": "arm/upper"})
ALL = frozenset({*ARM.names, "cup"})
POSES = {"arm/base": at(1, 2, 0, pi / 2), "arm/upper": at(0, 0, 0.5, 0.3), "arm/tool": at(0.4, 0, 0)}


def show(nodes: FrameNodes, shown, fixed: str, wanted: frozenset[str]) -> None:
    nodes.show(shown, shown.poses_in(fixed), wanted)


def assert_placed(server, nodes: FrameNodes, shown, fixed: str) -> None:
    """Every frame with a pose is at that pose in viser, and the others are hidden."""
    for name, expected in zip(shown.tree.names, shown.poses_in(fixed), strict=True):
        path = nodes.paths[name]
        assert nodes.is_shown(name) == bool(np.isfinite(expected[0]))
        if nodes.is_shown(name):
            assert is_visible(server, path)
            found = pose_in_fixed(server, path)
            apart = se3.compose(se3.invert(found), tuple(expected.tolist()))
            assert apart[:3] == pytest.approx((0, 0, 0), abs=1e-5)
            assert abs(apart[6]) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("fixed", ARM.names)
def test_nodes_are_at_the_poses_in_the_fixed_frame(server, fixed):
    nodes = FrameNodes(server.scene)
    shown = snapshot(ARM, POSES)
    show(nodes, shown, fixed, ALL)
    assert_placed(server, nodes, shown, fixed)


def test_unchanged_poses_are_not_sent(server):
    nodes = FrameNodes(server.scene)
    show(nodes, snapshot(ARM, POSES), "map", ALL)
    with sent_messages(server) as messages:
        show(nodes, snapshot(ARM, POSES, stamp=1), "map", ALL)
    assert messages == []


def test_rotating_joint_is_one_message(server):
    nodes = FrameNodes(server.scene)
    show(nodes, snapshot(ARM, POSES), "map", ALL)
    turned = snapshot(ARM, POSES | {"arm/upper": at(0, 0, 0.5, 0.8)})
    with sent_messages(server) as messages:
        show(nodes, turned, "map", ALL)
    assert [type(message).__name__ for message in messages] == ["SetOrientationMessage"]
    assert_placed(server, nodes, turned, "map")


def test_another_fixed_frame_moves_only_the_root(server):
    nodes = FrameNodes(server.scene)
    shown = snapshot(ARM, POSES)
    show(nodes, shown, "map", ALL)
    with sent_messages(server) as messages:
        show(nodes, shown, "arm/tool", ALL)
    assert {message.name for message in messages} == {nodes.paths["map"]}
    assert_placed(server, nodes, shown, "arm/tool")


def test_invisible_noise_is_not_sent_until_it_accumulates(server):
    nodes = FrameNodes(server.scene)
    show(nodes, snapshot(ARM, POSES), "map", ALL)
    with sent_messages(server) as messages:
        for k in range(1, 5):
            show(nodes, snapshot(ARM, POSES | {"arm/tool": at(0.4 + k * 2e-7)}), "map", ALL)
        assert messages == []
        show(nodes, snapshot(ARM, POSES | {"arm/tool": at(0.4 + 2e-5)}), "map", ALL)
        assert len(messages) == 1


def test_frames_without_a_pose_are_hidden_with_their_descendants(server):
    nodes = FrameNodes(server.scene)
    shown = snapshot(ARM, POSES, unknown=["arm/upper"])
    show(nodes, shown, "map", ALL)
    assert_placed(server, nodes, shown, "map")
    assert [is_visible(server, nodes.paths[name]) for name in ARM.names] == [True, True, False, False]
    again = snapshot(ARM, POSES)
    show(nodes, again, "map", ALL)
    assert_placed(server, nodes, again, "map")


def test_fixed_frame_below_a_missing_pose_shows_its_descendants(server):
    nodes = FrameNodes(server.scene)
    shown = snapshot(ARM, POSES, unknown=["arm/upper"])
    show(nodes, shown, "arm/tool", ALL)
    assert [nodes.is_shown(name) for name in ARM.names] == [False, False, True, True]
    assert_placed(server, nodes, shown, "arm/tool")


def test_new_frame_does_not_change_other_nodes(server):
    nodes = FrameNodes(server.scene)
    show(nodes, snapshot(ARM, POSES), "map", ALL)
    before = dict(nodes.paths)
    more = tree(
        {"map": None, "arm/base": "map", "cup": "map", "arm/upper": "arm/base", "arm/tool": "arm/upper"}
    )
    with sent_messages(server) as messages:
        show(nodes, snapshot(more, POSES), "map", ALL)
    assert {name: nodes.paths[name] for name in before} == before
    assert not any("Remove" in type(message).__name__ for message in messages)
    created = [message.name for message in messages if type(message).__name__ == "FrameMessage"]
    assert created == [nodes.paths["cup"]]


def test_frame_with_a_new_parent_keeps_its_descendants(server):
    nodes = FrameNodes(server.scene)
    show(nodes, snapshot(ARM, POSES), "map", ALL)
    version = nodes.version
    grasped = tree({"map": None, "arm/base": "map", "arm/tool": "arm/base", "arm/upper": "arm/tool"})
    shown = snapshot(grasped, {"arm/tool": at(1, 0, 0), "arm/upper": at(0, 2, 0)})
    show(nodes, shown, "map", ALL)
    assert nodes.version > version
    assert_placed(server, nodes, shown, "map")
    back = snapshot(ARM, POSES)
    show(nodes, back, "map", ALL)
    assert_placed(server, nodes, back, "map")


def test_node_of_a_removed_frame_is_removed(server):
    nodes = FrameNodes(server.scene)
    show(nodes, snapshot(ARM, POSES), "map", ALL)
    tool = nodes.paths["arm/tool"]
    show(nodes, snapshot(tree({"map": None, "arm/base": "map"}), POSES), "map", ALL)
    assert "arm/tool" not in nodes.paths
    assert server.scene.get_handle_by_name(tool) is None
