"""ViewSource: snapshots of a buffer, live and recorded, and the fixed frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.processes import until
from helpers.raw_ros_nodes import JOINT_STATES, key_of
from helpers.robots import wait_for_reader, wait_for_stream_readers

from zstate import (
    SineSource,
    StatePublisher,
    Transform,
    TransformBuffer,
    TransformPublisher,
    load_model,
)
from zstate.buffer.buffer import feed_of
from zstate.recording.recorder import Recorder
from zstate.scans import Grid, MapPublisher, ScanPublisher
from zstate.view.data_source import FixedFrame, ViewSource

MODEL = load_model("rrbot")
SECOND = 1_000_000_000
IDENTITY = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def shifted(target: str, source: str, x: float, stamp: int | None = None) -> Transform:
    return Transform(target, source, (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp=stamp)


def source_of(*robots: str, shown: tuple[str, ...] = ()) -> ViewSource:
    buffer = TransformBuffer()
    for robot in robots:
        buffer.add_robot(MODEL, robot)
    return ViewSource(None, shown, buffer=buffer)


def track_of(source: ViewSource, robot: str):
    return feed_of(source.buffer).tree_snapshot().robots[robot]


def test_snapshot_poses_equal_buffer_lookups():
    source = source_of("a")
    source.buffer.insert_static(shifted("map", "a/" + MODEL.root, 2.0))
    for stamp, position in ((1 * SECOND, 0.25), (2 * SECOND, 0.75)):
        source.buffer.insert_joints(track_of(source, "a"), stamp, [position, -position])
        source.buffer.insert(shifted("map", "marker", position, stamp))
    newest = 2 * SECOND
    for at, stamp in ((None, newest), *((at, at) for at in (1 * SECOND, newest, 1_300_000_000))):
        snapshot = source.snapshot(at)
        assert snapshot.known.all()
        assert snapshot.stamp == stamp
        for row, name in enumerate(snapshot.tree.names):
            parent = int(snapshot.tree.parents[row])
            if parent >= 0:
                expected = source.buffer.lookup(snapshot.tree.names[parent], name, at).matrix
                drawn = Transform.from_pose7("p", "c", snapshot.poses[row]).matrix
                np.testing.assert_allclose(drawn, expected, atol=1e-12)
            else:
                assert snapshot.poses[row].tolist() == IDENTITY


def test_edges_of_one_track_are_interpolated_together():
    source = ViewSource(None, buffer=TransformBuffer())
    edges = [("odom", "base"), ("odom", "cart")]
    half_turn_less = [1.0, 0.0, 0.0, 0.0, 0.0, np.sin(0.5), np.cos(0.5)]
    source.buffer.insert_many(edges, 1 * SECOND, [IDENTITY, IDENTITY])
    source.buffer.insert_many(edges, 2 * SECOND, [half_turn_less, IDENTITY])
    snapshot = source.snapshot(1_500_000_000)
    base = snapshot.poses[snapshot.tree.row("base")]
    assert base == pytest.approx([0.5, 0.0, 0.0, 0.0, 0.0, np.sin(0.25), np.cos(0.25)])


def test_parents_come_before_children_in_any_insertion_order():
    source = ViewSource(None, buffer=TransformBuffer())
    source.buffer.insert_static(shifted("b", "c", 1.0))
    source.buffer.insert_static(shifted("a", "b", 1.0))
    tree = source.snapshot().tree
    assert tree.names == ("a", "b", "c")
    assert tree.parents.tolist() == [-1, 0, 1]
    assert tree.kinds == ("root", "static", "static")


def test_edge_without_samples_has_a_reason():
    snapshot = source_of("a").snapshot()
    unknown = {snapshot.tree.kinds[row] for row in np.flatnonzero(~snapshot.known)}
    assert unknown == {"joint"}
    assert snapshot.stamp is None
    row = snapshot.tree.row("a/upper")
    assert snapshot.reasons[row] == "no joint sample of 'a' received (no writer)"


def test_robot_keeps_its_pose_for_half_a_second_after_its_last_sample():
    source = source_of("a")
    source.buffer.insert_joints(track_of(source, "a"), 10 * SECOND, [0.0, 0.0])
    source.buffer.insert_joints(track_of(source, "a"), 11 * SECOND, [0.1, 0.1])
    assert source.snapshot(11 * SECOND + 400_000_000).known.all()
    late = source.snapshot(15 * SECOND)
    assert set(late.reasons.values()) == {"4.0 s after the newest sample of 'a' (no writer)"}
    early = source.snapshot(8 * SECOND)
    assert set(early.reasons.values()) == {"2.0 s before the oldest sample of 'a' (no writer)"}


def test_version_grows_with_frames_and_writers_but_not_with_samples():
    source = source_of("a")
    before = source.version
    source.buffer.insert_joints(track_of(source, "a"), SECOND, [0.0, 0.0])
    source.snapshot()
    assert source.version == before
    source.buffer.insert_static(shifted("map", "a/" + MODEL.root, 2.0))
    assert source.version > before
    between = source.version
    track_of(source, "a").writer = "driver@here"
    assert source.version > between
    assert "driver@here" in source.snapshot().tree.writers


def test_only_selected_robots_and_their_ancestors_are_in_a_snapshot():
    source = source_of("a", "b", shown=("a",))
    source.buffer.insert_static(shifted("map", "a/" + MODEL.root, 2.0))
    source.buffer.insert_static(shifted("map", "b/" + MODEL.root, 3.0))
    assert source.robots() == ("a",)
    names = source.snapshot().tree.names
    assert "map" in names
    assert not [name for name in names if name.startswith("b/")]


def test_silent_time_of_a_track_grows_until_its_next_sample(sessions):
    writing, reading = sessions
    sine = SineSource(MODEL)
    with ViewSource(reading) as source:
        assert source.robots() == ()
        with StatePublisher(writing, MODEL, "r1") as publisher:
            publisher.publish(sine.read(SECOND).positions)
            until(lambda: source.snapshot().stamp is not None)
            track = track_of(source, "r1")
            assert source.models["r1"].digest == MODEL.digest
            assert source.robots() == ("r1",)
            first = source.silent_s(track)
            assert first is not None
            until(lambda: (source.silent_s(track) or 0.0) > first + 0.05)
            publisher.publish(sine.read(2 * SECOND).positions)
            silent = source.silent_s(track)
            until(lambda: source.poll() or (source.silent_s(track) or 0.0) < silent)


def test_robot_of_transforms_only_is_timed_too(sessions):
    writing, reading = sessions
    with ViewSource(reading) as source, TransformPublisher(writing, "cam", "tracker") as tracker:
        tracker.publish([shifted("room", "marker", 1.0)])
        until(lambda: source.snapshot().stamp is not None)
        assert (source.robots(), dict(source.models)) == (("cam",), {})
        (track,) = source.snapshot().tree.tracks_of["cam"]
        first = source.silent_s(track)
        until(lambda: (source.silent_s(track) or 0.0) > first + 0.05)
        silent = source.silent_s(track)
        tracker.publish([shifted("room", "marker", 2.0)])
        until(lambda: source.poll() or (source.silent_s(track) or 0.0) < silent)


def test_recording_is_a_source_without_a_session(sessions, tmp_path: Path):
    writing, reading = sessions
    file = tmp_path / "one.mcap"
    with Recorder(reading, file) as recorder, StatePublisher(writing, MODEL, "r1") as publisher:
        wait_for_stream_readers(writing, "r1")
        sine = SineSource(MODEL)
        stamps = [publisher.publish(sine.read(n * SECOND).positions) for n in range(3)]
        assert stamps
        until(lambda: sum(recorder.stats.messages.values()) >= 4)
    with ViewSource.from_recording(file) as source:
        assert source.robots() == ("r1",)
        assert source.snapshot().known.all()
        assert source.silent_s(track_of(source, "r1")) is None


def test_robots_of_the_ros2_wire_format_are_received(sessions, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    with (
        StatePublisher(sessions[0], MODEL, wires="ros2") as publisher,
        ViewSource(sessions[1], wire="ros2") as source,
    ):
        wait_for_reader(sessions[0], key_of(JOINT_STATES))
        publisher.publish([0.5, -0.5])
        until(lambda: source.snapshot().stamp is not None)
        assert [model.digest for model in source.models.values()] == [MODEL.digest]
        assert source.snapshot().known.all()


def rrbot_buffer() -> TransformBuffer:
    buffer = TransformBuffer()
    buffer.add_robot(MODEL, "r1")
    return buffer


def test_default_fixed_frame_is_the_root_with_the_most_frames():
    buffer = rrbot_buffer()
    buffer.insert_static(Transform("map", "odom", [0, 0, 0], [0, 0, 0, 1]))
    with ViewSource(None, buffer=buffer) as source:
        assert FixedFrame().resolve(source.snapshot().tree) == f"r1/{MODEL.root}"


def test_requested_fixed_frame_is_used_while_it_exists():
    with ViewSource(None, buffer=rrbot_buffer()) as source:
        tree, fixed = source.snapshot().tree, FixedFrame()
        fixed.requested = tree.names[2]
        assert fixed.resolve(tree) == tree.names[2]
        fixed.requested = "removed"
        assert fixed.resolve(tree) == f"r1/{MODEL.root}"


def test_fixed_frame_of_an_empty_tree_is_empty():
    with ViewSource(None, buffer=TransformBuffer()) as source:
        assert FixedFrame().resolve(source.snapshot().tree) == ""


def test_scans_and_maps_are_received_until_maps_are_withdrawn(sessions):
    geometry = {"angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.1, "range_max": 10.0}
    grid = Grid([[0, 100]], 0.5, (1.0, 2.0, 0.0))
    with (
        ViewSource(sessions[1], ["a"]) as source,
        ScanPublisher(sessions[0], "a", "front", frame="laser", **geometry) as front,
        ScanPublisher(sessions[0], "b", "front", frame="laser", **geometry) as other,
    ):
        with MapPublisher(sessions[0], "hall", grid):
            until(lambda: source.world.maps_at(None))
            ((name, received),) = source.world.maps_at(None).items()
            assert str(name) == "hall/map"
            assert received.frame == "hall/map"
            assert received.cells.tolist() == [[0, 100]]
        until(lambda: not source.world.maps_at(None))
        until(lambda: other.publish([1.0, 2.0]) or front.publish([1.0, 2.0]) or source.world.sensors)
        ((sensor, scans),) = source.world.sensors.items()  # not those of b, which is not selected
        assert str(sensor) == "a/front"
        assert scans.frame == "a/laser"
