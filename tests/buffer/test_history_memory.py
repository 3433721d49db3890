"""Memory of a buffer: its history, and no other structure that grows."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from helpers.buffers import MS, NOW, S, moving

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.buffer.tracks import JointTrack
from zstate.model.load import load_model

MEGABYTE = 1_000_000
LIMIT = 8 * MEGABYTE
EDGES = 40


def a_robot_of_40_edges(buffer: TransformBuffer) -> JointTrack:
    links = "".join(f'<link name="l{n}"/>' for n in range(EDGES + 1))
    joints = "".join(
        f'<joint name="j{n}" type="revolute"><parent link="l{n}"/><child link="l{n + 1}"/><axis xyz="0 0 1"/>'
        '<limit lower="-3" upper="3" velocity="1" effort="1"/></joint>'
        for n in range(EDGES)
    )
    return buffer.add_robot(load_model(f'<robot name="long">{links}{joints}</robot>'))


def held(track: JointTrack) -> int:
    """Bytes of the history, spare room included."""
    view = track.history.view
    return view.stamps.nbytes + view.rows.nbytes


def fill(buffer: TransformBuffer, track: JointTrack, begin: int, count: int, step_ns: int) -> int:
    """The most bytes the history ever held."""
    positions, most = np.linspace(-1, 1, EDGES), 0
    for n in range(count):
        buffer.insert_joints(track, begin + n * step_ns, positions)
        most = max(most, held(track))
    return most


def test_forty_edge_robot_at_1_khz_needs_at_most_8_mb_for_10_s() -> None:
    gc.collect()
    tracemalloc.start()
    try:
        buffer = TransformBuffer(history_s=10.0)
        track = a_robot_of_40_edges(buffer)
        most = fill(buffer, track, NOW, 20_000, MS)
        traced, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    print(f"history {held(track)} bytes, at most {most}; traced {traced}, peak {peak}")
    assert track.history.view.size == 10_001
    assert held(track) <= most <= LIMIT
    # The peak is the moment at which the history moves into new arrays.
    assert traced <= peak <= LIMIT


def test_memory_is_unchanged_after_an_hour_of_simulated_time() -> None:
    buffer = TransformBuffer(history_s=10.0)
    track = a_robot_of_40_edges(buffer)
    most_at_first = fill(buffer, track, NOW, 1_000, 100 * MS)
    gc.collect()
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        most = fill(buffer, track, NOW + 100 * S, 36_000, 100 * MS)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert track.history.view.size == 101
    assert most <= most_at_first
    assert after - before <= 2 * most


def test_edge_that_is_inserted_and_withdrawn_repeatedly_leaks_nothing() -> None:
    buffer = TransformBuffer()

    def come_and_go(count: int) -> None:
        for n in range(count):
            buffer.insert(moving("a", "b", n))
            buffer.lookup("a", "b")
            buffer.withdraw("b")

    come_and_go(50)
    gc.collect()
    tracemalloc.start()
    try:
        come_and_go(500)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after < 50_000


@pytest.mark.parametrize("late", [0, 1])
def test_late_samples_need_no_more_memory_than_ordered_ones(late: int) -> None:
    buffer = TransformBuffer(history_s=1.0)
    for n in range(3_000):
        # Every second sample comes before its neighbour when ``late``.
        buffer.insert(moving("a", "b", (n ^ late) * MS))
    view = feed_of(buffer).tree_snapshot().edges["b"].track.history.view
    assert view.size == 1_001
    assert len(view.stamps) <= 2 * view.size


def test_only_the_ends_and_the_samples_around_the_requested_stamps_are_kept() -> None:
    buffer = TransformBuffer(history_s=1000.0)
    for n in range(100):
        buffer.insert(moving("odom", "base", n * S, x=n))
    wanted = np.array([10 * S + 1, 20 * S, 99 * S])
    before, _ = buffer.lookup_many("odom", "base", wanted)
    buffer.keep_only_around(wanted)
    kept = feed_of(buffer).tree_snapshot().edges["base"].track.history.view.kept_stamps()
    assert kept.tolist() == [0, 10 * S, 11 * S, 20 * S, 99 * S]
    assert np.array_equal(buffer.lookup_many("odom", "base", wanted)[0], before)
