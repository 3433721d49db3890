"""RecordReader: order, choice, other writers' files, and files that are none."""

from __future__ import annotations

import random
import sqlite3
import struct
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from helpers.processes import Child
from helpers.recording_files import (
    DESCRIPTION,
    MS,
    START,
    STORE,
    S,
    declare_channels,
    joint_states,
    write_run,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import Reader as RosbagReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from zstate.recording.errors import RecordingError
from zstate.recording.info import read_info
from zstate.recording.mcap.records import MAX_CHUNK_BYTES
from zstate.recording.mcap.recover import recover
from zstate.recording.mcap.writer import RecordingWriter
from zstate.recording.reader import RecordingReader

MAGIC = b"\x89MCAP0\r\n"


def payloads(path: Path, **choice: object) -> list[bytes]:
    with RecordingReader(path) as reader:
        return [record.payload for record in reader.records(**choice)]


def test_records_come_by_log_time_across_chunks_with_their_contents(tmp_path: Path):
    states = joint_states(100)
    mixed = random.Random(1).sample(states, len(states))
    write_run(tmp_path / "run.mcap", mixed, flush_every=7)
    with RecordingReader(tmp_path / "run.mcap") as reader:
        first, *records = reader.records()
        assert reader.span == (START, states[-1][0])
        assert (reader.complete, reader.losses, reader.skipped) == (True, (), ())
        assert [(c.topic, c.count) for c in reader.channels()] == [
            ("/robot_description", 1),
            ("/joint_states", 100),
        ]
    assert (first.topic, first.payload) == ("/robot_description", DESCRIPTION)
    assert [(r.log_time, r.payload) for r in records] == states
    assert [r.sequence for r in records] == [mixed.index(state) for state in states]
    assert {(r.topic, r.type_name) for r in records} == {("/joint_states", "sensor_msgs/msg/JointState")}
    assert {r.log_time - r.publish_time for r in records} == {MS}
    assert {r.metadata["zstate.robot"] for r in records} == {"panda"}


def test_records_of_one_instant_keep_the_order_of_the_file(tmp_path: Path):
    with RecordingWriter(tmp_path / "run.mcap") as writer:
        described, joints = declare_channels(writer)
        for number in range(9):
            writer.write((described, joints)[number % 2], bytes([number]), START, START)
            if number == 4:
                writer.flush()
    assert payloads(tmp_path / "run.mcap") == [bytes([number]) for number in range(9)]


@given(begin=st.integers(-2, 22), end=st.integers(-2, 22))
@settings(max_examples=40)
def test_interval_is_half_open(whole: Path, begin: int, end: int):
    expected = [bytes([number]) for number in range(20) if begin <= number < end]
    assert payloads(whole, begin=START + begin, end=START + end) == expected


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A message each nanosecond, the number of it as payload."""
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    with RecordingWriter(path) as writer:
        _, joints = declare_channels(writer)
        for number in range(20):
            writer.write(joints, bytes([number]), START + number, START)
            if number % 4 == 3:
                writer.flush()
    return path


def test_topics_are_selected_by_name(tmp_path: Path):
    write_run(tmp_path / "run.mcap", joint_states(5))
    assert payloads(tmp_path / "run.mcap", topics=["/robot_description"]) == [DESCRIPTION]
    assert payloads(tmp_path / "run.mcap", topics=["/unknown"]) == []
    assert payloads(tmp_path / "run.mcap", topics=[]) == []


def test_chunks_outside_the_interval_are_not_read(whole: Path, tmp_path: Path):
    data = bytearray(whole.read_bytes())
    first_chunk = data.index(b"\x04\x00\x00\x00zstd")
    data[first_chunk + 30] ^= 0xFF
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    assert payloads(path, begin=START + 4) == [bytes([number]) for number in range(4, 20)]
    with pytest.raises(RecordingError, match="`zstate recover` saves"):
        payloads(path)


def test_empty_recording_has_no_span(tmp_path: Path):
    with RecordingWriter(tmp_path / "run.mcap") as writer:
        declare_channels(writer)
    with RecordingReader(tmp_path / "run.mcap") as reader:
        assert (reader.span, list(reader.records()), reader.complete) == (None, [], True)


def test_split_files_are_read_as_one_and_separately(tmp_path: Path):
    states = joint_states(500)
    write_run(tmp_path / "run.mcap", states, max_seconds=2.0)
    with RecordingReader(tmp_path / "run.mcap") as reader:
        assert [r.payload for r in reader.records(["/joint_states"])] == [payload for _, payload in states]
        assert {channel.topic: channel.count for channel in reader.channels()} == {
            "/robot_description": 3,
            "/joint_states": 500,
        }
        assert reader.span == (START, states[-1][0])
        assert reader.complete
    alone = payloads(tmp_path / "run_1.mcap")
    assert alone == [DESCRIPTION, *(payload for _, payload in states[200:400])]


def test_files_of_an_older_recording_with_that_name_are_ignored(tmp_path: Path):
    write_run(tmp_path / "run.mcap", joint_states(500), max_seconds=2.0)
    write_run(tmp_path / "run.mcap", joint_states(300), max_seconds=2.0, overwrite=True)
    assert (tmp_path / "run_2.mcap").exists()
    assert len(payloads(tmp_path / "run.mcap", topics=["/joint_states"])) == 300


def test_missing_part_is_reported(tmp_path: Path):
    write_run(tmp_path / "run.mcap", joint_states(500), max_seconds=2.0)
    (tmp_path / "run_1.mcap").unlink()
    with RecordingReader(tmp_path / "run.mcap") as reader:
        assert reader.losses == ("run_1.mcap is missing",)
        assert not reader.complete
        assert len(list(reader.records(["/joint_states"]))) == 300


def rosbag(path: Path, storage: StoragePlugin, version: int) -> list[tuple[str, int, bytes]]:
    """A bag of rosbags, and what its own reader reads in it."""
    with RosbagWriter(path, version=version, storage_plugin=storage) as writer:
        joints = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=STORE)
        text = writer.add_connection("/robot_description", "std_msgs/msg/String", typestore=STORE)
        writer.write(text, START, DESCRIPTION)
        for stamp, payload in random.Random(2).sample(joint_states(200), 200):
            writer.write(joints, stamp, payload)
    with RosbagReader(path) as reader:
        return [(c.topic, stamp, bytes(raw)) for c, stamp, raw in reader.messages()]


@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_ros_2_bag_is_read_as_rosbags_reads_it(tmp_path: Path, storage: StoragePlugin, version: int):
    expected = rosbag(tmp_path / "bag", storage, version)
    (file,) = (file for file in (tmp_path / "bag").iterdir() if file.suffix != ".yaml")
    for path in (tmp_path / "bag", file):
        with RecordingReader(path) as reader:
            read = [(r.topic, r.log_time, r.payload) for r in reader.records()]
            types = {channel.topic: channel.type_name for channel in reader.channels()}
            counts = {channel.topic: channel.count for channel in reader.channels()}
            assert reader.complete
            assert reader.span == (START, START + 199 * 10 * MS)
            window = [r.log_time for r in reader.records(["/joint_states"], START + S // 2, START + S)]
        assert sorted(read) == sorted(expected)
        assert [stamp for _, stamp, _ in read] == sorted(stamp for _, stamp, _ in read)
        assert types["/joint_states"] == "sensor_msgs/msg/JointState"
        assert counts == {"/joint_states": 200, "/robot_description": 1}
        assert all(channel.metadata for channel in reader.channels())
        assert window == [START + S // 2 + number * 10 * MS for number in range(50)]


def test_reading_leaves_a_bag_unchanged(tmp_path: Path):
    rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, 9)
    before = {file.name: file.read_bytes() for file in (tmp_path / "bag").iterdir()}
    (tmp_path / "bag").chmod(0o555)
    with RecordingReader(tmp_path / "bag") as reader:
        list(reader.records())
    (tmp_path / "bag").chmod(0o755)
    assert {file.name: file.read_bytes() for file in (tmp_path / "bag").iterdir()} == before


def test_records_in_the_sqlite_journal_are_read(tmp_path: Path):
    rosbag(tmp_path / "bag", StoragePlugin.SQLITE3, 9)
    (database,) = (tmp_path / "bag").glob("*.db3")
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA wal_autocheckpoint=0")
        connection.execute(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", (START - 1, b"x")
        )
        connection.commit()
        copy = tmp_path / "copy.db3"
        for ending in ("", "-wal"):
            copy.with_name(copy.name + ending).write_bytes(
                database.with_name(database.name + ending).read_bytes()
            )
    assert payloads(copy)[0] == b"x"


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"use_statistics": False},
        {"repeat_channels": False},
        {
            "repeat_channels": False,
            "repeat_schemas": False,
            "use_statistics": False,
            "use_summary_offsets": False,
        },
        {"enable_crcs": False},
        {"enable_data_crcs": True},
    ],
    ids=str,
)
def test_every_variant_that_mcap_writes_is_read(tmp_path: Path, options: dict[str, object]):
    path, states = tmp_path / "run.mcap", joint_states(300)
    mixed = random.Random(3).sample(states, len(states))
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=5000, **options)
        writer.start("ros2", "another library")
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        channel = writer.register_channel("/joint_states", "cdr", schema)
        writer.add_attachment(0, 0, "note", "text/plain", b"hello")
        for stamp, payload in mixed:
            writer.add_message(channel, stamp, payload, stamp)
        writer.finish()
    with RecordingReader(path) as reader:
        assert [(r.log_time, r.payload) for r in reader.records()] == states
        assert [(c.type_name, c.count) for c in reader.channels()] == [("sensor_msgs/msg/JointState", 300)]
        assert reader.span == (START, states[-1][0])
        assert (reader.complete, reader.losses) == (True, ())


def test_non_cdr_channels_are_skipped_and_listed(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        json = writer.register_channel("/json", "json", 0)
        cdr = writer.register_channel("/cdr", "cdr", 0)
        writer.add_message(json, 1, b"{}", 1)
        writer.add_message(cdr, 2, b"yes", 2)
        writer.finish()
    with RecordingReader(path) as reader:
        assert [(c.topic, c.encoding, c.count) for c in reader.skipped] == [("/json", "json", 1)]
        assert [r.payload for r in reader.records()] == [b"yes"]


@pytest.mark.parametrize(
    ("beginning", "reason"),
    [
        (b"", "is empty"),
        (MAGIC[:5], "is cut off within its first 8 bytes"),
        (MAGIC, "is damaged: the file ends within a record"),
        (b"#ROSBAG V2.0\n", "a bag of ROS 1: `rosbags-convert`"),
        (b"\x28\xb5\x2f\xfd....", "`zstd -d` unpacks it"),
        (b"\x1f\x8b....", "`gunzip`"),
        (b"rosbag2_bagfile_information:\n", "name its folder"),
        (b"SQLite format 3\0" + bytes(100), "cannot be read as a rosbag2 database"),
        (b"hello world, hello", "is not a recording: it begins with b'hello world,'"),
    ],
)
def test_other_file_is_refused_with_its_recognised_format(tmp_path: Path, beginning: bytes, reason: str):
    path = tmp_path / "run.mcap"
    path.write_bytes(beginning)
    with pytest.raises(RecordingError) as caught:
        RecordingReader(path)
    assert reason in str(caught.value)
    assert str(path) in str(caught.value)
    assert caught.value.path == str(path)


def test_other_database_is_refused(tmp_path: Path):
    with closing(sqlite3.connect(tmp_path / "other.db3")) as connection:
        connection.execute("CREATE TABLE cats (name TEXT)")
        connection.commit()
    with pytest.raises(RecordingError, match="no such table: messages"):
        RecordingReader(tmp_path / "other.db3")


def test_missing_file_error_says_so(tmp_path: Path):
    with pytest.raises(RecordingError, match="No such file"):
        RecordingReader(tmp_path / "nothing.mcap")


def test_closed_reader_reads_nothing(tmp_path: Path):
    write_run(tmp_path / "run.mcap", [])
    reader = RecordingReader(tmp_path / "run.mcap")
    reader.close()
    reader.close()
    with pytest.raises(RecordingError, match="is closed"):
        reader.records()


def read_all(path: Path) -> None:
    """Everything that can be asked of a file, which may fail in one way only."""
    with suppress(RecordingError):
        read_info(path)
    with suppress(RecordingError), RecordingReader(path) as reader:
        for record in reader.records():
            assert isinstance(record.payload, bytes)
    with suppress(RecordingError):
        recover(path, path.with_name("recovered.mcap"), overwrite=True)


@given(st.binary(max_size=300), st.sampled_from([b"", MAGIC, b"SQLite format 3\0"]))
@settings(max_examples=150, deadline=None)
def test_random_bytes_are_refused_or_read_without_crash(scratch: Path, data: bytes, magic: bytes):
    scratch.write_bytes(magic + data)
    read_all(scratch)


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scratch") / "run.mcap"


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """Small recordings of all kinds."""
    folder = tmp_path_factory.mktemp("originals")
    write_run(folder / "ours.mcap", joint_states(12), flush_every=4)
    rosbag(folder / "bag", StoragePlugin.SQLITE3, 9)
    stream = BytesIO()
    writer = Writer(stream, use_chunking=False)
    writer.start("ros2")
    channel = writer.register_channel("/a", "cdr", writer.register_schema("t", "ros2msg", b""))
    for number in range(9):
        writer.add_message(channel, number, b"payload", number)
    writer.finish()
    return [
        (folder / "ours.mcap").read_bytes(),
        next((folder / "bag").glob("*.db3")).read_bytes(),
        stream.getvalue(),
    ]


@given(
    kind=st.integers(0, 2),
    edits=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=6),
    end=st.floats(0.3, 1),
)
@settings(max_examples=300, deadline=None)
@pytest.mark.long
def test_damage_anywhere_is_refused_or_read_without_crash(
    scratch: Path, originals: list[bytes], kind: int, edits: list[tuple[float, int]], end: float
):
    data = bytearray(originals[kind])
    for place, value in edits:
        data[int(place * len(data))] = value
    scratch.write_bytes(data[: int(end * len(data))])
    read_all(scratch)


def a_chunk(compression: str, content: bytes, size: int) -> bytes:
    """An MCAP file that is not closed, with one chunk that states ``size`` bytes."""
    word = compression.encode()
    body = struct.pack("<QQQII", 1, 1, size, 0, len(word)) + word + struct.pack("<Q", len(content)) + content
    header = struct.pack("<I", 0) * 2
    return b"".join(
        [MAGIC, struct.pack("<BQ", 1, len(header)), header, struct.pack("<BQ", 6, len(body)), body]
    )


BOMB = (1 << 28) + 1000


@pytest.mark.parametrize(
    ("compression", "stated", "reason"),
    [
        ("zstd", 1 << 40, f"states {1 << 40} bytes; at most {MAX_CHUNK_BYTES} are read at once"),
        ("lz4", 1 << 40, f"states {1 << 40} bytes; at most {MAX_CHUNK_BYTES} are read at once"),
        ("zstd", 1000, "a chunk and its zstd frame that disagree on their size"),
        ("lz4", 1000, "states 1000 bytes with a larger or truncated lz4 frame"),
    ],
)
def test_chunk_that_decompresses_without_bounds_is_refused(
    tmp_path: Path, compression: str, stated: int, reason: str
):
    """A quarter of a gigabyte of zeros, whose chunk states a larger or smaller size.

    Of one that is cut off the beginning is read, of the stated size and at most MAX_CHUNK_BYTES.
    """
    zeros = bytes(BOMB)
    packed = zstandard.compress(zeros) if compression == "zstd" else lz4.frame.compress(zeros)
    (tmp_path / "bomb.mcap").write_bytes(a_chunk(compression, packed, stated))
    (tmp_path / "cut.mcap").write_bytes(a_chunk(compression, packed, stated)[:-1000])
    del zeros
    code = """
        import sys
        from pathlib import Path
        from zstate.recording.reader import RecordingReader
        def peak():
            # Not ru_maxrss, which begins with that of the process that started this one.
            (line,) = (line for line in open("/proc/self/status") if line.startswith("VmHWM"))
            return int(line.split()[1]) * 1024
        before = peak()
        for name in ("bomb.mcap", "cut.mcap"):
            with RecordingReader(Path(sys.argv[1]) / name) as reader:
                print(reader.losses)
                print(peak() - before)
    """
    child = Child(code, str(tmp_path), is_forked=False)
    (bomb, bomb_bytes), (cut, cut_bytes) = [(child.line(60.0), int(child.line(60.0))) for _ in range(2)]
    assert child.wait() == 0
    assert reason in bomb
    assert "the file is cut off there" in cut
    assert bomb_bytes < BOMB / 4
    assert cut_bytes < BOMB / 4 + 3 * min(stated, MAX_CHUNK_BYTES)  # the decoder's buffers and the result


def test_view_instead_of_a_table_is_refused(tmp_path: Path):
    """It may have rows without end."""
    path = tmp_path / "endless.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
            "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
        )
    with pytest.raises(RecordingError, match="'messages' is a view"):
        RecordingReader(path)


def test_query_that_takes_too_long_for_the_file_size_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "bag.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        rows = ((number, 1, number, b"") for number in range(20_000))
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
        database.commit()
    with RecordingReader(path) as reader:
        assert reader.span == (0, 19_999)
    monkeypatch.setattr("zstate.recording.reader._STEPS", 0)
    monkeypatch.setattr("zstate.recording.reader._STEPS_PER_BYTE", 0)
    with pytest.raises(RecordingError, match="took more than 0 steps"):
        RecordingReader(path)
