"""RecordWriter: what other programs read in its files, what a kill leaves, and what a full disk does."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.processes import Child
from helpers.recording_files import (
    DESCRIPTION,
    LATCHED,
    MS,
    START,
    STORE,
    S,
    declare_channels,
    joint_states,
    string_bytes,
    write_run,
)
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from zstate.errors import InvalidInput
from zstate.recording.errors import RecordingError
from zstate.recording.mcap.index import Summary
from zstate.recording.mcap.records import BoundedFile
from zstate.recording.mcap.writer import MIN_BYTES, RecordingWriter
from zstate.recording.reader import RecordingReader
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.types import JOINT_STATE, STRING


def in_file_order(path: Path) -> list[tuple[str, bytes]]:
    """Topics and payloads by mcap's own reader, which needs neither an index nor an end."""
    with path.open("rb") as stream:
        messages = []
        try:
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                messages.append((channel.topic, message.data))
        except Exception:  # the error of mcap at the end of a cut file
            pass
    return messages


def test_rosbags_reads_every_message_as_written(tmp_path: Path):
    states = joint_states(120)
    write_run(tmp_path / "run.mcap", states)
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        read = [(c.topic, c.msgtype, stamp, bytes(raw)) for c, stamp, raw in reader.messages()]
        decoded = [
            reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if "joint" in c.topic
        ]
    expected = [("/joint_states", "sensor_msgs/msg/JointState", *state) for state in states]
    assert read == [("/robot_description", "std_msgs/msg/String", START, DESCRIPTION), *expected]
    known = [STORE.deserialize_cdr(payload, "sensor_msgs/msg/JointState") for _, payload in states]
    assert [list(m.position) for m in decoded] == [list(m.position) for m in known]


def test_mcap_ros2_support_decodes_by_the_schemas_in_the_file(tmp_path: Path):
    states = joint_states(20)
    write_run(tmp_path / "run.mcap", states)
    with (tmp_path / "run.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        header, decoded = reader.get_header(), list(reader.iter_decoded_messages())
    assert header.profile == "ros2"
    assert header.library.startswith("zstate ")
    assert decoded[0].decoded_message.data == "<robot name='r'/>"
    for (stamp, payload), (schema, channel, message, seen) in zip(states, decoded[1:], strict=True):
        known = STORE.deserialize_cdr(payload, "sensor_msgs/msg/JointState")
        assert list(seen.position) == list(known.position)
        assert seen.name == known.name
        assert (message.log_time, message.publish_time) == (stamp, stamp - MS)
        assert schema and (schema.name, schema.encoding) == (JOINT_STATE.name, "ros2msg")
        assert channel.message_encoding == "cdr"


def test_channel_metadata_has_qos_type_hash_and_given_values(tmp_path: Path):
    write_run(tmp_path / "run.mcap", [])
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        (qos,) = next(
            c for c in reader.connections if c.topic == "/robot_description"
        ).ext.offered_qos_profiles
    assert (qos.durability.name, qos.depth) == ("TRANSIENT_LOCAL", 1)
    with RecordingReader(tmp_path / "run.mcap") as reader:
        metadata = {channel.topic: channel.metadata for channel in reader.channels()}
    assert metadata["/joint_states"]["topic_type_hash"] == JOINT_STATE.hash
    assert metadata["/joint_states"]["zstate.robot"] == "panda"


def test_equal_channel_is_declared_once(tmp_path: Path):
    with RecordingWriter(tmp_path / "run.mcap") as writer:
        first = writer.channel("/a", STRING, Qos())
        assert writer.channel("/a", STRING, Qos()) == first
        assert writer.channel("/a", STRING, LATCHED) != first


def test_latched_values_repeat_every_ten_seconds_at_the_start_of_a_chunk(tmp_path: Path):
    path = tmp_path / "run.mcap"
    stamps = [START + second * S for second in range(25)]
    with RecordingWriter(path) as writer:
        described, joints = declare_channels(writer)
        writer.latch(described, "a", b"A", START, START)
        writer.latch(described, "b", b"B", START, START)
        for second, stamp in enumerate(stamps):
            writer.write(joints, bytes([second]), stamp, stamp)
    written = [payload for _, payload in in_file_order(path)]
    seconds = [bytes([second]) for second in range(25)]
    assert written == [b"A", b"B", *seconds[:10], b"A", b"B", *seconds[10:20], b"A", b"B", *seconds[20:]]
    with RecordingReader(path) as reader:
        repeated = [record for record in reader.records(["/robot_description"]) if record.payload == b"A"]
    assert [r.log_time for r in repeated] == [START, START + 10 * S, START + 20 * S]
    assert {r.publish_time for r in repeated} == {START}


def test_a_message_that_fills_a_chunk_is_alone_in_it_so_that_readers_of_others_skip_it(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as writer:
        clouds, joints = declare_channels(writer)
        for n in range(9):
            is_cloud = n % 3 == 2
            payload = bytes([n]) * (2**20 if is_cloud else 100)
            writer.write(clouds if is_cloud else joints, payload, START + n, START)
    with BoundedFile(path) as file:
        ranges = Summary(file).index().ranges
    assert [len(one.channels or ()) for one in ranges] == [1] * 6
    spans = [(one.first - START, one.last - START) for one in ranges]
    assert spans == [(0, 1), (2, 2), (3, 4), (5, 5), (6, 7), (8, 8)]
    with RecordingReader(path) as reader:
        assert [record.payload[0] for record in reader.records()] == list(range(9))


@pytest.mark.parametrize("is_due", [False, True])
def test_values_once_per_file_begin_each_file_and_are_not_repeated_in_it(tmp_path: Path, is_due: bool):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, max_seconds=25.0) as writer:
        described, joints = declare_channels(writer)
        writer.write(joints, b"0", START, START)
        first = START + is_due * 10 * S  # when a group of repetitions is due
        assert writer.latch(described, "map", b"M", first, START, once_per_file=True)
        assert not writer.latch(described, "map", b"M", first, START, once_per_file=True)
        for second in (10, 20, 25, 35):
            writer.write(joints, bytes([second]), START + second * S, START)
    files = [[payload for _, payload in in_file_order(file)] for file in writer.files]
    assert files == [[b"0", b"M", b"\x0a", b"\x14"], [b"M", b"\x19", b"#"]]


def test_new_value_replaces_the_latched_one_and_an_unlatched_one_is_gone(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as writer:
        described, joints = declare_channels(writer)
        for key, value in (("a", b"old"), ("b", b"B"), ("a", b"new")):
            writer.latch(described, key, value, START, START)
        writer.unlatch(described, "b")
        writer.write(joints, b"1", START + 10 * S, START)
        writer.latch(described, "a", b"newest", START + 20 * S, START)
    assert [payload for _, payload in in_file_order(path)] == [b"old", b"B", b"new", b"new", b"1", b"newest"]


@pytest.mark.parametrize("limit", [{"max_bytes": MIN_BYTES}, {"max_seconds": 5.0}])
def test_each_split_file_is_readable_alone(tmp_path: Path, limit: dict[str, float]):
    states = joint_states(2000)
    write_run(tmp_path / "run.mcap", states, **limit)
    count = len(list(tmp_path.iterdir()))
    files = [tmp_path / "run.mcap", *(tmp_path / f"run_{part}.mcap" for part in range(1, count))]
    assert count >= 3
    assert sorted(tmp_path.iterdir()) == sorted(files)
    payloads: list[bytes] = []
    for file in files:
        with AnyReader([file]) as reader:
            (_, _, first), *rest = reader.messages()
            payloads += [bytes(raw) for connection, _, raw in rest if connection.topic == "/joint_states"]
        assert bytes(first) == DESCRIPTION
    assert payloads == [payload for _, payload in states]


def test_max_bytes_holds_except_for_latched_values_and_the_index(tmp_path: Path):
    write_run(tmp_path / "run.mcap", joint_states(1500), max_bytes=100_000)
    sizes = [file.stat().st_size for file in tmp_path.iterdir()]
    assert all(size < 110_000 for size in sizes)
    assert sum(size > 80_000 for size in sizes) >= len(sizes) - 1


def test_writer_lists_its_files_and_counts_their_bytes(tmp_path: Path):
    with RecordingWriter(tmp_path / "run.mcap", max_seconds=2.0) as writer:
        _, joints = declare_channels(writer)
        for stamp, payload in joint_states(350):
            writer.write(joints, payload, stamp, stamp)
        writer.flush()
        assert writer.files == (tmp_path / "run.mcap", tmp_path / "run_1.mcap")
        assert writer.size == sum(file.stat().st_size for file in writer.files)


def test_decreasing_log_times_keep_the_index_correct(tmp_path: Path):
    path = tmp_path / "run.mcap"
    offsets = [0, 5, 3, 40, 20, 35, 1, 60, 50]
    with RecordingWriter(path) as writer:
        _, joints = declare_channels(writer)
        for number, offset in enumerate(offsets):
            writer.write(joints, bytes([offset]), START + offset * MS, START)
            if number % 3 == 2:
                writer.flush()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        indexed = [message.data[0] for _, _, message in reader.iter_messages()]
        window = [
            m.data[0]
            for _, _, m in reader.iter_messages(starting_at=START + 3 * MS, ending_before=START + 35 * MS)
        ]
    assert indexed == sorted(offsets)
    assert window == [3, 5, 20]
    assert summary and summary.statistics
    assert summary.statistics.message_start_time == START
    assert summary.statistics.message_end_time == START + 60 * MS
    with AnyReader([path]) as reader:
        assert [bytes(raw)[0] for _, _, raw in reader.messages()] == sorted(offsets)


def test_flushed_messages_can_be_read_during_the_recording(tmp_path: Path):
    path, states = tmp_path / "run.mcap", joint_states(30)
    with RecordingWriter(path) as writer:
        described, joints = declare_channels(writer)
        writer.latch(described, "", DESCRIPTION, START, START)
        for number, (stamp, payload) in enumerate(states):
            writer.write(joints, payload, stamp, stamp)
            if number == 19:
                writer.flush()
        (tmp_path / "copy.mcap").write_bytes(path.read_bytes())
    expected = [DESCRIPTION, *(payload for _, payload in states[:20])]
    assert [payload for _, payload in in_file_order(tmp_path / "copy.mcap")] == expected
    with RecordingReader(tmp_path / "copy.mcap") as reader:
        assert [record.payload for record in reader.records()] == expected
        assert not reader.complete


KILLED = """
    import sys
    sys.path.insert(0, sys.argv[2])
    from pathlib import Path
    from helpers.recording_files import *
    writer = RecordingWriter(sys.argv[1])
    described, joints = declare_channels(writer)
    writer.latch(described, "", DESCRIPTION, START, START)
    for number, (stamp, payload) in enumerate(joint_states(100)):
        writer.write(joints, payload, stamp, stamp)
        if number == 59:
            writer.flush()
    print("written")
    sys.stdin.readline()
"""


def test_killed_recorder_keeps_everything_flushed(tmp_path: Path, spawn: Callable[..., Child]):
    path = tmp_path / "run.mcap"
    child = spawn(KILLED, str(path), str(Path(__file__).parents[2]))
    assert child.line() == "written"
    child.kill()
    with RecordingReader(path) as reader:
        payloads = [record.payload for record in reader.records()]
    assert payloads == [DESCRIPTION, *(payload for _, payload in joint_states(60))]


FULL = """
    import resource, signal, sys
    sys.path.insert(0, sys.argv[2])
    from helpers.recording_files import *
    from zstate.recording.errors import RecordingError
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
    writer = RecordingWriter(sys.argv[1])
    described, joints = declare_channels(writer)
    writer.latch(described, "", DESCRIPTION, START, START)
    written = 0
    try:
        for number, (stamp, payload) in enumerate(joint_states(1000)):
            writer.write(joints, payload, stamp, stamp)
            if number % 10 == 9:
                writer.flush()
                written = number + 1
    except RecordingError as error:
        print(error)
    try:
        writer.write(joints, payload, stamp, stamp)
    except RecordingError as error:
        print(error)
    writer.close()
    print(written)
"""


def test_file_that_cannot_grow_raises_and_keeps_whole_chunks(tmp_path: Path, spawn: Callable[..., Child]):
    path = tmp_path / "run.mcap"
    child = spawn(FULL, str(path), str(Path(__file__).parents[2]))
    refusal, closed, written = child.line(), child.line(), int(child.line())
    assert "cannot grow" in refusal and "zstate recover" in refusal
    assert "is closed" in closed
    assert written > 20
    with RecordingReader(path) as reader:
        payloads = [record.payload for record in reader.records()]
        assert reader.losses == ()
    assert payloads == [DESCRIPTION, *(payload for _, payload in joint_states(written))]


def test_full_disk_error_says_so():
    with pytest.raises(RecordingError, match="No space left on device; free some space") as caught:
        RecordingWriter("/dev/full", overwrite=True)
    assert caught.value.path == "/dev/full"


REPEATED_STARTS_ON_A_FULL_DISK = """
import os, resource, signal, sys
from zstate.recording.errors import RecordingError
from zstate.recording.mcap.index import Summary
from zstate.recording.mcap.records import BoundedFile
from zstate.recording.mcap.writer import RecordingWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))
for attempt in range(3):
    try:
        RecordingWriter(os.path.join(sys.argv[1], f"run-{attempt}.mcap"))
    except RecordingError as error:
        print(error)
"""


def test_start_on_a_full_disk_leaves_no_file(spawn: Callable[..., Child], tmp_path: Path):
    child = spawn(REPEATED_STARTS_ON_A_FULL_DISK, str(tmp_path))
    for attempt in range(3):
        assert f"run-{attempt}.mcap' cannot grow" in child.line()
    assert child.wait() == 0
    assert not list(tmp_path.iterdir())


def test_existing_file_is_not_overwritten_by_default(tmp_path: Path):
    path = tmp_path / "run.mcap"
    path.write_text("mine")
    with pytest.raises(RecordingError, match=r"exists; choose another name.*overwrite=True"):
        RecordingWriter(path)
    assert path.read_text() == "mine"
    write_run(path, [], overwrite=True)
    with RecordingReader(path) as reader:
        assert len(list(reader.records())) == 1


def test_splitting_recording_refuses_existing_later_files_at_once(tmp_path: Path):
    (tmp_path / "run_2.mcap").touch()
    with pytest.raises(RecordingError, match=r"run_2.mcap' exists"):
        RecordingWriter(tmp_path / "run.mcap", max_seconds=60)
    assert not (tmp_path / "run.mcap").exists()
    write_run(tmp_path / "run.mcap", [])


def test_missing_folder_is_named(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"there is no folder '.*nowhere'"):
        RecordingWriter(tmp_path / "nowhere" / "run.mcap")


@pytest.mark.parametrize("limit", [{"max_bytes": 1000}, {"max_seconds": 0.0}, {"max_seconds": float("nan")}])
def test_limits_that_would_split_every_message_are_refused(tmp_path: Path, limit: dict[str, float]):
    with pytest.raises(InvalidInput, match=r"give .* or more"):
        RecordingWriter(tmp_path / "run.mcap", **limit)
    assert not list(tmp_path.iterdir())


def test_unwritable_message_leaves_the_file_whole(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path) as writer:
        _, joints = declare_channels(writer)
        for channel, log_time, publish_time in ((9, 1, 1), (joints, -1, 1), (joints, 1, 1 << 64)):
            with pytest.raises(InvalidInput):
                writer.write(channel, b"x", log_time, publish_time)
        writer.write(joints, b"good", 1, 1, sequence=(1 << 32) + 7)
    with RecordingReader(path) as reader:
        assert [(r.payload, r.sequence) for r in reader.records()] == [(b"good", 7)]
        assert reader.complete


def test_closed_writer_writes_nothing(tmp_path: Path):
    writer = RecordingWriter(tmp_path / "run.mcap")
    _, joints = declare_channels(writer)
    writer.close()
    writer.close()
    writer.flush()
    with pytest.raises(RecordingError, match="is closed"):
        writer.write(joints, b"late", START, START)
    with pytest.raises(RecordingError, match="is closed"):
        writer.channel("/late", STRING, Qos())


def test_concurrent_writes_and_flushes_lose_nothing(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, max_bytes=70_000) as writer:
        described, joints = declare_channels(writer)
        writer.latch(described, "", DESCRIPTION, START, START)

        def write(sender: int) -> None:
            for number in range(400):
                writer.write(joints, string_bytes(f"{sender} {number}" * 9), START + number * MS, START)
                if number % 40 == 0:
                    writer.flush()

        threads = [threading.Thread(target=write, args=(sender,)) for sender in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    with RecordingReader(path) as reader:
        payloads = [record.payload for record in reader.records(["/joint_states"])]
    every = itertools.product(range(4), range(400))
    assert sorted(payloads) == sorted(string_bytes(f"{sender} {number}" * 9) for sender, number in every)


def test_file_with_the_maximum_of_channels_is_followed_by_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("zstate.recording.mcap.writer.MAX_CHANNELS", 10)
    with RecordingWriter(tmp_path / "run.mcap") as writer:
        described = writer.channel("/robot_description", STRING, LATCHED)
        writer.latch(described, "", DESCRIPTION, START, START)
        for number in range(25):
            channel = writer.channel(f"/topic_{number}", STRING, Qos())
            assert writer.channel(f"/topic_{number}", STRING, Qos()) == channel
            writer.write(channel, string_bytes(str(number)), START + number, START)
            writer.release(channel)
    assert len(writer.files) == 3
    with RecordingReader(tmp_path / "run.mcap") as reader:
        assert reader.complete
        assert max(len(file.channels) for file in reader.storages) == 10
        topics = [record.topic for record in reader.records() if record.topic != "/robot_description"]
    assert topics == [f"/topic_{number}" for number in range(25)]


def test_released_channel_is_not_in_the_next_file_unless_redeclared(tmp_path: Path):
    with RecordingWriter(tmp_path / "run.mcap", max_seconds=1.0) as writer:
        one, other, third = (writer.channel(f"/{name}", STRING, Qos()) for name in ("one", "other", "third"))
        writer.write(one, DESCRIPTION, START, START)
        writer.release(one)
        writer.release(other)
        again = writer.channel("/one", STRING, Qos())
        writer.write(again, DESCRIPTION, START + 1, START)
        with pytest.raises(InvalidInput, match="is no channel"):
            writer.write(one, DESCRIPTION, START + 2, START)
        writer.write(third, DESCRIPTION, START + 2 * S, START)
    with RecordingReader(tmp_path / "run.mcap") as reader:
        topics = [[(channel.topic, channel.count) for channel in file.channels] for file in reader.storages]
    assert topics == [[("/one", 2), ("/other", 0), ("/third", 0)], [("/third", 1), ("/one", 0)]]
