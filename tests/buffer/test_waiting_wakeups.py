"""Work that is avoided: a sample or a tree change costs only the waiters that it concerns.

Work is counted by calls of the functions that do it, as the interpreter sees them.
"""

from __future__ import annotations

import difflib
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import pytest
from helpers.buffers import MS, S, every_joint, failure, filled, moving, pose_of_every, static, x_of

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.buffer.frame_tree import FrameTree
from zstate.buffer.path import compile_path
from zstate.buffer.tracks import JointTrack
from zstate.buffer.waiting import WakeCondition
from zstate.errors import InsertRefused, UnknownFrame
from zstate.extension import kernel
from zstate.model.load import load_model
from zstate.transform import Transform

if kernel == "c":
    from zstate._kernel import NewerTransforms

    is_met = NewerTransforms.is_met
else:
    is_met = WakeCondition.is_met

RRBOT = load_model("rrbot")
ZERO = [0.0, 0.0]


@contextmanager
def calls(function: Callable[..., object]) -> Iterator[list[str]]:
    """The callers of ``function`` in this thread during the context."""
    callers: list[str] = []

    def on_call(frame: FrameType, event: str, called: object) -> None:
        if event == "call" and frame.f_code is getattr(function, "__code__", None):
            callers.append(frame.f_back.f_code.co_name if frame.f_back else "")
        elif event == "c_call" and getattr(called, "__qualname__", "") == function.__qualname__:
            callers.append(frame.f_code.co_name)

    sys.setprofile(on_call)
    try:
        yield callers
    finally:
        sys.setprofile(None)


class Seen(list[Transform]):
    """The stamps that a watch reported."""

    def stamps(self) -> list[int | None]:
        return [transform.stamp for transform in self]


def watched(buffer: TransformBuffer, target: str, source: str) -> Seen:
    seen = Seen()
    buffer.watch(target, source, seen.append)
    return seen


def fleet(buffer: TransformBuffer, count: int) -> list[JointTrack]:
    """Robots called r0, r1, ..., with a sample each at stamp 0."""
    tracks = [buffer.add_robot(RRBOT, f"r{number}") for number in range(count)]
    for track in tracks:
        buffer.insert_joints(track, 0, ZERO)
    return tracks


def test_sample_is_checked_only_by_waiters_of_its_track() -> None:
    buffer = TransformBuffer()
    one, other = fleet(buffer, 2)
    for _ in range(30):
        watched(buffer, "r1/base", "r1/tool")
    with calls(is_met) as asked:
        buffer.insert_joints(one, S, ZERO)
    assert asked == []
    with calls(is_met) as asked:
        buffer.insert_joints(other, S, ZERO)
    assert asked.count("notify") == 30  # before each is woken


def test_waiter_for_two_tracks_checks_samples_of_both() -> None:
    buffer = filled(moving("a", "b", 0), moving("b", "c", 0))
    seen = watched(buffer, "a", "c")
    buffer.insert(moving("a", "b", S))
    buffer.insert(moving("b", "c", S))
    buffer.insert(moving("b", "c", 2 * S))
    buffer.insert(moving("a", "b", 2 * S))
    assert seen.stamps() == [0, S, 2 * S]


def test_sample_of_many_tracks_is_checked_by_each_waiter_once() -> None:
    buffer = filled(moving("a", "b", 0), moving("b", "c", 0))
    watched(buffer, "a", "c")
    with calls(is_met) as asked:
        buffer.insert_many([("a", "b"), ("b", "c")], S, [(0, 0, 0, 0, 0, 0, 1)] * 2)
    assert asked.count("notify") == 1


def test_new_robot_wakes_no_waiter_of_another() -> None:
    buffer = TransformBuffer()
    fleet(buffer, 2)
    watched(buffer, "r0/base", "r0/tool")
    watched(buffer, "r9/base", "r9/tool")
    watched(buffer, "r0/base", "r1/base")
    with calls(compile_path) as compiled, calls(difflib.get_close_matches) as searched:
        buffer.add_robot(RRBOT, "r5")
    assert (compiled, searched) == ([], [])


def test_unrelated_tree_change_recompiles_no_path() -> None:
    buffer = TransformBuffer()
    fleet(buffer, 1)
    buffer.lookup("r0/base", "r0/tool")
    buffer.insert_static(static("table", "cup"))
    with calls(compile_path) as compiled:
        buffer.lookup("r0/base", "r0/tool")
    assert compiled == []


def test_static_insert_copies_no_tree() -> None:
    buffer = TransformBuffer()
    fleet(buffer, 20)
    frames = buffer._tree.frames
    with pytest.raises(InsertRefused):
        buffer.insert_static(static("r0/base", "r0/base"))
    buffer.insert_static(static("table", "cup"))
    assert buffer._tree.frames is frames


def test_unknown_frame_is_searched_once_per_change_and_near_misses_never() -> None:
    buffer = TransformBuffer()
    for number in range(20):
        watched(buffer, f"r{number}/base", f"r{number}/tool")
    with calls(difflib.get_close_matches) as searched:
        fleet(buffer, 20)
    assert searched == []
    with calls(FrameTree.dependencies) as searches:
        buffer.insert_static(static("table", "cup"))
    assert searches == []


def test_near_misses_are_those_at_the_time_of_the_error() -> None:
    buffer = filled(static("base", "left_camera"))
    error = failure(buffer, "base", "left_camra")
    assert isinstance(error, UnknownFrame)
    early = buffer.explain("base", "left_camra")
    buffer.insert_static(static("base", "left_camara"))
    late = buffer.explain("base", "left_camra")
    assert isinstance(early, UnknownFrame)
    assert isinstance(late, UnknownFrame)
    assert early.near_misses == ("left_camera",)
    assert set(late.near_misses) == {"left_camera", "left_camara"}


def test_timed_out_wait_has_near_misses() -> None:
    buffer = filled(static("base", "camera"))
    with pytest.raises(UnknownFrame, match="did you mean 'camera'") as caught:
        buffer.wait("base", "camra", timeout_s=0.001)
    assert caught.value.near_misses == ("camera",)


def test_unread_near_misses_survive_pickling_between_processes() -> None:
    error = filled(static("base", "camera")).explain("base", "camra")
    copy = pickle.loads(pickle.dumps(error))
    assert copy.near_misses == ("camera",)


def test_refused_insert_leaves_no_name() -> None:
    buffer = filled(static("r1/base", "r1/hand"))
    seen = watched(buffer, "r2/base", "r2/hand")
    edges = [("r2/base", "r2/hand"), ("r1/base", "r1/base")]
    with pytest.raises(InsertRefused):
        buffer.insert_many(edges, S, [(0, 0, 0, 0, 0, 0, 1)] * 2)
    assert [frame.name for frame in buffer.frames()] == ["r1/base", "r1/hand"]
    assert buffer.lookup("base", "hand").kind == "static"
    error = buffer.explain("r1/base", "r2/hand")
    assert isinstance(error, UnknownFrame)
    assert (error.frame_count, error.near_misses) == (2, ("r1/hand",))
    buffer.insert_static(static("r2/base", "r2/hand"))
    assert len(seen) == 1


def test_watch_by_bare_names_works_while_they_are_unique() -> None:
    buffer = TransformBuffer()
    seen = watched(buffer, "base", "tool")
    (one,) = fleet(buffer, 1)
    other = buffer.add_robot(RRBOT, "again")
    buffer.insert_joints(other, S, ZERO)
    buffer.insert_joints(one, S, ZERO)
    assert seen.stamps() == [0]


def test_watch_continues_when_an_edge_returns_with_another_history() -> None:
    buffer = filled(moving("a", "b", 5 * S, x=1.0))
    seen = watched(buffer, "a", "b")
    buffer.withdraw("b")
    buffer.insert(moving("a", "b", S, x=2.0))
    assert [x_of(transform) for transform in seen] == [1.0, 2.0]


@pytest.mark.parametrize(
    "forget", [lambda buffer, track: feed_of(buffer).restart(track), lambda buffer, _: buffer.clear()]
)
def test_watch_continues_in_a_new_epoch_with_older_stamps(forget) -> None:
    buffer = TransformBuffer()
    (track,) = fleet(buffer, 1)
    seen = watched(buffer, "r0/base", "r0/tool")
    buffer.insert_joints(track, 100 * S, ZERO)
    forget(buffer, track)
    buffer.insert_joints(track, 5 * S, ZERO)
    buffer.insert_joints(track, 6 * S, ZERO)
    assert seen.stamps() == [0, 100 * S, 5 * S, 6 * S]


def test_first_velocities_of_a_robot_reach_compiled_paths() -> None:
    buffer, track = every_joint()
    buffer.insert_joints(track, 0, pose_of_every(track))
    assert buffer.lookup("body", "lift").kind == "exact"
    buffer.insert_joints(track, MS, pose_of_every(track), [0.0] * track.model.velocity_count)
    assert buffer.lookup("body", "lift", 2 * MS, predict_s=1.0).kind == "predicted"


def test_closed_waiter_is_not_listed_anywhere() -> None:
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT)
    # Closed during its callback; it then expects no further sample.
    watch = buffer.watch("base", "tool", lambda _: watch.close())
    buffer.insert_joints(track, S, ZERO)
    buffer.wait("base", "tool", S)
    assert watch.failures == 0
    assert (len(buffer._waiters), buffer._waiters._by_track) == (0, {})
