"""What a buffer takes in, what it refuses, and in which order samples may come."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from helpers.buffers import (
    EVERY_JOINT,
    MS,
    NOW,
    S,
    every_joint,
    failure,
    filled,
    moving,
    pose_of_every,
    static,
    x_of,
)

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.errors import InFuture, InPast, InsertRefused, InvalidInput, NoData, UnknownFrame
from zstate.model.load import load_model
from zstate.transform import Transform

TURN = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
def test_samples_may_arrive_in_any_order(order) -> None:
    buffer = TransformBuffer()
    for n in order:
        assert buffer.insert(moving("a", "b", NOW + n * S, x=n * n))
    for n in range(4):
        assert x_of(buffer.lookup("a", "b", NOW + n * S)) == n * n
    assert x_of(buffer.lookup("a", "b", NOW + 2 * S + S // 2)) == 0.5 * (4 + 9)


def test_later_of_two_samples_of_one_stamp_wins_at_any_position() -> None:
    for n in range(3):
        buffer = filled(*(moving("a", "b", k * S, x=k) for k in range(3)))
        assert buffer.insert(moving("a", "b", n * S, x=9.0))
        assert x_of(buffer.lookup("a", "b", n * S)) == 9.0
        assert buffer.frames()[1].count == 3


def test_sample_exactly_as_old_as_the_history_stays_and_an_older_one_is_dropped() -> None:
    buffer = filled(moving("a", "b", NOW - 1), moving("a", "b", NOW, x=1.0), moving("a", "b", NOW + 10 * S))
    assert x_of(buffer.lookup("a", "b", NOW)) == 1.0
    assert isinstance(failure(buffer, "a", "b", NOW - 1), InPast)
    assert buffer.frames()[1].oldest == NOW


def test_late_sample_beyond_the_history_is_ignored_and_counted() -> None:
    buffer = filled(moving("a", "b", 10 * S))
    assert buffer.insert(moving("a", "b", 0, x=1.0))
    assert buffer.ignored == 0
    assert not buffer.insert(moving("a", "b", -1))
    assert buffer.ignored == 1
    assert buffer.frames()[1].oldest == 0


def test_ignored_sample_of_a_robot_is_counted_too() -> None:
    buffer, track = every_joint()
    assert buffer.insert_joints(track, 11 * S, pose_of_every(track))
    assert not buffer.insert_joints(track, S - 1, pose_of_every(track))
    assert buffer.ignored == 1


def test_ignored_sample_changes_none_of_its_edges() -> None:
    buffer = filled(moving("a", "b", 100 * S), static("a", "c", x=3.0))
    before = buffer.frames()
    poses = np.array([(0, 0, 0, *TURN)] * 3)
    assert not buffer.insert_many([("a", "b"), ("a", "c"), ("a", "d")], 0, poses)
    assert buffer.frames() == before
    assert x_of(buffer.lookup("a", "c")) == 3.0


def test_forward_jump_drops_all_earlier_samples() -> None:
    buffer = filled(moving("a", "b", 106 * S), moving("a", "b", 300 * S))
    error = failure(buffer, "a", "b", 200 * S)
    assert isinstance(error, InPast)
    assert error.oldest == 300 * S


def test_each_track_keeps_its_own_history() -> None:
    buffer = filled(moving("a", "b", 0, x=1.0), moving("a", "c", 100 * S))
    assert x_of(buffer.lookup("a", "b", 0)) == 1.0


def test_restart_clears_one_track_and_no_other() -> None:
    buffer, track = every_joint()
    buffer.insert_joints(track, 100 * S, pose_of_every(track, bend=1.0))
    buffer.insert(moving("map", "root", 100 * S, x=1.0))
    feed_of(buffer).restart(track)
    assert isinstance(failure(buffer, "body", "arm"), NoData)
    assert x_of(buffer.lookup("map", "root", 100 * S)) == 1.0
    assert buffer.insert_joints(track, S, pose_of_every(track))
    assert buffer.latest("body", "arm") == S


@pytest.mark.parametrize("stamp", [0, -5, -(2**63), 2**63 - 1])
def test_no_stamp_has_a_special_meaning(stamp: int) -> None:
    buffer = filled(moving("a", "b", stamp, x=2.0))
    answer = buffer.lookup("a", "b", stamp)
    assert (answer.stamp, answer.kind, x_of(answer)) == (stamp, "exact", 2.0)
    assert buffer.latest("a", "b") == stamp
    other = stamp + 1 if stamp < 0 else stamp - 1
    assert isinstance(failure(buffer, "a", "b", other), InFuture if stamp < 0 else InPast)


def test_full_range_of_stamps_does_not_overflow() -> None:
    buffer = filled(moving("a", "b", -(2**63)), moving("a", "b", 2**63 - 1, x=1.0))
    assert buffer.frames()[1].count == 1
    assert not buffer.insert(moving("a", "b", -(2**63)))
    assert buffer.lookup_many("a", "b", [-(2**63), 2**63 - 1])[1].tolist() == [False, True]


@pytest.mark.parametrize("stamp", [1.5, np.float64(1e9), "1", True])
def test_non_integer_stamp_is_refused_by_every_call(stamp) -> None:
    buffer, track = every_joint()
    calls = (
        lambda: buffer.insert_joints(track, stamp, pose_of_every(track)),
        lambda: buffer.insert_many([("a", "b")], stamp, [(0, 0, 0, *TURN)]),
        lambda: buffer.lookup("root", "body", stamp),
        lambda: buffer.lookup_many("root", "body", [stamp]),
        lambda: buffer.lookup_between("root", stamp, "body", 0, "root"),
        lambda: buffer.plan("root", "body").at(stamp),
        lambda: buffer.twist("root", "body", stamp),
        lambda: buffer.wait("root", "body", stamp),
    )
    for call in calls:
        with pytest.raises(InvalidInput, match="integer"):
            call()


def test_moving_edge_needs_a_stamp() -> None:
    with pytest.raises(InsertRefused, match="insert_static") as caught:
        TransformBuffer().insert(static("a", "b"))
    assert (caught.value.reason, caught.value.edge) == ("no stamp", ("a", "b"))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", range(7))
def test_insert_many_refuses_nan_and_infinity_naming_the_edge(place: int, value: float) -> None:
    poses = np.array([(0, 0, 0, *TURN)] * 2)
    poses[1, place] = value
    buffer = TransformBuffer()
    with pytest.raises(InsertRefused, match="'a' -> 'c'") as caught:
        buffer.insert_many([("a", "b"), ("a", "c")], 0, poses)
    assert (caught.value.reason, caught.value.edge) == ("not a pose", ("a", "c"))
    assert buffer.frames() == ()


@pytest.mark.parametrize("norm", [0.0, 0.9989, 1.0011, -0.5])
def test_insert_many_refuses_a_quaternion_far_from_unit_length(norm: float) -> None:
    with pytest.raises(InsertRefused, match="length 1"):
        TransformBuffer().insert_many([("a", "b")], 0, [(0, 0, 0, 0, 0, 0, norm)])


def test_quaternion_within_a_thousandth_is_normalised() -> None:
    buffer = TransformBuffer()
    buffer.insert_many([("a", "b")], 0, [(0, 0, 0, 0, 0.6 * 1.0009, 0, 0.8 * 1.0009)])
    np.testing.assert_allclose(buffer.lookup("a", "b").rotation, (0, 0.6, 0, 0.8), atol=1e-15)


@pytest.mark.parametrize("poses", [[], [(0, 0, 0, *TURN)], [(0, 0, 0)] * 2, 1.0])
def test_insert_many_needs_one_row_for_each_edge(poses) -> None:
    with pytest.raises(InvalidInput, match=r"\(2, 7\)"):
        TransformBuffer().insert_many([("a", "b"), ("a", "c")], 0, poses)


def test_insert_many_is_all_or_nothing() -> None:
    buffer = filled(moving("a", "b", 0, x=1.0))
    before = buffer.frames()
    poses = [(5, 0, 0, *TURN)] * 2
    for refused in (
        [("a", "b"), ("x", "x")],
        [("a", "b"), ("b", "a")],
        [("a", "c"), ("x", "c")],
        [("a", "c")] * 2,
    ):
        with pytest.raises(InsertRefused):
            buffer.insert_many(refused, S, poses)
    assert buffer.frames() == before
    assert x_of(buffer.lookup("a", "b")) == 1.0


def test_edges_of_one_call_are_checked_against_each_other_for_loops() -> None:
    buffer = TransformBuffer()
    with pytest.raises(InsertRefused, match="loop"):
        buffer.insert_many([("a", "b"), ("b", "c"), ("c", "a")], 0, [(0, 0, 0, *TURN)] * 3)
    assert isinstance(failure(buffer, "a", "b"), UnknownFrame)


def test_edge_has_one_history_whichever_insert_writes_it() -> None:
    buffer = TransformBuffer()
    both = [("a", "b"), ("b", "c")]
    buffer.insert_many(both, 0, [(0, 0, 0, *TURN), (100, 0, 0, *TURN)])
    buffer.insert(moving("a", "b", 2 * S, x=2.0))
    assert x_of(buffer.lookup("a", "b", S)) == 1.0
    assert buffer.latest("b", "c") == 0
    buffer.insert_many(both, 4 * S, [(8, 0, 0, *TURN), (104, 0, 0, *TURN)])
    assert x_of(buffer.lookup("a", "b", 3 * S)) == 5.0
    assert x_of(buffer.lookup("b", "c", S)) == 101.0
    buffer.insert_many(both[::-1], 5 * S, [(200, 0, 0, *TURN), (9, 0, 0, *TURN)])
    assert x_of(buffer.lookup("a", "b")) == 9.0
    assert x_of(buffer.lookup("b", "c")) == 200.0


def test_same_edges_in_another_order_are_the_same_edges() -> None:
    buffer = TransformBuffer()
    buffer.insert_many([("a", "b"), ("a", "c")], 0, [(1, 0, 0, *TURN), (2, 0, 0, *TURN)])
    buffer.insert_many([("a", "c"), ("a", "b")], S, [(4, 0, 0, *TURN), (3, 0, 0, *TURN)])
    assert x_of(buffer.lookup("a", "b", S // 2)) == 2.0
    assert x_of(buffer.lookup("a", "c", S // 2)) == 3.0


def test_static_edge_that_replaces_a_moving_one_drops_its_history() -> None:
    buffer = filled(moving("a", "b", 0), moving("a", "b", S, x=1.0), static("a", "b", x=7.0))
    assert x_of(buffer.lookup("a", "b", 0)) == 7.0
    assert buffer.lookup("a", "b", 0).kind == "static"
    buffer.insert(moving("a", "b", 2 * S, x=2.0))
    assert isinstance(failure(buffer, "a", "b", S), InPast)
    assert x_of(buffer.lookup("a", "b")) == 2.0


def test_static_edge_keeps_edges_that_were_inserted_together_with_it() -> None:
    buffer = TransformBuffer()
    buffer.insert_many([("a", "b"), ("a", "c")], 0, [(1, 0, 0, *TURN), (2, 0, 0, *TURN)])
    buffer.insert_static(static("a", "b", x=7.0))
    assert x_of(buffer.lookup("a", "c", 0)) == 2.0
    buffer.insert_many([("a", "b"), ("a", "c")], S, [(3, 0, 0, *TURN), (4, 0, 0, *TURN)])
    assert x_of(buffer.lookup("a", "c", S // 2)) == 3.0
    assert isinstance(failure(buffer, "a", "b", 0), InPast)


def test_static_edge_is_replaced_by_a_later_one_regardless_of_stamps() -> None:
    buffer = filled(static("a", "b", x=1.0))
    buffer.insert_static(moving("a", "b", -5, x=2.0))
    assert x_of(buffer.lookup("a", "b", NOW)) == 2.0


def test_history_s_must_be_a_positive_number() -> None:
    for history_s in (0.0, -1.0, math.nan, math.inf, "10", None, 1j):
        with pytest.raises(InvalidInput, match="history_s"):
            TransformBuffer(history_s)


def test_reused_array_of_the_caller_changes_no_history() -> None:
    buffer, track = every_joint()
    positions, poses = pose_of_every(track, bend=0.5), np.array([(1.0, 0, 0, *TURN)])
    buffer.insert_joints(track, 0, positions)
    buffer.insert_many([("m", "root")], 0, poses)
    positions[:], poses[:] = 9.0, 9.0
    assert buffer.lookup("body", "arm").rpy[2] == pytest.approx(0.5)
    assert x_of(buffer.lookup("m", "root")) == 1.0


def test_edge_names_its_last_writer() -> None:
    buffer = TransformBuffer()
    for n, writer in enumerate(("first", "second", None)):
        buffer.insert(moving("a", "b", n), writer=writer)
    assert buffer.frames()[1].writer == "second"


def test_robot_without_moving_joints_needs_no_sample() -> None:
    text = EVERY_JOINT.split("<joint name=")[0].split("<link")[0] + '<link name="only"/></robot>'
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model(text))
    assert buffer.insert_joints(track, 5 * MS, [])
    np.testing.assert_array_equal(buffer.lookup("only", "only").matrix, np.eye(4))


def test_quaternion_at_exactly_half_a_turn_is_used_as_given() -> None:
    for sign in (1.0, -1.0):
        end = Transform("a", "b", (0, 0, 0), (0, 0, sign, 0), S)
        buffer = filled(moving("a", "b", 0), end)
        yaw = buffer.lookup("a", "b", S // 2).rpy[2]
        assert yaw == pytest.approx(sign * math.pi / 2)


def test_frames_of_selected_names_lists_only_those():
    buffer = TransformBuffer()
    for child in ("a", "b", "c"):
        buffer.insert_static(Transform.from_pose7("world", child, (0, 0, 0, 0, 0, 0, 1)))
    assert [frame.name for frame in buffer.frames(among=("c", "nowhere", "a"))] == ["c", "a"]
    assert [frame.name for frame in buffer.frames()] == ["world", "a", "b", "c"]
