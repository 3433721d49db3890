"""Which instant, which kind, and which reason when there is no answer."""

from __future__ import annotations

import math
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.buffers import MS, NOW, S, every_joint, failure, filled, moving, pose_of_every, static, x_of
from helpers.processes import until

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import ManualClock
from zstate.errors import Disconnected, InFuture, InPast, InvalidInput, NoData, NotFinite, Stale, UnknownFrame
from zstate.transform import Transform


def test_lookup_returns_pose_of_source_in_target() -> None:
    buffer = filled(moving("map", "robot", NOW, x=2.0, yaw=math.pi / 2), static("robot", "lidar", x=1.0))
    map_from_lidar = buffer.lookup("map", "lidar", NOW)
    np.testing.assert_allclose(map_from_lidar.translation, (2, 1, 0), atol=1e-15)
    np.testing.assert_allclose(map_from_lidar.apply((1, 0, 0)), (2, 2, 0), atol=1e-15)
    np.testing.assert_allclose(buffer.lookup("lidar", "map", NOW).translation, (-1, 2, 0), atol=1e-15)


def test_interpolation_ratio_is_exact_to_the_nanosecond() -> None:
    # Over 4 s a nanosecond is 2.5e-10 of the way; float seconds would round it by 238 ns.
    buffer = filled(moving("a", "b", NOW), moving("a", "b", NOW + 4 * S, x=4.0))
    assert x_of(buffer.lookup("a", "b", NOW + 1)) == pytest.approx(1e-9, rel=1e-12)
    assert x_of(buffer.lookup("a", "b", NOW + 3)) == pytest.approx(3e-9, rel=1e-12)


def test_pose_edges_rotate_the_short_way_at_a_constant_rate() -> None:
    buffer = filled(moving("a", "b", 0, x=1.0, yaw=3.0), moving("a", "b", 4 * S, x=3.0, yaw=-3.0))
    answer = buffer.lookup("a", "b", S)
    short_way = 2 * math.pi - 6.0
    assert answer.rpy[2] == pytest.approx(3.0 + 0.25 * short_way)
    assert x_of(answer) == 1.5


def test_latest_is_the_newest_instant_that_every_moving_edge_has() -> None:
    buffer = filled(
        moving("a", "b", 0), moving("a", "b", 4 * S, x=4.0), moving("b", "c", 0), moving("b", "c", S, x=10.0),
        static("c", "d"),
    )  # fmt: skip
    answer = buffer.lookup("a", "d")
    assert (answer.stamp, answer.kind) == (S, "interpolated")
    assert x_of(answer) == 11.0
    assert buffer.latest("a", "d") == S
    assert buffer.latest("d", "a") == S


def test_stale_edge_above_the_common_ancestor_does_not_block_lookups_below() -> None:
    buffer = filled(
        moving("map", "odom", 0), moving("odom", "base", 50 * S), moving("odom", "hand", 50 * S, x=1.0)
    )
    assert x_of(buffer.lookup("base", "hand")) == 1.0
    assert buffer.latest("base", "hand") == 50 * S


def test_transform_kind_states_how_it_was_computed() -> None:
    buffer = filled(moving("a", "b", 0), moving("a", "b", 2 * S), static("b", "c"))
    assert buffer.lookup("b", "c", S).kind == "static"
    assert buffer.lookup("a", "c", 0).kind == "exact"
    assert buffer.lookup("a", "c", S).kind == "interpolated"
    assert buffer.lookup("a", "c", 3 * S, predict_s=1.0).kind == "predicted"


def test_kind_interpolated_outranks_exact_and_predicted_outranks_both() -> None:
    buffer = filled(
        *(moving("a", "b", n * 2 * S) for n in range(2)), *(moving("b", "c", n * S) for n in range(4))
    )
    assert buffer.lookup("a", "c", S).kind == "interpolated"
    assert buffer.lookup("a", "c", 2 * S).kind == "exact"
    answer = buffer.lookup("a", "c", 2 * S + S // 2, predict_s=1.0)
    assert (answer.kind, answer.predicted_s) == ("predicted", 0.5)
    assert buffer.lookup("c", "a", 3 * S, predict_s=1.0).kind == "predicted"


def test_static_paths_are_valid_at_any_time_and_have_no_newest_instant() -> None:
    buffer = filled(static("a", "b"), static("b", "c"))
    assert buffer.lookup("a", "c").stamp is None
    for stamp in (0, -5, NOW):
        answer = buffer.lookup("a", "c", stamp)
        assert (answer.stamp, answer.kind) == (stamp, "static")
    with pytest.raises(NoData, match="every edge of the path is static"):
        buffer.latest("a", "c")


def test_known_frame_in_itself_is_the_identity_at_any_time() -> None:
    buffer = filled(moving("a", "b", 0))
    for frame in "ab":
        for stamp in (None, -NOW, NOW):
            answer = buffer.lookup(frame, frame, stamp)
            assert (answer.stamp, answer.kind) == (stamp, "static")
            np.testing.assert_array_equal(answer.matrix, np.eye(4))
    assert isinstance(failure(buffer, "x", "x", 0), UnknownFrame)


def test_lookup_after_newest_sample_raises_in_future_with_all_facts() -> None:
    buffer = TransformBuffer()
    for n in range(5):
        buffer.insert(moving("a", "b", n * S), writer="odom")
    buffer.insert_static(static("b", "c"))
    error = failure(buffer, "c", "a", 4 * S + 1)
    assert type(error) is InFuture
    facts = (error.edge, error.requested, error.oldest, error.newest, error.rate_hz, error.writer)
    assert facts == (("a", "b"), 4 * S + 1, 0, 4 * S, 1.0, "odom")
    assert (error.target, error.source) == ("c", "a")


def test_lookup_before_oldest_sample_raises_in_past_with_all_facts() -> None:
    buffer = filled(*(moving("a", "b", n * S) for n in range(5)))
    error = failure(buffer, "a", "b", -1)
    assert type(error) is InPast
    assert (error.edge, error.requested, error.oldest, error.newest) == (("a", "b"), -1, 0, 4 * S)


def test_single_sample_raises_in_future_or_in_past_at_other_stamps() -> None:
    buffer = filled(moving("a", "b", S))
    assert type(failure(buffer, "a", "b", S + 1)) is InFuture
    assert type(failure(buffer, "a", "b", S - 1)) is InPast
    assert failure(buffer, "a", "b", S - 1).rate_hz is None


def test_in_future_names_the_edge_with_the_oldest_end_and_in_past_the_one_with_the_latest_start() -> None:
    spans = {("a", "b"): (2, 9), ("b", "c"): (4, 8), ("c", "d"): (3, 7)}
    buffer = filled(*(moving(*edge, n * S) for edge, span in spans.items() for n in span))
    for target, source in (("a", "d"), ("d", "a")):
        future, past = failure(buffer, target, source, 10 * S), failure(buffer, target, source, S)
        assert (type(future), future.edge) == (InFuture, ("c", "d"))
        assert (type(past), past.edge) == (InPast, ("b", "c"))


def test_in_past_takes_precedence_over_in_future() -> None:
    buffer = filled(moving("a", "b", 0), moving("b", "c", 20 * S))
    error = failure(buffer, "a", "c", 10 * S)
    assert (type(error), error.edge) == (InPast, ("b", "c"))


def silent() -> TransformBuffer:
    """odom -> base stopped after 1 s; base -> arm goes on until 40 s."""
    buffer = TransformBuffer()
    for tick in range(11):
        buffer.insert(moving("odom", "base", tick * S // 10), writer="odometry")
    for tick in range(410):
        buffer.insert(moving("base", "arm", tick * S // 10), writer="driver")
    return buffer


@pytest.mark.parametrize(("target", "source"), [("odom", "arm"), ("arm", "odom")])
def test_edge_silent_for_longer_than_the_history_is_named(target, source) -> None:
    buffer = silent()
    calls = (
        lambda: buffer.lookup(target, source),
        lambda: buffer.lookup(target, source, timeout_s=0.01),
        lambda: buffer.lookup(target, source, max_age_s=1.0),
        lambda: buffer.lookup_between(target, None, source, None, "odom"),
        lambda: buffer.twist(target, source),
        lambda: buffer.plan(target, source).at(),
        lambda: buffer.wait(target, source, timeout_s=0.01),
        lambda: buffer.latest(target, source),
    )
    for call in calls:
        with pytest.raises(Stale) as caught:
            call()
        reason = caught.value
        assert (reason.edge, reason.writer, reason.newest) == (("odom", "base"), "odometry", S)
        assert (reason.other, reason.other_newest) == (("base", "arm"), 40 * S + 9 * S // 10)
        assert reason.age_s == pytest.approx(39.9)
        text = str(reason)
        assert "'odom' -> 'base' (writer odometry, 10 Hz) has been silent since 1.000 s" in text
        assert "39.9 s older than that of 'base' -> 'arm'" in text
        assert str(pickle.loads(pickle.dumps(reason))) == text
    assert type(failure(buffer, target, source)) is Stale


def test_last_sample_of_an_edge_is_used_while_other_edges_cover_it() -> None:
    buffer = filled(moving("a", "b", 0), *(moving("b", "c", n * S) for n in range(11)))
    assert buffer.lookup("a", "c").stamp == buffer.latest("a", "c") == 0


def test_edges_without_a_common_instant_raise_with_that_reason() -> None:
    buffer = filled(moving("a", "b", NOW // 1_000_000), moving("b", "c", NOW))
    reason = failure(buffer, "a", "c")
    assert (type(reason), reason.edge) == (Stale, ("a", "b"))
    assert "the writer's stamps look like milliseconds, but stamps are nanoseconds" in str(reason)


def test_wait_for_a_silent_edge_ends_with_its_next_sample() -> None:
    buffer = silent()
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(buffer.wait, "odom", "arm", timeout_s=20.0)
        until(lambda: len(buffer._waiters))
        buffer.insert(moving("odom", "base", 40 * S, x=4.0))
        assert x_of(answer.result(20.0)) == 4.0


def test_no_data_names_the_edge_without_a_sample() -> None:
    buffer, track = every_joint()
    buffer.insert(moving("map", "root", 0))
    for stamp in (None, 0, S):
        error = failure(buffer, "map", "wheel", stamp)
        assert (type(error), error.edge, error.newest) == (NoData, ("root", "body"), None)
    assert track.history.view.size == 0


def test_explain_returns_the_reason_and_never_raises_it() -> None:
    buffer = filled(moving("a", "b", 0), static("x", "y"))
    assert buffer.explain("a", "b") is None
    for target, source, stamp, reason in (
        ("a", "b", 1, InFuture),
        ("a", "b", -1, InPast),
        ("a", "y", 0, Disconnected),
        ("a", "q", 0, UnknownFrame),
        ("", "/q", None, InvalidInput),
        (None, ["q"], None, InvalidInput),
        ("a", "b", 1.5, InvalidInput),
    ):
        assert type(buffer.explain(target, source, stamp)) is reason


def test_lookup_between_two_instants_goes_through_the_fixed_frame() -> None:
    buffer = filled(
        *(moving("map", "robot", n * S, x=10.0 * n) for n in range(3)),
        *(moving("map", "ball", n * S, x=100.0 * n) for n in range(3)),
    )
    # The ball of 2 s ago (x = 200) seen from where the robot was at 0.5 s (x = 5).
    answer = buffer.lookup_between("robot", S // 2, "ball", 2 * S, "map")
    assert x_of(answer) == 195.0
    assert (answer.target, answer.source, answer.stamp, answer.kind) == (
        "robot",
        "ball",
        S // 2,
        "interpolated",
    )


def test_lookup_between_uses_the_newest_instant_of_each_side_and_the_target_stamp() -> None:
    buffer = filled(
        moving("map", "robot", S, x=1.0), moving("map", "ball", 2 * S, x=7.0), static("map", "post", x=3.0)
    )
    both = buffer.lookup_between("robot", None, "ball", None, "map")
    assert (x_of(both), both.stamp, both.kind) == (6.0, S, "exact")
    static_side = buffer.lookup_between("post", None, "ball", None, "map")
    assert (x_of(static_side), static_side.stamp) == (4.0, None)
    assert buffer.lookup_between("post", 5, "ball", None, "map").stamp == 5
    with pytest.raises(InFuture):
        buffer.lookup_between("robot", S + 1, "ball", None, "map")


def test_transform_older_than_allowed_is_stale_by_the_clock_of_the_buffer() -> None:
    clock = ManualClock(10 * S)
    buffer = TransformBuffer(clock=clock)
    buffer.insert(moving("a", "b", 9 * S))
    buffer.insert(moving("b", "c", 8 * S))
    buffer.insert(moving("b", "c", 10 * S))
    assert buffer.lookup("a", "c", max_age_s=1.0).stamp == 9 * S
    clock.advance(0.5)
    error = failure(buffer, "a", "c", max_age_s=1.0)
    assert isinstance(error, Stale)
    assert (error.age_s, error.max_age_s, error.edge, error.newest) == (1.5, 1.0, ("a", "b"), 9 * S)
    assert buffer.lookup("a", "c").stamp == 9 * S


def test_static_paths_are_never_stale() -> None:
    buffer = TransformBuffer(clock=ManualClock(NOW))
    buffer.insert_static(static("a", "b"))
    assert buffer.lookup("a", "b", 0, max_age_s=0.0).kind == "static"
    assert buffer.lookup("a", "b", max_age_s=0.0).stamp is None


@pytest.mark.parametrize("option", ["timeout_s", "max_age_s", "predict_s"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_options_are_finite_numbers_of_seconds(option: str, value: float) -> None:
    with pytest.raises(InvalidInput, match=option):
        filled(static("a", "b")).lookup("a", "b", **{option: value})


def test_lookup_many_returns_nan_where_there_is_no_transform() -> None:
    buffer = filled(*(moving("a", "b", n * S, x=n) for n in range(3)), moving("b", "c", S, x=5.0))
    poses, valid = buffer.lookup_many("a", "b", [-1, 0, S // 2, 2 * S, 2 * S + 1])
    assert valid.tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(poses[1:4, 0], (0, 0.5, 2))
    assert np.isnan(poses[~valid]).all()
    assert buffer.lookup_many("a", "c", [0, S, 2 * S])[1].tolist() == [False, True, False]
    with pytest.raises(UnknownFrame):
        buffer.lookup_many("a", "q", [0])
    with pytest.raises(Disconnected):
        filled(static("a", "b"), static("x", "y")).lookup_many("a", "x", [0])


def test_lookup_many_handles_paths_without_moving_edges_or_samples() -> None:
    buffer, track = every_joint()
    poses, valid = buffer.lookup_many("sled", "tip", [0, NOW])
    assert valid.all()
    np.testing.assert_allclose(poses[:, 0], 0.5)
    assert buffer.lookup_many("sled", "sled", [0])[0].tolist() == [[0, 0, 0, 0, 0, 0, 1]]
    assert not buffer.lookup_many("root", "tip", [0])[1].any()
    buffer.insert_joints(track, 0, pose_of_every(track))
    assert buffer.lookup_many("root", "tip", [])[0].shape == (0, 7)


def test_plan_follows_the_tree_and_raises_at_the_first_instant_without_a_transform() -> None:
    buffer = filled(*(moving("a", "b", n * S, x=n) for n in range(3)))
    plan = buffer.plan("a", "b")
    np.testing.assert_allclose(plan.poses([0, S])[:, 0], (0, 1))
    with pytest.raises(InPast) as caught:
        plan.poses([0, -5, 9 * S])
    assert caught.value.requested == -5
    buffer.insert_static(static("a", "b", x=7.0))
    assert x_of(plan.at(NOW)) == 7.0
    buffer.withdraw("b")
    with pytest.raises(Disconnected):
        plan.at()
    with pytest.raises(UnknownFrame):
        buffer.plan("a", "q")


def test_plan_writes_into_out_or_leaves_it_unchanged() -> None:
    plan = filled(*(moving("a", "b", n * S, x=n) for n in range(3))).plan("a", "b")
    out = np.full((2, 7), 9.0)
    with pytest.raises(InFuture):
        plan.poses([0, 3 * S], out=out)
    assert (out == 9.0).all()
    assert plan.poses([0, 2 * S], out=out) is out
    np.testing.assert_allclose(out[:, 0], (0, 2))
    for wrong in (np.zeros((3, 7)), np.zeros((2, 7), dtype=np.float32)):
        with pytest.raises(InvalidInput, match="out must be"):
            plan.poses([0, S], out=wrong)


@pytest.mark.parametrize("stamps", [[0.5], [[0]], 5, ["0"], [True], [2**63]])
def test_stamps_are_a_flat_array_of_integers(stamps) -> None:
    buffer = filled(moving("a", "b", 0))
    with pytest.raises(InvalidInput, match="stamps"):
        buffer.lookup_many("a", "b", stamps)
    with pytest.raises(InvalidInput, match="stamps"):
        buffer.plan("a", "b").poses(stamps)


def test_prediction_happens_only_on_request_and_never_in_a_plan() -> None:
    buffer = filled(moving("a", "b", 0), moving("a", "b", S, x=1.0))
    assert isinstance(failure(buffer, "a", "b", S + MS), InFuture)
    with pytest.raises(InFuture):
        buffer.plan("a", "b").at(S + MS)
    assert not buffer.lookup_many("a", "b", [S + MS])[1].any()


HUGE = 1.7e308


def huge_static() -> TransformBuffer:
    return filled(static("a", "b", x=HUGE), static("b", "c", x=HUGE), static("c", "d", x=-HUGE))


def huge_moving() -> TransformBuffer:
    return filled(*(moving(*edge, n * S, x=HUGE) for n in range(3) for edge in (("a", "b"), ("b", "c"))))


@pytest.mark.parametrize("buffer", [huge_static(), huge_moving()], ids=["static", "moving"])
def test_non_finite_result_raises_not_finite(buffer: TransformBuffer) -> None:
    calls = (
        lambda: buffer.lookup("a", "c", S),
        lambda: buffer.lookup("c", "a", S),
        lambda: buffer.lookup("a", "c"),
        lambda: buffer.lookup("a", "c", S, timeout_s=20.0),
        lambda: buffer.lookup("a", "c", S // 3),
        lambda: buffer.plan("a", "c").at(S),
        lambda: buffer.plan("a", "c").poses([0, S]),
        lambda: buffer.wait("a", "c", S, timeout_s=20.0),
        lambda: buffer.lookup_between("a", S, "c", 0, "b"),
    )
    for call in calls:
        with pytest.raises(NotFinite) as caught:
            call()
        assert "too large" in str(caught.value)
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    assert type(buffer.explain("a", "c", S)) is NotFinite
    assert not buffer.can_lookup("a", "c", S)
    poses, valid = buffer.lookup_many("a", "c", [0, S, S // 2])
    assert np.isnan(poses).all()
    assert not valid.any()
    assert x_of(buffer.lookup("a", "b", S)) == HUGE


def test_finite_numbers_whose_sum_overflows_give_a_transform() -> None:
    buffer = filled(*(Transform("a", "b", (HUGE, HUGE, -HUGE), (0, 0, 0, 1), n * S) for n in range(2)))
    assert buffer.lookup("a", "b", S // 2).translation.tolist() == [HUGE, HUGE, -HUGE]
    poses, valid = buffer.lookup_many("a", "b", [0, S // 2])
    assert valid.all()
    assert poses[1, :3].tolist() == [HUGE, HUGE, -HUGE]


def test_wait_for_a_finite_result_ends_with_a_newer_sample() -> None:
    buffer = huge_moving()
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(buffer.wait, "a", "c", timeout_s=20.0)
        until(lambda: len(buffer._waiters))
        for edge in (("a", "b"), ("b", "c")):
            buffer.insert(moving(*edge, 3 * S, x=1.0))
        assert x_of(answer.result(20.0)) == 2.0


def test_joints_between_huge_positions_raise_not_finite_and_no_python_error() -> None:
    buffer, track = every_joint()
    for stamp, sign in ((0, 1.0), (S, -1.0)):
        buffer.insert_joints(track, stamp, pose_of_every(track, bend=sign * HUGE, lift=sign * HUGE))
    for call in (
        lambda: buffer.lookup("body", "arm", S // 2),
        lambda: buffer.lookup("body", "follower", 0),
        lambda: buffer.lookup("body", "lift", S // 2),
        lambda: buffer.twist("follower", "body", S // 2),
        lambda: buffer.twist("lift", "body", S // 2),
        lambda: buffer.joint_positions(track.name, S // 2),
        lambda: buffer.link_poses(track.name, S // 2),
    ):
        with pytest.raises(NotFinite) as caught:
            call()
        assert caught.value.edge is not None
    with pytest.raises(NotFinite, match="pose of 'follower' in 'root'"):
        buffer.link_poses(track.name, 0)
    assert not buffer.lookup_many("body", "follower", [0, S // 2, S])[1].any()


@pytest.mark.parametrize("seconds", [1e300, 1e10 * 3, math.inf, math.nan, -1.0, "1", None, 1j, 10**400])
def test_invalid_duration_is_refused(seconds) -> None:
    buffer = filled(moving("a", "b", 0), moving("a", "b", S, x=1.0))
    with pytest.raises(InvalidInput, match="predict_s"):
        buffer.lookup("a", "b", 2 * S, predict_s=seconds)


def test_prediction_that_overflows_is_not_finite() -> None:
    buffer = filled(moving("a", "b", 0, x=-1e308), moving("a", "b", S, x=1.0))
    with pytest.raises(NotFinite):
        buffer.lookup("a", "b", 2**62, predict_s=1e10)
    assert x_of(buffer.lookup("a", "b", 2 * S, predict_s=1e10)) == pytest.approx(1e308)
