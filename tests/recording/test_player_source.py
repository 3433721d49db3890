"""A recorded motion as a joint source: the same spacing, beginning now."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.processes import SteppingClock
from helpers.recording_builder import MS, START, Bag, RecordingBuilder, S, swing_positions, swing_velocities
from helpers.robots import RRBOT

from zstate.errors import InvalidInput
from zstate.model.load import load_model
from zstate.net.session import connect
from zstate.nodes.publisher import StatePublisher
from zstate.recording.player import RecordedSource

NOW = 1_900_000_000 * S


def arm(path: Path, count: int = 100, **options: object) -> Path:
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm")
        for n in range(count):
            builder.joints(
                "arm", START + n * 10 * MS + n % 3, swing_positions(n), swing_velocities(n), **options
            )
    return path


def test_readings_are_the_recorded_numbers_shifted_to_the_present(tmp_path: Path):
    with RecordedSource(arm(tmp_path / "r.mcap"), "arm", RRBOT) as source:
        for n in range(100):
            reading = source.read(NOW + n * 10 * MS + n % 3)
            assert reading is not None
            assert reading.stamp == NOW + n * 10 * MS + n % 3
            assert reading.positions.tolist() == swing_positions(n)
            assert reading.velocities is not None
            assert reading.velocities.tolist() == swing_velocities(n)
        assert source.ended
        assert source.read(NOW + 10 * S) is None


def test_slow_reader_gets_the_newest_due_reading(tmp_path: Path):
    with RecordedSource(arm(tmp_path / "r.mcap"), "arm", RRBOT) as source:
        assert source.read(NOW) is not None
        reading = source.read(NOW + 57 * MS)
        assert reading is not None
        assert reading.positions.tolist() == swing_positions(5)


def test_read_returns_none_without_a_new_reading(tmp_path: Path):
    with RecordedSource(arm(tmp_path / "r.mcap"), "arm", RRBOT) as source:
        source.read(NOW)
        assert source.read(NOW + 5 * MS) is None
        assert not source.ended


def test_only_robot_is_the_default(tmp_path: Path):
    with RecordedSource(arm(tmp_path / "r.mcap"), None, RRBOT) as source:
        assert source.robot == "arm"


def test_unknown_robot_error_lists_the_robots(tmp_path: Path):
    with pytest.raises(InvalidInput, match="joint_states of 'leg'; it has those of 'arm'"):
        RecordedSource(arm(tmp_path / "r.mcap"), "leg", RRBOT)
    with Bag(tmp_path / "bag") as bag:
        for robot in ("a", "b"):
            bag.joints(START, {"shoulder": 0.0}, f"/{robot}/joint_states")
    with pytest.raises(
        InvalidInput, match="of one robot; it has those of 'a', 'b'; name one of them as ROBOT"
    ):
        RecordedSource(tmp_path / "bag", None, RRBOT)


def test_states_that_do_not_fit_the_model_are_counted_and_skipped(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.joints(START, {"shoulder": 0.5})
        bag.joints(START + 1, {"shoulder": 0.5, "elbow": np.nan})
        bag.joints(START + 2, {"elbow": 0.25, "shoulder": 0.5})
    with RecordedSource(tmp_path / "bag", None, RRBOT) as source:
        reading = source.read(NOW)
        assert reading is not None
        assert reading.positions.tolist() == [0.5, 0.25]
        assert source.refused == {"missing joints": 1, "bad numbers": 1}


def test_restarted_writer_continues_at_its_log_times(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.joints("arm", 500 * S, [1, 0], session=1, log_time=START)
        builder.joints("arm", 3 * S, [2, 0], session=2, log_time=START + 2 * S)
        builder.joints("arm", 4 * S, [3, 0], session=2, log_time=START + 3 * S)
    with RecordedSource(tmp_path / "r.mcap", None, RRBOT) as source:
        stamps = [source.read(NOW + n * S) for n in range(4)]
    found = [None if reading is None else (reading.stamp, reading.positions[0]) for reading in stamps]
    assert found == [(NOW, 1.0), None, (NOW + 2 * S, 2.0), (NOW + 3 * S, 3.0)]


def test_late_sample_does_not_move_the_robot_back(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for number, millisecond in enumerate([0, 20, 10, 30]):
            builder.joints("arm", START + millisecond * MS, [number, 0], log_time=START + number * MS)
    with RecordedSource(tmp_path / "r.mcap", None, RRBOT) as source:
        seen = [source.read(NOW + n * 10 * MS) for n in range(4)]
    assert [None if reading is None else reading.positions[0] for reading in seen] == [0.0, None, 1.0, 3.0]


def test_publisher_runs_with_a_recorded_source(tmp_path: Path):
    path = arm(tmp_path / "r.mcap", 10)
    with (
        connect() as session,
        RecordedSource(path, "arm", RRBOT) as source,
        StatePublisher(session, load_model("rrbot"), "arm", clock=SteppingClock()) as publisher,
    ):
        report = publisher.run(source, 1000.0, seconds=source.duration_s + 0.001)
        assert source.ended
        # From the description to the last state, 90 ms later, which arrived 200 us after its stamp.
        assert report.ticks == 91
