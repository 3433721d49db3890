"""Texts of the tabs View, Frames and Graph, and the search for frames by parts of their names."""

from __future__ import annotations

import re
from datetime import datetime

import numpy as np
import pytest
from helpers.robots import SECOND, UPRIGHT

from zstate import Transform, TransformBuffer, load_model
from zstate.buffer.buffer import feed_of
from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.net.graph import Graph, StreamUse
from zstate.net.status_monitor import WriterState
from zstate.view.panels import html
from zstate.view.panels.display_panels import (
    disconnected_html,
    graph_html,
    search_frames,
    stale_reason,
    stale_text,
    state_text,
    unplaced_html,
)
from zstate.wire.messages import Level, Status

ORIGIN = (0.0, 0.0, 0.0)


def plain(text: str) -> str:
    """The text without its tags."""
    return re.sub(r"<[^>]*>", " ", text)


def snapshot(names: tuple[str, ...], reasons: dict[int, str]) -> FramePoses:
    count = len(names)
    tree = FrameTable(names, np.full(count, -1, dtype=np.intp), ("root",) * count, (None,) * count)
    known = np.array([row not in reasons for row in range(count)])
    return FramePoses(None, tree, np.tile([0.0, 0, 0, 0, 0, 0, 1], (count, 1)), known, reasons)


def test_frames_without_a_pose_are_grouped_by_reason():
    names = tuple(f"r/link{number}" for number in range(6))
    text = plain(unplaced_html(snapshot(names, dict.fromkeys(range(1, 6), "no joint sample"))))
    assert "5 frames have no pose" in text
    assert "r/link1, r/link2 and 3 more: no joint sample" in text


def test_single_frame_without_a_pose_is_in_the_singular():
    text = plain(unplaced_html(snapshot(("r/a", "r/b"), {1: "silent"})))
    assert "1 frame has no pose" in text
    assert "r/b: silent" in text


def test_unconnected_trees_are_listed_with_a_command_that_connects_them():
    parents = np.array([-1, 0, -1, 2, -1], dtype=np.intp)
    names = ("a/base", "a/tip", "b/base", "b/tip", "map")
    tree = FrameTable(names, parents, ("root", "joint", "root", "joint", "root"), (None,) * 5)
    text = plain(disconnected_html(tree, "a/tip"))
    assert "2 frames are not connected to the fixed frame" in text
    assert "b/base, and 1 below it\nmap" in text
    assert "zstate static a/base b/base --xyz 1 0 0" in text
    connected = FrameTable(names[:2], parents[:2], ("root", "joint"), (None,) * 2)
    assert not disconnected_html(connected, "a/base")


def test_no_text_if_every_frame_has_a_pose():
    assert not unplaced_html(snapshot(("r/a",), {}))


@pytest.mark.parametrize(
    ("silent_s", "lasting"),
    [(4.71, "4 s"), (75.0, "1 min 15 s"), (3 * 3600 + 25 * 60 + 7, "3 h 25 min")],
)
def test_stale_text_has_duration_and_start(silent_s: float, lasting: str):
    now = datetime(2026, 3, 4, 15, 6, 7).astimezone()
    since = datetime.fromtimestamp(now.timestamp() - silent_s).astimezone()
    assert stale_text(silent_s, now.timestamp()) == f"silent for {lasting}, since {since:%H:%M:%S}"


def rover_buffer() -> TransformBuffer:
    """diffbot on its odometry, joint states at 10 Hz; and a camera that tracks a cup at 5 Hz and a box."""
    buffer = TransformBuffer()
    joints = buffer.add_robot(load_model("diffbot"), "rover")
    for tick in range(3):
        buffer.insert_joints(joints, tick * SECOND // 10, [0.0, 0.0])
        buffer.insert(Transform("rover/odom", "rover/base_footprint", ORIGIN, UPRIGHT, tick * SECOND // 10))
        buffer.insert(Transform("cam/room", "cam/cup", ORIGIN, UPRIGHT, tick * SECOND // 5))
    buffer.insert(Transform("cam/room", "cam/box", ORIGIN, UPRIGHT, 0))
    return buffer


def test_state_is_the_rate_of_the_joint_states_or_of_transforms():
    tree = rover_buffer().frame_table()
    assert state_text("rover", tree, is_live=True) == "live, 10.0 Hz"
    assert state_text("cam", tree, is_live=True) == "live, 5.0 Hz, transforms only"
    assert state_text("cam", tree, is_live=False) == "in the past, 5.0 Hz, transforms only"
    assert state_text("driver", tree, is_live=True) == "no model yet"


def test_state_is_that_of_the_parts_if_other_writers_move_all_joints():
    """As on the ROS 2 wire, where a state publisher has the model, and a driver the joint states."""
    buffer = TransformBuffer()
    robot, feed = buffer.add_robot(load_model("rrbot"), "rrbot"), feed_of(buffer)
    part = feed.add_part(robot, robot.model.joint_names)
    feed.assign_joints(robot, dict.fromkeys(robot.model.joint_names, part))
    for tick in range(3):
        buffer.insert_joints(part, tick * SECOND // 20, [0.0, 0.0])
    tree = buffer.frame_table()
    assert state_text("rrbot", tree, is_live=True) == "live, 20.0 Hz"
    assert stale_reason("rrbot", tree, {part: "silent for 4 s"}) == "silent for 4 s"


def test_robot_is_stale_if_a_writer_that_places_it_is():
    tree = rover_buffer().frame_table()
    joints, odometry = tree.tracks_of["rover"]
    assert stale_reason("rover", tree, {}) is None
    assert (
        stale_reason("rover", tree, {joints: "silent for 4 s", odometry: "silent for 2 s"})
        == "silent for 4 s"
    )
    assert stale_reason("rover", tree, {odometry: "silent for 2 s"}) == "its place: silent for 2 s"


def test_tracked_objects_are_stale_if_all_of_their_writers_are():
    tree = rover_buffer().frame_table()
    cup, box = tree.tracks_of["cam"]
    assert stale_reason("cam", tree, {box: "silent for 4 s"}) is None
    assert stale_reason("cam", tree, {cup: "silent for 3 s", box: "silent for 4 s"}) == "silent for 3 s"


NAMES = (
    "panda/panda_link0",
    "panda/panda_hand_tcp",
    "panda/panda_hand",
    "talos/gripper_left_link",
    "talos/gripper_right_link",
    "talos/hand",
)


def test_empty_query_returns_all_frames_in_order():
    assert search_frames(NAMES, "  ") == NAMES


def test_exact_name_comes_first_then_the_others_in_order():
    assert search_frames(NAMES, "hand") == ("talos/hand", "panda/panda_hand_tcp", "panda/panda_hand")
    assert search_frames(NAMES, "panda_hand") == ("panda/panda_hand", "panda/panda_hand_tcp")


def test_prefix_matches_come_before_inner_matches():
    assert search_frames(NAMES, "gripper")[0] == "talos/gripper_left_link"
    assert search_frames(("r/a_left", "r/left_arm"), "left") == ("r/left_arm", "r/a_left")


def test_all_words_must_occur_in_any_order_and_case():
    assert search_frames(NAMES, "LEFT talos") == ("talos/gripper_left_link",)
    assert search_frames(NAMES, "link/gripper_right") == ("talos/gripper_right_link",)


def test_misspelt_query_returns_similar_names():
    assert search_frames(NAMES, "panda_hnad")[0] == "panda/panda_hand"
    assert search_frames(NAMES, "xyzzy") == ()


def status(level: Level, text: str = "") -> Status:
    return Status(1, 2, level, "driver", "host", 42, 99.94, 1000, 0, text)


def test_publisher_is_listed_with_its_rate_and_status():
    text = plain(graph_html([WriterState("r1", status("warn", "3 ticks late"), 0.5)], Graph()))
    assert "r1 at 99.9 Hz" in text
    assert "driver pid 42: 3 ticks late" in text


def test_expired_status_is_an_alarm():
    made = graph_html([WriterState("r1", status("ok"), 12.0)], Graph())
    assert "no status for 12.0 s" in plain(made)
    assert html.ALARM in made


def test_streams_with_the_same_writers_are_grouped_and_no_writer_is_an_alarm():
    uses = (
        StreamUse("r1", "joint_states", ("a",), ("b", "c")),
        StreamUse("r1", "tf", ("a",), ("b", "c")),
        StreamUse("r2", "tf", (), ("b",)),
    )
    made = graph_html((), Graph(uses))
    assert "r1: joint_states, tf" in plain(made)
    assert re.search(r"written by\s+none", plain(made))
    assert made.count(html.ALARM) == 1
