"""Questions to an archive: the same answers as the recordings it was made of, to the bit."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
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
from helpers.robots import RRBOT
from recording.test_recording import wild

from zstate import Archive, Recording, Transform, UnknownFrame
from zstate.archive import import_recording
from zstate.archive.cut import cut
from zstate.errors import InvalidInput
from zstate.odometry.messages import Imu
from zstate.recording.decode import DecodedMessage
from zstate.recording.errors import RecordingError
from zstate.wire.messages import to_block

DAY = 86_400 * S
MIDNIGHT = START - START % DAY + DAY
PAIRS = [("map", "tip"), ("world", "tool"), ("odom", "map"), ("tool", "tip")]


def tour(path: Path, start: int, end: int, *, tip: float = 0.1) -> None:
    """An arm that swings 50 times a second on a base that drives, from ``start`` up to ``end`` [ns]."""
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm", at=start)
        builder.statics("arm", start, {("tool", "tip"): pose(z=tip)})
        for stamp in range(start, end, 20 * MS):
            seconds = (stamp - MIDNIGHT) / S
            rates = swing_velocities(seconds) if stamp % (100 * MS) == 0 else None
            builder.joints("arm", stamp, swing_positions(seconds), rates)
            if stamp % (60 * MS) == 0:
                covariance = {("odom", "world"): np.eye(6) * (1.0 + seconds**2)}
                poses = {("odom", "world"): pose(seconds, yaw=seconds), ("map", "odom"): pose(y=seconds)}
                builder.edges("arm", stamp + 7 * MS, poses, writer="odometry", covariances=covariance)


def assert_same_lookups(archive: Archive, recording: Recording, stamps: np.ndarray) -> None:
    buffer = recording.buffer()
    window = archive.buffer("arm", int(stamps.min()), int(stamps.max()))
    for target, source in PAIRS:
        poses, valid = buffer.lookup_many(target, source, stamps)
        assert valid.any()
        for found, is_found in (
            archive.lookup_many(target, source, stamps, robot="arm"),
            window.lookup_many(target, source, stamps),
        ):
            assert np.array_equal(is_found, valid)
            assert np.array_equal(found, poses, equal_nan=True)
    stamp = int(stamps[len(stamps) // 2])
    one, other = window.lookup("map", "world", stamp), buffer.lookup("map", "world", stamp)
    assert np.array_equal(one.covariance, other.covariance) if other.covariance is not None else True
    assert np.array_equal(
        window.twist("tool", "world", stamp).linear, buffer.twist("tool", "world", stamp).linear
    )


def assert_same_joint_states(archive: Archive, recording: Recording, start: int, end: int) -> None:
    found, whole = archive.joint_states("arm", start, end), recording.joint_states("arm")
    expected = whole.select(slice(*whole.stamps.searchsorted((start, end)).tolist()))
    assert len(expected)
    assert (found.joint_names, found.coordinates) == (expected.joint_names, expected.coordinates)
    for name in ("stamps", "positions", "velocities", "efforts"):
        one, other = getattr(found, name), getattr(expected, name)
        assert (one is None) == (other is None)
        assert one is None or np.array_equal(one, other, equal_nan=True)


@pytest.mark.parametrize("seed", [0, 1])
def test_lookups_equal_those_of_the_recording_though_clocks_were_set_back(tmp_path: Path, seed: int):
    wild(tmp_path / "r.mcap", seed)
    import_recording(str(tmp_path / "a"), tmp_path / "r.mcap")
    begin = START - 3600 * S
    stamps = np.random.default_rng(seed).integers(begin - S, begin + 7 * S, 100)
    archive = Archive(str(tmp_path / "a"))
    with Recording(tmp_path / "r.mcap", "arm") as recording:
        buffer = recording.buffer()
        for target, source in PAIRS:
            poses, valid = buffer.lookup_many(target, source, stamps)
            found, is_found = archive.lookup_many(target, source, stamps, robot="arm")
            assert np.array_equal(is_found, valid)
            assert np.array_equal(found, poses, equal_nan=True)
        assert_same_joint_states(archive, recording, begin - S, begin + 7 * S)


def test_lookups_equal_those_of_the_recording_across_dates_and_row_groups(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("zstate.archive.importer._MESSAGES", 37)
    monkeypatch.setattr("zstate.archive.layout._rows_per_group", lambda columns: 16)
    monkeypatch.setattr("zstate.archive.layout._GROUPS_PER_FILE", 4)
    monkeypatch.setattr("zstate.archive.archive._MAX_ROWS", 64)
    tour(tmp_path / "r.mcap", MIDNIGHT - 6 * S, MIDNIGHT + 6 * S)
    import_recording(str(tmp_path / "a"), tmp_path / "r.mcap")
    archive = Archive(str(tmp_path / "a"))
    dates = sorted(path.name for path in (tmp_path / "a" / "stream=joint_states" / "robot=arm").iterdir())
    assert dates == ["date=2023-11-14", "date=2023-11-15"]
    assert len(list((tmp_path / "a").rglob("stream=joint_states/**/*.parquet"))) > 2
    dice = np.random.default_rng(1)
    with Recording(tmp_path / "r.mcap", "arm") as recording:
        exact = np.arange(MIDNIGHT - S, MIDNIGHT + S, 20 * MS)
        stamps = np.concatenate((dice.integers(MIDNIGHT - 7 * S, MIDNIGHT + 7 * S, 300), exact))
        assert_same_lookups(archive, recording, stamps)
        assert_same_lookups(archive, recording, np.array([MIDNIGHT - MS, MIDNIGHT, MIDNIGHT + 5]))
        for start, end in [(MIDNIGHT - 2 * S, MIDNIGHT + S), (MIDNIGHT, MIDNIGHT + 19 * MS), (0, 2**62)]:
            assert_same_joint_states(archive, recording, start, end)


def test_lookups_equal_those_of_the_recording_after_an_import_in_parts(tmp_path: Path):
    begin, end = MIDNIGHT - 3 * S, MIDNIGHT + 3 * S
    tour(tmp_path / "whole.mcap", begin, end)
    edges = [begin, begin + S, MIDNIGHT + S, end]
    for number in (2, 0, 1):
        tour(tmp_path / f"{number}.mcap", edges[number], edges[number + 1])
        import_recording(str(tmp_path / "a"), tmp_path / f"{number}.mcap")
    archive = Archive(str(tmp_path / "a"))
    stamps = np.arange(begin - 10 * MS, end, 9 * MS)
    with Recording(tmp_path / "whole.mcap", "arm") as recording:
        assert_same_lookups(archive, recording, stamps)
        for stamp in (begin + S - 5 * MS, MIDNIGHT - 1, MIDNIGHT + S - 1):  # between two files
            assert_same_lookups(archive, recording, np.array([stamp, stamp + 1]))
        assert_same_joint_states(archive, recording, begin, end)
    assert [one.recording for one in archive.coverage("arm")] == ["0.mcap", "1.mcap", "2.mcap"]


def test_a_window_has_the_recordings_of_all_dates_from_its_first_to_its_last(tmp_path: Path):
    stamps = [MIDNIGHT + hours * 3600 * S for hours in range(6, 126, 12)]  # two a day
    for day in range(5):
        with RecordingBuilder(tmp_path / f"{day}.mcap", "arm") as builder:
            builder.describe("arm", at=stamps[2 * day])
            for stamp in stamps[2 * day : 2 * day + 2]:
                builder.joints("arm", stamp, swing_positions(stamp / 1e13))
        import_recording(str(tmp_path / "a"), tmp_path / f"{day}.mcap")
    archive = Archive(str(tmp_path / "a"))
    assert archive.joint_states("arm", stamps[0], stamps[-1] + 1).stamps.tolist() == stamps
    buffer = archive.buffer("arm", stamps[0], stamps[-1])
    expected, valid = archive.lookup_many("world", "tool", stamps, robot="arm")
    assert valid.all()
    assert np.array_equal(buffer.lookup_many("world", "tool", stamps)[0], expected)


def test_lookups_equal_those_of_a_bag_whose_nodes_share_an_edge(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("zstate.archive.importer._MESSAGES", 100)
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        bag.tf(START, [Transform.from_pose7("tool", "tip", pose(z=0.3))], topic="/tf_static")
        for n in range(600):
            stamp = START + n * 20 * MS
            bag.joints(stamp, dict(zip(("shoulder", "elbow"), swing_positions(n / 50), strict=True)))
            if n % 5 == 0:
                placed = Transform.from_pose7("odom", "world", pose(y=n / 50), stamp)
                bag.tf(stamp, [Transform.from_pose7("map", "odom", pose(n / 50, yaw=n / 99), stamp), placed])
            if n % 7 == 0:
                bag.tf(stamp, [Transform.from_pose7("odom", "world", pose(y=-n / 50), stamp + 3 * MS)])
    import_recording(str(tmp_path / "a"), tmp_path / "bag")
    archive = Archive(str(tmp_path / "a"))
    stamps = np.random.default_rng(0).integers(START - S, START + 13 * S, 200)
    with Recording(tmp_path / "bag", "ros") as recording:
        buffer = recording.buffer()
        for target, source in PAIRS:
            poses, valid = buffer.lookup_many(target, source, stamps)
            found, is_found = archive.lookup_many(target, source, stamps, robot="ros")
            assert valid.any()
            assert np.array_equal(is_found, valid)
            assert np.array_equal(found, poses, equal_nan=True)


def test_drivers_of_some_joints_each_are_interpolated_between_their_own_samples(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(100):
            one, two = swing_positions(n / 50)
            builder.part("arm", START + n * 20 * MS, {"shoulder": one}, "a", session=5, velocities=[one])
            builder.part("arm", START + n * 30 * MS, {"elbow": two}, "b", session=6)
    import_recording(str(tmp_path / "a"), tmp_path / "r.mcap")
    archive = Archive(str(tmp_path / "a"))
    stamps = np.arange(START - MS, START + 3 * S, 7 * MS)
    with Recording(tmp_path / "r.mcap", "arm") as recording:
        expected, valid = recording.lookup_many("world", "tool", stamps)
        found, is_found = archive.lookup_many("world", "tool", stamps, robot="arm")
        assert 200 < valid.sum() < len(valid)
        assert np.array_equal(is_found, valid)
        assert np.array_equal(found, expected, equal_nan=True)
        assert_same_joint_states(archive, recording, START, START + S)


def test_only_row_groups_around_the_stamps_are_read(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("zstate.archive.layout._rows_per_group", lambda columns: 16)
    tour(tmp_path / "r.mcap", MIDNIGHT - 6 * S, MIDNIGHT + 6 * S)
    import_recording(str(tmp_path / "a"), tmp_path / "r.mcap")
    archive = Archive(str(tmp_path / "a"))
    read: list[int] = []
    original = archive._files.read
    monkeypatch.setattr(
        archive._files,
        "read",
        lambda groups, columns=None: read.append(groups.rows) or original(groups, columns),
    )
    _, valid = archive.lookup_many("base", "tool", [MIDNIGHT - 3 * S + 1, MIDNIGHT + 3 * S + 1], robot="arm")
    assert valid.all()
    assert sum(read) <= 4 * 16  # of 600 rows


@pytest.mark.parametrize("offset", [-S, -1, 0, 1, 7 * MS, 13 * MS])
def test_few_stamps_give_the_poses_that_many_give(tmp_path: Path, offset: int):
    tour(tmp_path / "run.mcap", MIDNIGHT - 500 * MS, MIDNIGHT + 500 * MS)
    import_recording(str(tmp_path / "a"), tmp_path / "run.mcap")
    archive = Archive(str(tmp_path / "a"))
    few = np.arange(MIDNIGHT - 600 * MS, MIDNIGHT + 600 * MS, 200 * MS) + offset
    many = np.union1d(few, np.arange(MIDNIGHT - 600 * MS, MIDNIGHT + 600 * MS, MS))
    for target, source in PAIRS:
        poses, valid = archive.lookup_many(target, source, few, robot="arm")
        expected, known = archive.lookup_many(target, source, many, robot="arm")
        rows = many.searchsorted(few)
        assert np.array_equal(valid, known[rows])
        assert np.array_equal(poses, expected[rows], equal_nan=True)


def test_a_lookup_loads_no_module_that_takes_longer_than_it(tmp_path: Path):
    with RecordingBuilder(tmp_path / "run.mcap", "arm") as builder:
        builder.describe("arm", at=MIDNIGHT)
        for stamp in range(MIDNIGHT, MIDNIGHT + S, 20 * MS):
            builder.joints("arm", stamp, swing_positions(stamp / S))
    import_recording(str(tmp_path / "a"), tmp_path / "run.mcap")
    code = (
        "import sys, zstate; url, stamp = sys.argv[1:]\n"
        "assert zstate.Archive(url).lookup_many('world', 'tool', [int(stamp)], robot='arm')[1].all()\n"
        "print(*{name.partition('.')[0] for name in sys.modules})\n"
        "print(*(name for name in sys.modules if name.startswith('pyarrow.')))"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a"), str(MIDNIGHT + 10 * MS)]
    loaded = set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    assert "pyarrow.parquet" in loaded
    assert not loaded & {"pandas", "mcap", "duckdb", "pyarrow.dataset", "pyarrow.compute"}


def test_a_moved_camera_and_another_model_count_from_their_own_recording_on(tmp_path: Path):
    tour(tmp_path / "0.mcap", MIDNIGHT, MIDNIGHT + S, tip=0.1)
    tour(tmp_path / "1.mcap", MIDNIGHT + 2 * S, MIDNIGHT + 3 * S, tip=0.2)
    for name in ("1.mcap", "0.mcap"):
        import_recording(str(tmp_path / "a"), tmp_path / name)
    archive = Archive(str(tmp_path / "a"))
    stamps = [MIDNIGHT + 500 * MS, MIDNIGHT + 1500 * MS, MIDNIGHT + 2500 * MS]
    poses, valid = archive.lookup_many("world", "tip", stamps, robot="arm")
    assert valid.tolist() == [True, False, True]
    for number, row in ((0, 0), (1, 2)):
        with Recording(tmp_path / f"{number}.mcap", "arm") as recording:
            assert np.array_equal(recording.lookup_many("world", "tip", [stamps[row]])[0][0], poses[row])
    with pytest.raises(InvalidInput, match="change between"):
        archive.buffer("arm", stamps[0], stamps[2])


def test_messages_of_other_streams_come_back_as_they_were_recorded(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        for n in range(50):
            stamp = MIDNIGHT - S + (n * 40 + (n % 3) * 70) * MS  # some late ones
            message = Imu(stamp, n, 9, "imu_link", to_block([n, 2.0, 3.0]), to_block([0.0, 0.0, 9.81]))
            builder.encoder.write_message("r1", message, stamp + MS, "front")
        builder.describe("r1", at=START)
    import_recording(str(tmp_path / "a"), tmp_path / "r.mcap")
    archive = Archive(str(tmp_path / "a"))
    found = list(archive.messages("r1", "imu", 0, 2**62))
    with Recording(tmp_path / "r.mcap") as recording:
        expected: list[DecodedMessage] = list(recording.measurements("imu"))
    assert [(one.name, one.message, one.log_time) for one in found] == [
        (one.writer.edge_writer, one.message, one.log_time) for one in expected
    ]
    window = [one.message.stamp for one in archive.messages("r1", "imu", MIDNIGHT, MIDNIGHT + 200 * MS)]
    stamps = [one.message.stamp for one in expected]
    assert window == [stamp for stamp in stamps if MIDNIGHT <= stamp < MIDNIGHT + 200 * MS]


def test_a_window_becomes_a_recording_with_the_same_answers(tmp_path: Path):
    tour(tmp_path / "r.mcap", MIDNIGHT - 2 * S, MIDNIGHT + 2 * S)
    url, path = str(tmp_path / "a"), tmp_path / "window.mcap"
    import_recording(url, tmp_path / "r.mcap")
    start, end = MIDNIGHT - S, MIDNIGHT + S
    written = cut(url, path, "arm", start, end)
    assert written["joint_states"] == 101
    assert not [name for name in written if "not written" in name]
    stamps = np.arange(start + 100 * MS, end - 100 * MS, 3 * MS)
    with Recording(path) as window, Recording(tmp_path / "r.mcap", "arm") as recording:
        assert window.robots == ("arm",)
        assert_same_joint_states(Archive(url), window, start, end)
        for target, source in PAIRS:
            poses, valid = recording.lookup_many(target, source, stamps)
            found, is_found = window.lookup_many(target, source, stamps)
            assert valid.all()
            assert is_found.all()
            assert np.array_equal(found, poses)
        instant = int(stamps[7])
        one, other = (each.buffer().lookup("map", "world", instant) for each in (window, recording))
        assert one.covariance is None or np.array_equal(one.covariance, other.covariance)
    with pytest.raises(RecordingError, match="exists"):
        cut(url, path, "arm", start, end)
    with pytest.raises(InvalidInput, match="no recording"):
        cut(url, tmp_path / "x.mcap", "arm", start + DAY, end + DAY)


def test_unknown_robots_and_frames_and_empty_windows_are_named(tmp_path: Path):
    tour(tmp_path / "r.mcap", MIDNIGHT, MIDNIGHT + S)
    with pytest.raises(InvalidInput, match="its robots: none"):
        Archive(str(tmp_path / "a")).coverage("arm")
    import_recording(str(tmp_path / "a"), tmp_path / "r.mcap")
    archive = pickle.loads(pickle.dumps(Archive(str(tmp_path / "a"))))
    assert archive.robots() == ("arm",)
    with pytest.raises(InvalidInput, match=r"'leg'.*its robots: 'arm'"):
        archive.lookup_many("map", "tip", [MIDNIGHT], robot="leg")
    with pytest.raises(UnknownFrame, match="nowhere"):
        archive.lookup_many("map", "nowhere", [MIDNIGHT], robot="arm")
    with pytest.raises(InvalidInput, match="coverage"):
        archive.buffer("arm", MIDNIGHT - DAY, MIDNIGHT - DAY + S)
    with pytest.raises(InvalidInput, match="begins before its end"):
        archive.joint_states("arm", 2, 1)
    assert archive.lookup_many("map", "tip", [], robot="arm")[0].shape == (0, 7)


def test_simulated_time_has_no_date_and_is_refused(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(10):
            builder.joints("arm", 1000 * S + n, swing_positions(n), log_time=START + n * S)
    with pytest.raises(InvalidInput, match="simulated time has no date"):
        import_recording(str(tmp_path / "a"), tmp_path / "r.mcap")
    assert Archive(str(tmp_path / "a")).robots() == ()


def test_robots_of_one_recording_are_imported_together_without_the_edges_of_their_models(tmp_path: Path):
    given = next((joint.parent, joint.child) for joint in RRBOT.joints if joint.type != "fixed")
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        for robot in ("a", "b"):
            builder.describe(robot)
        for stamp in range(START, START + 2 * S, 20 * MS):
            for number, robot in enumerate(("a", "b")):
                angles = swing_positions((stamp - START) / S + number)
                builder.joints(robot, stamp, angles)
                builder.edges(robot, stamp, {given: pose(1.0)})
                builder.edges(
                    robot, stamp, {("odom", "world"): pose(angles[0])}, session=3, writer="odometry"
                )
    report = import_recording(str(tmp_path / "a"), tmp_path / "r.mcap")
    assert (report.robots, report.rows) == (["a", "b"], {"joint_states": 200, "transforms": 200})
    archive = Archive(str(tmp_path / "a"))
    stamps = np.arange(START, START + 2 * S, 7 * MS)
    for robot in archive.robots():
        with Recording(tmp_path / "r.mcap", robot) as recording:
            expected, valid = recording.lookup_many(f"{robot}/odom", f"{robot}/tool", stamps)
        assert valid.any()
        found, is_found = archive.lookup_many(f"{robot}/odom", f"{robot}/tool", stamps, robot=robot)
        assert np.array_equal(is_found, valid)
        assert np.array_equal(found, expected, equal_nan=True)


def test_parts_of_a_split_recording_are_added_once_each_whichever_is_named(tmp_path: Path):
    dice = np.random.default_rng(1)
    with RecordingBuilder(tmp_path / "r.mcap", "arm", max_bytes=1 << 16) as builder:
        builder.describe("arm")
        for stamp in range(START, START + 30 * S, 10 * MS):
            builder.joints("arm", stamp, dice.uniform(-1.0, 1.0, 2), dice.uniform(-1.0, 1.0, 2))
    parts = sorted(tmp_path.glob("*.mcap"))
    assert len(parts) > 1
    url = str(tmp_path / "a")
    assert not import_recording(url, tmp_path / "r_1.mcap").is_known
    assert not import_recording(url, tmp_path / "r.mcap").is_known
    assert all(import_recording(url, part).is_known for part in parts)
    archive = Archive(url)
    assert [one.recording for one in archive.coverage("arm")] == [
        "r.mcap",
        *(f"r_{number}.mcap" for number in range(1, len(parts))),
    ]
    with Recording(tmp_path / "r.mcap", "arm") as recording:
        stamps = np.arange(START, START + 30 * S, 123 * MS)
        expected, _ = recording.lookup_many("world", "tool", stamps)
    assert np.array_equal(
        archive.lookup_many("world", "tool", stamps, robot="arm")[0], expected, equal_nan=True
    )
