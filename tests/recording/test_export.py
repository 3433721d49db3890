"""A recording as a table: the same numbers as its arrays and lookups, one row for each instant."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.recording_builder import (
    MS,
    RRBOT,
    START,
    Bag,
    RecordingBuilder,
    S,
    pose,
    swing_positions,
    swing_velocities,
)

from zstate.errors import InvalidInput, LibraryMissing, UnknownFrame
from zstate.model.urdf import parse_urdf
from zstate.recording.errors import RecordingError
from zstate.recording.export import Exporter, ExportReport, StreamedBuffer
from zstate.recording.recording import Recording
from zstate.wire.messages import JointState, order_digest, to_block

COUNT = 500
SHORT = 200
"""Samples of a recording that tests read again and again; windows are still a fraction of it."""
POSITIONS = [f"position.{name}" for name in RRBOT.joint_names]
VELOCITIES = [f"velocity.{name}" for name in RRBOT.joint_names]
EFFORTS = [f"effort.{name}" for name in RRBOT.joint_names]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The swinging "arm" for 5 s at 100 Hz, on a base that moves from the second second on."""
    path = tmp_path / "run.mcap"
    with RecordingBuilder(path) as builder:
        builder.describe("arm")
        for n in range(COUNT):
            stamp = START + n * 10 * MS
            builder.joints("arm", stamp, swing_positions(n / 100), swing_velocities(n / 100))
            if n >= 100:
                builder.edges("arm", stamp, {("odom", "arm/world"): pose(n / 100)})
    return path


def export(run: Path, kind: str = "csv", **options: object) -> tuple[dict[str, list[float]], ExportReport]:
    """The columns of the written table, and the report."""
    output = run.with_suffix(f".{kind}")
    with Recording(run) as recording:
        report = Exporter(recording, **options).write(output, kind)
    assert not list(run.parent.glob("*.part"))
    if kind == "parquet":
        parquet = pytest.importorskip("pyarrow.parquet", reason="pip install 'zstate[export]'")
        return parquet.read_table(output).to_pydict(), report
    with output.open(newline="") as file:
        names, *rows = csv.reader(file)
    columns = zip(*rows, strict=True)
    types = (int if name == "stamp" else float for name in names)
    return {
        name: list(map(kind, column)) for name, kind, column in zip(names, types, columns, strict=True)
    }, report


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_table_has_the_recorded_numbers_bit_by_bit(run: Path, kind: str):
    columns, report = export(run, kind)
    assert list(columns) == ["stamp", *POSITIONS, *VELOCITIES]
    assert columns["stamp"] == [START + n * 10 * MS for n in range(COUNT)]
    for number in range(2):
        assert columns[POSITIONS[number]] == [swing_positions(n / 100)[number] for n in range(COUNT)]
        assert columns[VELOCITIES[number]] == [swing_velocities(n / 100)[number] for n in range(COUNT)]
    assert (report.rows, report.joint_count, report.kinds) == (COUNT, 2, ("position", "velocity"))
    assert (report.first, report.last) == (START, START + (COUNT - 1) * 10 * MS)


def test_rate_gives_a_grid_from_the_first_sample_to_the_last(run: Path):
    columns, report = export(run, rate_hz=300.0)
    # 4.99 s, both ends included.
    assert report.rows == 1497 + 1
    assert columns["stamp"] == [START + round(n * 1e9 / 300.0) for n in range(1498)]
    assert list(columns) == ["stamp", *POSITIONS]
    with Recording(run) as recording:
        buffer = recording.buffer()
    for row in (0, 1, 777, 1497):
        positions, _ = buffer.joint_positions("arm", columns["stamp"][row])
        assert [columns[name][row] for name in POSITIONS] == positions.tolist()


def test_stamps_may_be_in_any_order_and_rows_outside_of_the_recording_are_nan(run: Path):
    stamps = np.array([START + 2 * S, START + S + 3 * MS, START - 1, START + 10 * S])
    columns, report = export(run, "parquet", stamps=stamps)
    assert columns["stamp"] == stamps.tolist()
    assert np.isnan(columns[POSITIONS[0]]).tolist() == [False, False, True, True]
    first, second = swing_positions(1.0)[0], swing_positions(1.01)[0]
    assert columns[POSITIONS[0]][1] == pytest.approx(first + 0.3 * (second - first), abs=1e-12)
    assert report.unknown_joints == 2
    assert (report.first, report.last) == (START - 1, START + 10 * S)


@pytest.mark.parametrize("options", [{}, {"rate_hz": 100.0}])
def test_poses_are_the_lookups_at_the_same_rows(run: Path, options: dict[str, object]):
    columns, report = export(run, poses=[("odom", "arm/tool")], **options)
    with Recording(run) as recording:
        expected, valid = recording.lookup_many("odom", "arm/tool", columns["stamp"])
    found = np.array([columns[f"odom.arm/tool.{name}"] for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]).T
    np.testing.assert_array_equal(found, expected)
    assert (~valid).sum() == report.unknown_poses["odom", "arm/tool"] == 100
    assert ("velocity.shoulder" in columns) == (not options)


@pytest.fixture
def small_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows of a fraction of a second, in recordings of some seconds."""
    for name, value in {"_ROWS": 37, "_RELOADED_ROWS": 200, "DELAYED_NS": 100 * MS}.items():
        monkeypatch.setattr(f"zstate.recording.export.{name}", value)


def swing(builder: RecordingBuilder, numbers: range, offset: int = 0, **options: int) -> None:
    """The swinging "arm" at 100 Hz on a base that moves at 50 Hz; ``offset`` [ns] of stamps to log times."""
    for n in numbers:
        at = START + n * 10 * MS
        joints = swing_positions(n / 100), swing_velocities(n / 100)
        builder.joints("arm", at + offset, *joints, log_time=at, **options)
        if not n % 2:
            builder.edges("arm", at + offset, {("odom", "world"): pose(n / 100)}, log_time=at, **options)


def new_model(builder: RecordingBuilder) -> None:
    """A writer with another model replaces the first."""
    urdf = RRBOT.urdf.replace('xyz="0 0', 'xyz="1 0')
    builder.describe("arm", parse_urdf(urdf, "moved"), 2, START + SHORT * 10 * MS)
    swing(builder, range(SHORT, SHORT + 100), session=2)


def base_on_a_map(builder: RecordingBuilder) -> None:
    """The base is placed in a map from now on, by a writer that replaced the first."""
    for n in range(SHORT, SHORT + 100):
        builder.edges("arm", START + n * 10 * MS, {("map", "world"): pose(n / 100)}, session=9)
        builder.edges("arm", START + n * 10 * MS, {("odom", "map"): pose(y=n)}, session=8)


LATER: dict[str, Callable[[RecordingBuilder], None]] = {
    "nothing": lambda builder: None,
    "more": lambda builder: swing(builder, range(SHORT, 2 * SHORT)),
    "gap": lambda builder: swing(builder, range(3 * SHORT, 4 * SHORT)),
    "clock set back": lambda builder: swing(builder, range(SHORT, 2 * SHORT), -1600 * MS, session=7),
    "clock set back by an hour": lambda builder: swing(builder, range(SHORT, 2 * SHORT), -3600 * S),
    "late sample": lambda builder: builder.edges(
        "arm", START + S + MS, {("odom", "world"): pose(7)}, log_time=START + SHORT * 10 * MS
    ),
    "late static edge": lambda builder: builder.statics(
        "arm", START + SHORT * 10 * MS, {("tool", "tip"): pose(z=3)}
    ),
    "frame on another": base_on_a_map,
    "new model": new_model,
}


@pytest.mark.parametrize("options", [{}, {"rate_hz": 131.0}])
@pytest.mark.parametrize("later", LATER)
@pytest.mark.usefixtures("small_windows")
def test_rows_are_lookups_in_the_whole_recording(tmp_path: Path, later: str, options: dict[str, float]):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        builder.statics("arm", START, {("tool", "tip"): pose(z=1)})
        swing(builder, range(SHORT))
        LATER[later](builder)
    pairs = [("arm/odom", "arm/tip"), ("arm/world", "arm/tool")]
    columns, report = export(tmp_path / "r.mcap", "parquet", poses=pairs, **options)
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
        samples = recording.joint_states().stamps
    stamps = np.array(columns["stamp"])
    if options:
        assert (stamps[0], stamps[-1] // S) == (samples[0], samples[-1] // S)
        positions, _ = buffer.joint_positions_many("arm", stamps)
        assert np.array_equal(np.array([columns[name] for name in POSITIONS]).T, positions, equal_nan=True)
    else:
        assert stamps.tolist() == samples.tolist()
    for pair in pairs:
        names = [f"{'.'.join(pair)}.{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
        expected, valid = buffer.lookup_many(*pair, stamps)
        assert np.array_equal(np.array([columns[name] for name in names]).T, expected, equal_nan=True)
        assert report.unknown_poses[pair] == (~valid).sum()
        assert valid.sum() > 10


@pytest.mark.usefixtures("small_windows")
@pytest.mark.long
def test_buffer_holds_the_samples_around_one_window(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        swing(builder, range(10 * COUNT))
    stamps = START + np.arange(10 * COUNT) * 10 * MS
    with Recording(tmp_path / "r.mcap") as recording:
        streamed = StreamedBuffer(recording, "arm", [("odom", "arm/tool")], stamps)
        counts: list[int] = []
        for first in range(0, len(stamps), 50):
            frames = streamed.around(stamps[first : first + 50]).frames()
            counts.append(max(frame.count for frame in frames))
        streamed.finish()
    # 50 rows, 10 samples until none is late, what one more read adds, and the ends of the history.
    assert max(counts) <= 50 + 10 + 37 + 2


def test_later_velocities_and_efforts_have_columns_in_all_rows(tmp_path: Path):
    count = 15_000
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        for n in range(count):
            numbers = to_block([n, n])
            velocities, efforts = (numbers if n >= first else None for first in (8_000, 14_000))
            digest = order_digest(RRBOT.joint_names)
            state = JointState(START + n * 10 * MS, n, 1, digest, numbers, velocities, efforts)
            builder.encoder.write_message("arm", state, state.stamp)
    columns, report = export(tmp_path / "r.mcap", "parquet")
    assert list(columns) == ["stamp", *POSITIONS, *VELOCITIES, *EFFORTS]
    assert report.rows == len(columns["stamp"]) == count
    for names, first in ((VELOCITIES, 8_000), (EFFORTS, 14_000)):
        column = np.array(columns[names[0]])
        assert np.isnan(column[:first]).all()
        assert column[first:].tolist() == list(range(first, count))


def test_table_begins_again_with_the_history_after_a_clock_was_set_back(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        for n in range(9_000):
            builder.joints("arm", START + n * 10 * MS, [n, n], [0.0, 0.0], log_time=START + n * MS)
        for n in range(3):
            builder.joints("arm", START - S + n * MS, [n, n], session=2, log_time=START + (9_000 + n) * MS)
    for kind in ("csv", "parquet"):
        columns, report = export(tmp_path / "r.mcap", kind)
        assert columns["stamp"] == [START - S + n * MS for n in range(3)]
        assert list(columns) == ["stamp", *POSITIONS]
        assert report.rows == 3


def test_output_is_never_the_recording_and_replaced_only_on_request(run: Path):
    output = run.with_suffix(".csv")
    output.write_text("precious")
    recorded = run.read_bytes()
    with Recording(run) as recording:
        exporter = Exporter(recording)
        with pytest.raises(RecordingError, match="exists"):
            exporter.write(output, "csv")
        with pytest.raises(RecordingError, match="is the recording"):
            exporter.write(run, "csv", overwrite=True)
        with pytest.raises(UnknownFrame):
            Exporter(recording, poses=[("odom", "hand")]).write(output, "csv", overwrite=True)
        assert output.read_text() == "precious"
        exporter.write(output, "csv", overwrite=True)
    assert output.read_text().startswith("stamp,")
    assert run.read_bytes() == recorded
    assert not list(run.parent.glob("*.part"))


def test_recording_without_a_usable_sample_is_refused_with_the_reasons(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
        builder.joints("arm", START, [np.nan, 0.0])
    with Recording(tmp_path / "r.mcap") as recording, pytest.raises(InvalidInput, match="bad numbers 1"):
        Exporter(recording).write(tmp_path / "r.csv", "csv")
    assert not (tmp_path / "r.csv").exists()


def test_robot_without_a_model_is_exported_as_recorded_only(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.joints(START, {"left": 0.25}, "/gripper/joint_states")
    columns, _ = export(tmp_path / "bag")
    assert columns == {"stamp": [START], "position.left": [0.25]}
    with Recording(tmp_path / "bag") as recording, pytest.raises(InvalidInput, match="robot_description"):
        Exporter(recording, rate_hz=10.0)


def test_parquet_without_pyarrow_names_the_extra(run: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with Recording(run) as recording, pytest.raises(LibraryMissing, match=r"pip install 'zstate\[export\]'"):
        Exporter(recording).write(run.with_suffix(".parquet"), "parquet")


def test_rows_of_several_drivers_are_the_samples_that_all_of_them_cover(tmp_path: Path):
    path = tmp_path / "drivers.mcap"
    shoulder, elbow = RRBOT.joint_names
    with RecordingBuilder(path) as builder:
        builder.describe("arm")
        for n in range(4):
            builder.part("arm", START + n * 20 * MS, {shoulder: float(n)}, "lower", session=4)
            builder.part("arm", START + n * 20 * MS + 10 * MS, {elbow: -float(n)}, "upper", session=5)
    columns, report = export(path)
    # From the elbow's first sample, 10 ms after the shoulder's, to the shoulder's last.
    assert columns["stamp"] == [START + n * 10 * MS for n in range(1, 7)]
    assert columns[POSITIONS[0]] == pytest.approx([0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
    assert columns[POSITIONS[1]] == pytest.approx([0.0, -0.5, -1.0, -1.5, -2.0, -2.5])
    assert (report.rows, report.kinds) == (6, ("position",))
    path.with_suffix(".csv").unlink()
    grid, _ = export(path, rate_hz=100.0, poses=[("world", RRBOT.links[-1])])
    assert {name: grid[name] for name in columns} == columns
