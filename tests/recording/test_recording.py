"""Questions to a recorded file: what it is, a buffer of it, and many instants without holding it all."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from helpers.processes import Child
from helpers.recording_builder import (
    MS,
    START,
    Bag,
    RecordingBuilder,
    S,
    pose,
    swing_positions,
    swing_velocities,
)

from zstate import Recording, TransformBuffer, UnknownFrame
from zstate.errors import Disconnected, InPast, InvalidInput, RecordingError
from zstate.transform import Transform


def test_repr_has_duration_and_robots(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("r1")
        builder.joints("r1", START + S, swing_positions(0), log_time=START + 2 * S)
        builder.describe("r2", at=START + 3 * S)
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.robots == ("r1", "r2")
        assert recording.info.duration_s == 3.0
        assert recording.info.complete


def test_unknown_robot_is_refused(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("r1")
    with pytest.raises(InvalidInput, match="'r1'"):
        Recording(tmp_path / "r.mcap", "r2")


def test_closed_recording_raises(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
    recording = Recording(tmp_path / "r.mcap")
    recording.close()
    recording.close()
    with pytest.raises(RecordingError, match="closed"):
        recording.buffer()


def wild(path: Path, seed: int) -> None:
    """Two writers after each other, late samples, repeated stamps, clocks set back, edges that move over."""
    dice = random.Random(seed)
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm")
        offset = 0
        for n in range(600):
            log_time = START + n * 10 * MS
            if n == 150:
                offset = -3600 * S
            session = 1 + (n > 300)
            stamp = log_time + offset - dice.choice([0, 0, 0, 35 * MS, 70 * MS])
            builder.joints(
                "arm",
                stamp,
                swing_positions(dice.random()),
                swing_velocities(n),
                session=session,
                log_time=log_time,
            )
            if n % 3 == 0:
                world = pose(dice.random(), dice.random(), yaw=dice.random())
                builder.edges(
                    "arm", stamp, {("odom", "world"): world, ("map", "odom"): pose(n)}, log_time=log_time
                )
            if n % 50 == 7:
                builder.edges("arm", stamp, {("map", "odom"): pose(-n)}, log_time=log_time, session=5)
            if n in {20, 400}:
                builder.statics("arm", log_time, {("tool", "tip"): pose(z=n)})


@pytest.mark.parametrize("seed", range(4))
def test_lookup_many_equals_that_of_a_full_buffer(tmp_path: Path, seed: int, monkeypatch):
    monkeypatch.setattr("zstate.recording.recording._BATCH", 37)
    wild(tmp_path / "r.mcap", seed)
    dice = np.random.default_rng(seed)
    begin = START - 3600 * S
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
        known = [buffer.latest("map", "tip"), buffer.latest("world", "tool")]
        stamps = np.concatenate((dice.integers(begin - S, begin + 7 * S, 30), known, [START, begin]))
        for target, source in [("map", "tip"), ("world", "tool"), ("odom", "map"), ("tool", "tip")]:
            poses, valid = buffer.lookup_many(target, source, stamps)
            assert valid.sum() > 5
            streamed_poses, streamed_valid = recording.lookup_many(target, source, stamps)
            assert np.array_equal(streamed_valid, valid)
            assert np.array_equal(streamed_poses, poses, equal_nan=True)


def test_points_are_placed_as_by_a_full_buffer(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("zstate.recording.recording._BATCH", 37)
    wild(tmp_path / "r.mcap", 2)
    dice = np.random.default_rng(2)
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
        newest = buffer.latest("world", "tool")
        stamps = dice.integers(newest - S, newest + S // 10, 50)
        points = dice.uniform(-5.0, 5.0, (50, 3)).astype(np.float32)
        expected, known = buffer.place(points, stamps, source="tool", target="world")
        placed, valid = recording.place(points, stamps, source="tool", target="world")
        assert 5 < valid.sum() < 50
        assert np.array_equal(valid, known)
        assert np.array_equal(placed, expected, equal_nan=True)
        placed, valid = recording.place(points, newest, source="tool", target="world")
        assert valid.all()
        assert np.array_equal(placed, buffer.place(points, newest, source="tool", target="world")[0])


def test_lookup_many_of_no_stamps_is_empty(tmp_path: Path):
    wild(tmp_path / "r.mcap", 1)
    with Recording(tmp_path / "r.mcap") as recording:
        poses, valid = recording.lookup_many("map", "tip", [])
    assert (poses.shape, valid.shape) == ((0, 7), (0,))


def test_unknown_and_disconnected_frames_raise(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.joints("arm", START, swing_positions(0))
        builder.statics("arm", START, {("table", "cup"): pose()})
    with Recording(tmp_path / "r.mcap") as recording:
        with pytest.raises(UnknownFrame, match="tol"):
            recording.lookup_many("world", "tol", [START])
        with pytest.raises(Disconnected):
            recording.lookup_many("world", "cup", [START])
        with pytest.raises(InvalidInput, match="integer"):
            recording.lookup_many("world", "tool", [0.5])
        with pytest.raises(UnknownFrame, match="tol"):
            recording.place([[0, 0, 0]], START, source="tol", target="world")
        with pytest.raises(InvalidInput, match="1 points have 2 stamps"):
            recording.place([[0, 0, 0]], [START, START], source="tool", target="world")


def test_edges_refused_live_are_refused_from_a_recording(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.statics("thief", START, {("thief/map", "arm/camera"): pose(x=9.0)})
        builder.statics("thief", START, {("arm/base", "arm/laser"): pose(x=9.0)}, writer="laser")
        builder.statics("arm", START + MS, {("lower", "world"): pose(x=9.0)}, writer="mix-up")
        builder.statics("arm", START + 2 * MS, {("tool", "camera"): pose(x=1.0)})
        builder.describe("arm", at=START + 3 * MS)
        builder.joints("arm", START + 4 * MS, swing_positions(0))
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
    placed = {frame.name: frame.parent for frame in buffer.frames() if frame.parent is not None}
    assert placed["arm/camera"] == "arm/tool"
    assert not {"arm/world", "arm/laser"} & placed.keys()
    assert buffer.can_lookup("world", "camera")


def test_bag_is_a_recording(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        for n in range(20):
            bag.tf(START + n, [Transform("odom", "base", [n, 0, 0], [0, 0, 0, 1], START + n * S)])
    with Recording(tmp_path / "bag") as recording:
        poses, valid = recording.lookup_many("odom", "base", [START + 5 * S // 2, START - 1, START])
    assert poses[:, 0].tolist()[::2] == [2.5, 0.0]
    assert valid.tolist() == [True, False, True]


MEMORY = """
    import resource, sys
    import numpy as np
    from zstate import Recording
    def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    small, large = sys.argv[1:]
    stamps = np.arange(1_700_000_000_000_000_000, 1_700_000_001_000_000_000, 1_000_000)
    for path in (small, large):
        with Recording(path) as recording:
            poses, valid = recording.lookup_many("odom", "base0", stamps)
            assert valid.all()
        print(peak())
"""


@pytest.mark.processes
def test_lookup_many_memory_does_not_grow_with_the_recording(tmp_path: Path, spawn):
    # 40 edges of 64 bytes: the large recording would fill a buffer with 50 MB.
    sizes = {"small": 1_000, "large": 20_000}
    for name, count in sizes.items():
        with RecordingBuilder(tmp_path / name, "cart") as builder:
            for n in range(count):
                edges = {("odom", f"base{k}"): pose(n, k) for k in range(40)}
                builder.edges("cart", START + n * 10 * MS, edges)
    child: Child = spawn(MEMORY, str(tmp_path / "small"), str(tmp_path / "large"))
    small, large = int(child.line(60)), int(child.line(60))
    assert large - small < 20, (small, large)


def test_buffer_keeps_samples_around_requested_stamps():
    buffer = TransformBuffer(1000.0)
    for n in range(100):
        buffer.insert(Transform("odom", "base", [n, 0, 0], [0, 0, 0, 1], n * S))
    wanted = np.array([10 * S + 1, 20 * S, 99 * S])
    before = buffer.lookup_many("odom", "base", wanted)[0]
    buffer.keep_only_around(wanted)
    (base,) = (frame for frame in buffer.frames() if frame.name == "base")
    # The first, 10 and 11, 20, and the last, which is 99.
    assert (base.count, base.oldest, base.newest) == (5, 0, 99 * S)
    assert np.array_equal(buffer.lookup_many("odom", "base", wanted)[0], before)


def test_lookup_before_the_recording_does_not_suggest_a_listener(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(3):
            builder.joints("arm", START + n * S, swing_positions(n))
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
    frames = [frame for frame in buffer.frames() if frame.kind == "joint"]
    plan = buffer.plan(frames[0].parent, frames[0].name)
    for call in (lambda: plan.at(START - S), lambda: plan.poses([START - S])):
        with pytest.raises(InPast, match="the recording has nothing older of it") as caught:
            call()
        assert "listener" not in str(caught.value)
