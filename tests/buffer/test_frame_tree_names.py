"""Frames: names, parents, loops, robots, and what becomes of them."""

from __future__ import annotations

import asyncio
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.buffers import NOW, S, every_joint, failure, filled, moving, static, x_of

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import JointTrack
from zstate.errors import (
    AmbiguousFrame,
    Disconnected,
    InFuture,
    InsertRefused,
    InvalidInput,
    NoData,
    UnknownFrame,
)
from zstate.model.load import load_model
from zstate.transform import Transform


def refusal(buffer: TransformBuffer, parent: str, child: str, writer: str | None = None) -> InsertRefused:
    """Why neither insert takes the edge; the buffer stays as it was."""
    before = buffer.frames()
    with pytest.raises(InsertRefused) as caught:
        buffer.insert(moving(parent, child, NOW), writer=writer)
    with pytest.raises(InsertRefused) as again:
        buffer.insert_static(static(parent, child), writer=writer)
    assert again.value.reason == caught.value.reason
    assert buffer.frames() == before
    return caught.value


@pytest.mark.parametrize(("parent", "child"), [("", "b"), ("a", ""), ("/a", "b"), ("a", "/b"), ("a", "/")])
def test_empty_names_and_leading_slashes_are_refused_at_insert(parent: str, child: str) -> None:
    buffer = TransformBuffer()
    with pytest.raises(InsertRefused) as caught:
        buffer.insert_many([(parent, child)], 0, [[0, 0, 0, 0, 0, 0, 1]])
    assert (caught.value.reason, caught.value.edge) == ("frame name", (parent, child))
    assert buffer.frames() == ()


NO_NAMES = ["", "/a", "/", None, 5, 1.5, b"a", ("a",), ["a"], {}, np.array(["a"])]


def doors(buffer: TransformBuffer, track: JointTrack, name: Any) -> dict[str, Callable[[], object]]:
    """Every call that takes a frame name, with ``name`` in each of its places."""
    pose7 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    return {
        "lookup target": lambda: buffer.lookup(name, "a"),
        "lookup source": lambda: buffer.lookup("a", name),
        "lookup at": lambda: buffer.lookup("a", name, 5),
        "lookup waiting": lambda: buffer.lookup("a", name, timeout_s=10.0),
        "lookup_many": lambda: buffer.lookup_many("a", name, [5]),
        "lookup_between target": lambda: buffer.lookup_between(name, 0, "a", 0, "b"),
        "lookup_between source": lambda: buffer.lookup_between("a", 0, name, 0, "b"),
        "lookup_between fixed": lambda: buffer.lookup_between("a", 0, "b", 0, name),
        "plan": lambda: buffer.plan(name, "a"),
        "twist frame": lambda: buffer.twist(name, "a"),
        "twist reference": lambda: buffer.twist("a", name),
        "latest": lambda: buffer.latest("a", name),
        "can_lookup": lambda: buffer.can_lookup("a", name),
        "wait": lambda: buffer.wait(name, "a", timeout_s=10.0),
        "wait_async": lambda: asyncio.run(buffer.wait_async("a", name, timeout_s=10.0)),
        "watch": lambda: buffer.watch(name, "a", print),
        "join": lambda: buffer.join(None, name),
        "insert_many parent": lambda: buffer.insert_many([(name, "q")], 0, [pose7]),
        "insert_many child": lambda: buffer.insert_many([("q", name)], 0, [pose7]),
        "withdraw": lambda: buffer.withdraw(name),
        "Transform target": lambda: Transform(name, "a", pose7[:3], pose7[3:]),
        "Transform source": lambda: Transform("a", name, pose7[:3], pose7[3:]),
        "from_pose7": lambda: Transform.from_pose7(name, "a", pose7),
        "from_matrix": lambda: Transform.from_matrix(name, "a", np.eye(4)),
        "from_rpy": lambda: Transform.from_rpy("a", name, pose7[:3], (0, 0, 0)),
    }


@pytest.mark.parametrize("name", NO_NAMES, ids=repr)
def test_invalid_frame_name_is_refused_by_every_method(name) -> None:
    buffer, track = every_joint()
    buffer.insert_static(static("a", "b"))
    frames = buffer.frames()
    for door, call in doors(buffer, track, name).items():
        with pytest.raises(InvalidInput) as caught:
            call()
        assert "frame name" in str(caught.value), door
        assert str(caught.value) == str(pickle.loads(pickle.dumps(caught.value)))
    explained = buffer.explain("a", name)
    assert isinstance(explained, InvalidInput)
    assert buffer.frames() == frames
    if not isinstance(name, str) or name:
        with pytest.raises(InvalidInput, match="prefix"):
            buffer.add_robot(track.model, name)


def test_edges_that_are_not_pairs_of_names_are_refused() -> None:
    buffer = TransformBuffer()
    for edges in (["ab", "c"], [("a",)], [("a", "b", "c")], [5], 5):
        with pytest.raises(InvalidInput):
            buffer.insert_many(edges, 0, [[0, 0, 0, 0, 0, 0, 1]])  # type: ignore[arg-type]


def test_names_are_checked_before_connections_and_connections_before_times() -> None:
    buffer = filled(moving("a", "b", 0), moving("x", "y", 0))
    for target, source, fixed, at_fault in (
        ("unknown", "y", "a", "unknown"),
        ("a", "unknown", "y", "unknown"),
        ("a", "y", "unknown", "unknown"),
        ("first", "second", "third", "first"),
        ("a", "second", "third", "second"),
    ):
        with pytest.raises(UnknownFrame) as caught:
            buffer.lookup_between(target, 99 * S, source, 99 * S, fixed)
        assert caught.value.name == at_fault
    for target, source, fixed in (("b", "y", "a"), ("y", "b", "a")):
        with pytest.raises(Disconnected):
            buffer.lookup_between(target, 99 * S, source, 99 * S, fixed)
    with pytest.raises(InFuture):
        buffer.lookup_between("b", 99 * S, "a", 0, "a")


def test_self_edge_is_refused() -> None:
    assert refusal(TransformBuffer(), "a", "a").reason == "self edge"


def test_second_parent_is_refused_with_both_writers_named() -> None:
    buffer = TransformBuffer()
    buffer.insert(moving("a", "c", 0), writer="odom")
    error = refusal(buffer, "b", "c", writer="slam")
    assert (error.reason, error.edge) == ("second parent", ("b", "c"))
    for part in ("'a' by odom", "'b' by slam", "withdraw('c')"):
        assert part in str(error)


def test_loop_is_refused_with_its_ring_and_both_writers_named() -> None:
    buffer = TransformBuffer()
    buffer.insert(moving("a", "b", 0), writer="odom")
    buffer.insert(moving("b", "c", 0))
    error = refusal(buffer, "c", "a", writer="slam")
    assert (error.reason, error.edge) == ("loop", ("c", "a"))
    for part in ("'a' -> 'b' -> 'c' -> 'a'", "by slam", "by odom"):
        assert part in str(error)


def test_frame_changes_its_parent_by_withdraw_and_insert() -> None:
    buffer = filled(moving("a", "c", 0), static("r", "a"), static("r", "b"))
    buffer.withdraw("c")
    assert isinstance(failure(buffer, "a", "c"), Disconnected)
    buffer.insert(moving("b", "c", S, x=2.0))
    assert x_of(buffer.lookup("r", "c")) == 2.0


def test_withdraw_drops_the_history_and_keeps_the_frame() -> None:
    buffer = filled(moving("a", "b", 0), moving("b", "c", 0, x=3.0))
    buffer.withdraw("b")
    assert [frame.name for frame in buffer.frames()] == ["a", "b", "c"]
    assert x_of(buffer.lookup("b", "c")) == 3.0
    assert isinstance(failure(buffer, "a", "b"), Disconnected)
    buffer.insert(moving("a", "b", S))
    assert buffer.frames()[1].oldest == S


def test_withdraw_keeps_edges_that_were_inserted_together_with_it() -> None:
    buffer = TransformBuffer()
    turn = (0, 0, 0, 1)
    buffer.insert_many([("a", "b"), ("a", "c")], 0, [(1, 0, 0, *turn), (2, 0, 0, *turn)])
    buffer.withdraw("b")
    assert x_of(buffer.lookup("a", "c", 0)) == 2.0
    buffer.insert_many([("a", "b"), ("a", "c")], S, [(3, 0, 0, *turn), (4, 0, 0, *turn)])
    assert x_of(buffer.lookup("b", "c", S)) == 1.0
    assert buffer.frames()[1].count == 1


def test_withdraw_of_an_unknown_frame_lists_near_misses() -> None:
    with pytest.raises(InvalidInput, match="did you mean 'camera'"):
        filled(static("base", "camera")).withdraw("camra")


def test_withdraw_of_a_robots_link_points_to_remove_robot() -> None:
    buffer = TransformBuffer()
    buffer.add_robot(load_model("rrbot"))
    with pytest.raises(InsertRefused, match="remove_robot"):
        buffer.withdraw("tool")


def test_clear_drops_samples_and_keeps_frames_statics_and_robots() -> None:
    buffer = filled(moving("map", "world", 0), static("tool", "screw", x=1.0))
    track = buffer.add_robot(load_model("rrbot"))
    buffer.insert_joints(track, 0, [0.0, 0.0])
    names = [frame.name for frame in buffer.frames()]
    buffer.clear()
    assert [frame.name for frame in buffer.frames()] == names
    assert x_of(buffer.lookup("tool", "screw")) == 1.0
    assert buffer.lookup("lower", "tool").translation[2] == pytest.approx(0.6)
    for target, source in (("map", "world"), ("base", "upper")):
        assert isinstance(failure(buffer, target, source), NoData)
    assert buffer.insert_joints(track, -50 * S, [0.0, 0.0])


def test_unknown_frames_come_with_near_misses() -> None:
    buffer = filled(static("base", "left_camera"), static("base", "right_wheel"))
    error = failure(buffer, "base", "left_camra", 5)
    assert isinstance(error, UnknownFrame)
    assert error.name == "left_camra"
    assert "left_camera" in error.near_misses
    assert "right_wheel" not in error.near_misses
    assert error.requested == 5
    cut_off = failure(buffer, "base", "left")
    assert isinstance(cut_off, UnknownFrame)
    assert cut_off.near_misses == ("left_camera",)  # not similar, and its beginning
    assert isinstance(failure(TransformBuffer(), "x", "x"), UnknownFrame)


def test_beginning_of_a_bare_name_that_two_robots_have_leads_to_both_frames() -> None:
    buffer = filled(*(static(f"{robot}/world", f"{robot}/base_link") for robot in ("r1", "r2")))
    for name in ("bas", "base_lnk"):
        error = failure(buffer, "r1/world", name)
        assert isinstance(error, UnknownFrame)
        assert error.near_misses == ("r1/base_link", "r2/base_link")
    buffer.insert_static(static("r1/world", "r1/camera"))
    error = failure(buffer, "r1/world", "cam")
    assert isinstance(error, UnknownFrame)
    assert error.near_misses == ("camera",)


def test_frames_in_two_trees_are_disconnected_with_both_roots() -> None:
    buffer = filled(static("a", "b"), static("b", "c"), static("x", "y"))
    error = failure(buffer, "c", "y")
    assert isinstance(error, Disconnected)
    assert error.roots == ("a", "x")


def test_disconnection_of_connected_frames_names_the_removed_edge_and_its_writer() -> None:
    buffer = filled(static("x", "y"))
    buffer.insert_static(static("a", "x"), writer="calibration")
    buffer.withdraw("x")
    error = failure(buffer, "a", "y")
    assert isinstance(error, Disconnected)
    assert (error.edge, error.writer) == (("a", "x"), "calibration")
    assert error.gone_s is not None
    assert error.gone_s >= 0.0
    assert "'a' -> 'x' (writer calibration) was withdrawn just now" in str(error)
    buffer.insert_static(static("b", "x"))
    error = failure(buffer, "a", "y")
    assert isinstance(error, Disconnected)
    assert error.gone_s is None, "its root is 'b' now, which nothing ever placed"


def test_missing_connection_is_reported_before_a_bad_time() -> None:
    buffer = filled(moving("a", "b", 0), moving("x", "y", 0))
    for stamp in (-S, S):
        assert isinstance(failure(buffer, "b", "y", stamp), Disconnected)
        with pytest.raises(Disconnected):
            buffer.lookup_between("b", stamp, "y", 0, "a")
        with pytest.raises(UnknownFrame):
            buffer.lookup_between("b", stamp, "unknown", 0, "a")


def two_robots() -> TransformBuffer:
    buffer = TransformBuffer()
    for prefix in ("r1", "r2"):
        track = buffer.add_robot(load_model("rrbot"), prefix)
        buffer.insert_joints(track, 0, [0.0, 0.0])
    return buffer


def test_bare_name_means_the_frame_of_the_only_robot() -> None:
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model("rrbot"), "r1")
    buffer.insert_joints(track, 0, [0.5, 0.0])
    bare, full = buffer.lookup("base", "tool"), buffer.lookup("r1/base", "r1/tool")
    assert (bare.target, bare.source) == ("base", "tool")
    assert bare.pose7.tolist() == full.pose7.tolist()
    buffer.insert_static(static("tool", "screw", x=1.0))
    assert "r1/tool" in {frame.parent for frame in buffer.frames()}
    assert x_of(buffer.lookup("r1/tool", "screw")) == 1.0


def test_bare_name_of_two_robots_raises_ambiguous_frame_that_lists_both() -> None:
    buffer = two_robots()
    for target, source in (("tool", "r1/base"), ("r1/base", "tool")):
        error = failure(buffer, target, source)
        assert isinstance(error, AmbiguousFrame)
        assert error.candidates == ("r1/tool", "r2/tool")
    with pytest.raises(InsertRefused, match="r1/tool, r2/tool"):
        buffer.insert_static(static("tool", "screw"))


def test_edge_between_robots_joins_them() -> None:
    buffer = two_robots()
    assert isinstance(failure(buffer, "r1/base", "r2/base"), Disconnected)
    buffer.insert_static(static("fleet/map", "r1/world", x=1.0))
    buffer.insert_static(static("fleet/map", "r2/world", x=3.0))
    assert x_of(buffer.lookup("r1/base", "r2/base")) == 2.0


def test_full_name_takes_precedence_over_a_bare_one() -> None:
    buffer = two_robots()
    buffer.insert_static(static("fleet/map", "r1/world", x=1.0))
    buffer.insert_static(static("fleet/map", "pole", x=5.0))
    assert x_of(buffer.lookup("map", "pole")) == 5.0
    assert x_of(buffer.lookup("fleet/map", "pole")) == 5.0


@pytest.mark.parametrize("edge", [("base", "upper"), ("lower", "tool")])
def test_edges_of_a_model_refuse_a_second_writer(edge: tuple[str, str]) -> None:
    buffer = TransformBuffer()
    buffer.add_robot(load_model("rrbot"))
    error = refusal(buffer, *edge, writer="intruder")
    assert error.reason == "second writer"
    assert "the model of 'rrbot'" in str(error)
    assert "intruder" in str(error)
    assert refusal(buffer, "elsewhere", edge[1]).reason == "second parent"


def test_robot_with_an_already_placed_link_is_refused_entirely() -> None:
    for edge in (("floor", "tool"), ("base", "upper")):
        buffer = filled(moving(*edge, 0))
        before = buffer.frames()
        with pytest.raises(InsertRefused):
            buffer.add_robot(load_model("rrbot"))
        assert buffer.frames() == before
        assert isinstance(failure(buffer, edge[0], "laser_link"), UnknownFrame)


def test_one_prefix_is_one_robot_until_it_is_removed() -> None:
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model("rrbot"), "r1")
    with pytest.raises(InsertRefused, match="remove_robot"):
        buffer.add_robot(load_model("gripper"), "r1")
    buffer.remove_robot(track)
    buffer.add_robot(load_model("rrbot"), "r1")
    assert buffer.lookup("r1/lower", "r1/tool").kind == "static"


def test_removed_robot_leaves_its_frames_and_its_neighbours_unchanged() -> None:
    buffer = two_robots()
    track = buffer.add_robot(load_model("diffbot"), "r3")
    names = [frame.name for frame in buffer.frames()]
    buffer.remove_robot(track)
    assert [frame.name for frame in buffer.frames()] == names
    assert all(frame.kind == "root" for frame in buffer.frames() if frame.name.startswith("r3/"))
    assert isinstance(failure(buffer, "r3/base_link", "r3/imu_link"), Disconnected)
    assert buffer.can_lookup("r1/base", "r1/tool")


def test_fixed_joints_can_be_looked_up_before_any_sample() -> None:
    buffer = TransformBuffer()
    buffer.add_robot(load_model("rrbot"))
    answer = buffer.lookup("lower", "tool", NOW)
    assert (answer.kind, answer.stamp) == ("static", NOW)
    assert isinstance(failure(buffer, "base", "tool"), NoData)


def test_frames_are_listed_in_order_of_first_mention_with_their_edges() -> None:
    buffer = TransformBuffer()
    buffer.insert_static(static("map", "odom"), writer="survey")
    for n in range(5):
        buffer.insert(moving("odom", "base", n * S), writer="wheels")
    map_, odom, base = buffer.frames()
    assert (map_.name, map_.parent, map_.kind, map_.count) == ("map", None, "root", 0)
    assert (odom.name, odom.parent, odom.kind, odom.writer) == ("odom", "map", "static", "survey")
    assert (base.kind, base.writer, base.rate_hz, base.oldest, base.newest, base.count) == (
        "pose",
        "wheels",
        1.0,
        0,
        4 * S,
        5,
    )


def test_path_frames_lead_up_to_the_common_ancestor_and_down_again():
    buffer = TransformBuffer()
    for parent, child in (("base", "torso"), ("torso", "left"), ("left", "hand"), ("torso", "right")):
        buffer.insert_static(static(f"r1/{parent}", f"r1/{child}"))
    frames = buffer.path_frames("r1/hand", "right")
    assert [(name, edge and edge.name) for name, edge in frames] == [
        ("r1/hand", None),
        ("r1/left", "r1/hand"),
        ("r1/torso", "r1/left"),
        ("r1/right", "r1/right"),
    ]
    assert buffer.path_frames("base", "base") == [("r1/base", None)]
