"""The world is what a buffer holds, all of it at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.processes import until
from helpers.raw_ros_nodes import JOINT_STATES, key_of
from helpers.robots import wait_for_reader, wait_for_stream_readers

from zstate import SineSource, StatePublisher, Transform, TransformBuffer, load_model
from zstate.recording.recorder import Recorder
from zstate.view.data_source import ViewSource

MODEL = load_model("rrbot")
SECOND = 1_000_000_000
IDENTITY = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def shifted(target: str, source: str, x: float, stamp: int | None = None) -> Transform:
    return Transform(target, source, (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp=stamp)


def world_of(*robots: str, shown: tuple[str, ...] = ()) -> ViewSource:
    buffer = TransformBuffer()
    for robot in robots:
        buffer.add_robot(MODEL, robot)
    return ViewSource(None, shown, buffer=buffer)


def track_of(world: ViewSource, robot: str):
    return world.buffer.tree_snapshot().robots[robot]


def test_every_pose_is_what_the_buffer_says_of_that_edge():
    world = world_of("a")
    world.buffer.insert_static(shifted("map", "a/" + MODEL.root, 2.0))
    for stamp, position in ((1 * SECOND, 0.25), (2 * SECOND, 0.75)):
        world.buffer.insert_joints(track_of(world, "a"), stamp, [position, -position])
        world.buffer.insert(shifted("map", "marker", position, stamp))
    for at in (None, 1 * SECOND, 2 * SECOND, 1_300_000_000):
        moment = world.moment(at)
        assert moment.known.all()
        assert moment.stamp == at or at is None
        for row, name in enumerate(moment.tree.names):
            parent = int(moment.tree.parents[row])
            if parent >= 0:
                said = world.buffer.lookup(moment.tree.names[parent], name, at).matrix
                drawn = Transform.from_pose7("p", "c", moment.poses[row]).matrix
                np.testing.assert_allclose(drawn, said, atol=1e-12)
            else:
                assert moment.poses[row].tolist() == IDENTITY
    assert world.moment().stamp == 2 * SECOND


def test_frames_of_one_feed_are_read_together_between_its_samples():
    world = ViewSource(None, buffer=TransformBuffer())
    edges = [("odom", "base"), ("odom", "cart")]
    half_turn_less = [1.0, 0.0, 0.0, 0.0, 0.0, np.sin(0.5), np.cos(0.5)]
    world.buffer.insert_many(edges, 1 * SECOND, [IDENTITY, IDENTITY])
    world.buffer.insert_many(edges, 2 * SECOND, [half_turn_less, IDENTITY])
    moment = world.moment(1_500_000_000)
    base = moment.poses[moment.tree.row("base")]
    assert base == pytest.approx([0.5, 0.0, 0.0, 0.0, 0.0, np.sin(0.25), np.cos(0.25)])


def test_parents_stand_before_children_whoever_was_named_first():
    world = ViewSource(None, buffer=TransformBuffer())
    world.buffer.insert_static(shifted("b", "c", 1.0))
    world.buffer.insert_static(shifted("a", "b", 1.0))
    tree = world.moment().tree
    assert tree.names == ("a", "b", "c")
    assert tree.parents.tolist() == [-1, 0, 1]
    assert tree.kinds == ("root", "static", "static")


def test_an_edge_without_samples_says_so():
    moment = world_of("a").moment()
    unknown = {moment.tree.kinds[row] for row in np.flatnonzero(~moment.known)}
    assert unknown == {"joint"}
    assert moment.stamp is None
    row = moment.tree.row("a/upper")
    assert moment.reasons[row] == "no joint sample of 'a' received (no writer)"


def test_a_robot_that_ends_early_is_drawn_a_little_longer_and_then_no_more():
    world = world_of("a")
    world.buffer.insert_joints(track_of(world, "a"), 10 * SECOND, [0.0, 0.0])
    world.buffer.insert_joints(track_of(world, "a"), 11 * SECOND, [0.1, 0.1])
    assert world.moment(11 * SECOND + 400_000_000).known.all()
    late = world.moment(15 * SECOND)
    assert set(late.reasons.values()) == {"4.0 s after the newest sample of 'a' (no writer)"}
    early = world.moment(8 * SECOND)
    assert set(early.reasons.values()) == {"2.0 s before the oldest sample of 'a' (no writer)"}


def test_the_version_grows_when_there_is_something_else_to_see_and_not_with_samples():
    world = world_of("a")
    before = world.version
    world.buffer.insert_joints(track_of(world, "a"), SECOND, [0.0, 0.0])
    world.moment()
    assert world.version == before
    world.buffer.insert_static(shifted("map", "a/" + MODEL.root, 2.0))
    assert world.version > before
    between = world.version
    track_of(world, "a").writer = "driver@here"
    assert world.version > between
    assert "driver@here" in world.moment().tree.writers


def test_only_the_chosen_robots_are_seen_with_what_they_stand_on():
    world = world_of("a", "b", shown=("a",))
    world.buffer.insert_static(shifted("map", "a/" + MODEL.root, 2.0))
    world.buffer.insert_static(shifted("map", "b/" + MODEL.root, 3.0))
    assert world.robots() == ("a",)
    names = world.moment().tree.names
    assert "map" in names
    assert not [name for name in names if name.startswith("b/")]


def test_a_robot_on_the_network_is_found_and_its_silence_is_counted(sessions):
    writing, reading = sessions
    source = SineSource(MODEL)
    with ViewSource(reading) as world:
        assert world.robots() == ()
        with StatePublisher(writing, MODEL, "r1") as publisher:
            publisher.publish(source.read(SECOND).positions)
            until(lambda: world.moment().stamp is not None and world.silent_s("r1") is not None)
            assert world.models["r1"].digest == MODEL.digest
            assert world.robots() == ("r1",)
            first = world.silent_s("r1")
            assert first is not None
            until(lambda: (world.silent_s("r1") or 0.0) > first + 0.05)
            publisher.publish(source.read(2 * SECOND).positions)
            silent = world.silent_s("r1")
            until(lambda: world.poll() or (world.silent_s("r1") or 0.0) < silent)
        assert world.silent_s("nobody") is None


def test_a_recording_is_a_world_without_a_network(sessions, tmp_path: Path):
    writing, reading = sessions
    file = tmp_path / "one.mcap"
    with Recorder(reading, file) as recorder, StatePublisher(writing, MODEL, "r1") as publisher:
        wait_for_stream_readers(writing, "r1")
        source = SineSource(MODEL)
        stamps = [publisher.publish(source.read(n * SECOND).positions) for n in range(3)]
        assert stamps
        until(lambda: sum(recorder.stats.messages.values()) >= 4)
    with ViewSource.of_recording(file) as world:
        assert world.robots() == ("r1",)
        assert world.moment().known.all()
        assert world.silent_s("r1") is None


def test_robots_that_speak_ros_are_seen_like_others(sessions, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    with (
        StatePublisher(sessions[0], MODEL, wires="ros2") as publisher,
        ViewSource(sessions[1], wire="ros2") as world,
    ):
        wait_for_reader(sessions[0], key_of(JOINT_STATES))
        publisher.publish([0.5, -0.5])
        until(lambda: world.moment().stamp is not None)
        assert [model.digest for model in world.models.values()] == [MODEL.digest]
        assert world.moment().known.all()
