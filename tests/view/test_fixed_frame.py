"""The frame that everything is seen from."""

from __future__ import annotations

from helpers.robots import RRBOT

from zstate.buffer.buffer import TransformBuffer
from zstate.transform import Transform
from zstate.view.data_source import FixedFrame, ViewSource, default_fixed_frame


def filled() -> TransformBuffer:
    buffer = TransformBuffer()
    buffer.add_robot(RRBOT, "r1")
    return buffer


def test_everything_is_seen_from_the_root_with_the_most_frames():
    buffer = filled()
    buffer.insert_static(Transform("map", "odom", [0, 0, 0], [0, 0, 0, 1]))
    with ViewSource(None, buffer=buffer) as world:
        assert default_fixed_frame(world.snapshot().tree) == f"r1/{RRBOT.root}"


def test_a_chosen_frame_is_kept_while_it_is_there():
    with ViewSource(None, buffer=filled()) as world:
        tree, fixed = world.snapshot().tree, FixedFrame()
        fixed.requested = tree.names[2]
        assert fixed.resolve(tree) == tree.names[2]
        fixed.requested = "gone"
        assert fixed.resolve(tree) == f"r1/{RRBOT.root}"


def test_where_there_is_no_frame_there_is_none_to_see_from():
    with ViewSource(None, buffer=TransformBuffer()) as world:
        assert FixedFrame().resolve(world.snapshot().tree) == ""
