"""Recovering: what a cut or damage leaves is saved, and nothing else is made up."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from helpers.recording_files import DESCRIPTION, START, S, declare_channels, joint_states, write_run
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from zstate.recording.errors import RecordingError
from zstate.recording.mcap.recover import recover
from zstate.recording.mcap.writer import RecordingWriter
from zstate.recording.reader import RecordingReader


def by_mcap(path: Path) -> list[bytes]:
    """The payloads of a complete file, by mcap's own reader, which must not have to look for them."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary and summary.statistics
        payloads = [message.data for _, _, message in reader.iter_messages()]
        assert summary.statistics.message_count == len(payloads)
    return payloads


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[int], list[bytes]]:
    """A recording, how long it was after each flush of ten messages, and its payloads."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    flushed: list[int] = []
    with RecordingWriter(path) as writer:
        described, joints = declare_channels(writer)
        writer.latch(described, "", DESCRIPTION, START, START)
        writer.flush()
        flushed.append(writer.size)
        for number, (stamp, payload) in enumerate(joint_states(60)):
            writer.write(joints, payload, stamp, stamp)
            if number % 10 == 9:
                writer.flush()
                flushed.append(writer.size)
    return path.read_bytes(), flushed, [DESCRIPTION, *(payload for _, payload in joint_states(60))]


@pytest.mark.long
def test_every_flushed_message_survives_any_cut_and_latched_ones_come_first(
    tmp_path: Path, run: tuple[bytes, list[int], list[bytes]]
):
    data, flushed, payloads = run
    cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    ends = {*random.Random(4).sample(range(flushed[0], len(data)), 250), *flushed, len(data) - 1, len(data)}
    for end in sorted(ends):
        cut.write_bytes(data[:end])
        report = recover(cut, saved, overwrite=True)
        read = by_mcap(saved)
        at_least = 1 + 10 * (sum(size <= end for size in flushed) - 1)
        assert read == payloads[: max(len(read), at_least)]
        assert report.message_count == len(read)
        assert report.was_complete == (end == len(data))
        with RecordingReader(cut) as reader:
            assert [record.payload for record in reader.records()] == read
            assert reader.complete == report.was_complete


def test_cut_before_the_first_flush_gives_an_empty_file_or_an_error(
    tmp_path: Path, run: tuple[bytes, list[int], list[bytes]]
):
    data, flushed, _ = run
    cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    for end in range(flushed[0]):
        cut.write_bytes(data[:end])
        try:
            assert recover(cut, saved, overwrite=True).message_count <= 1
        except RecordingError as error:
            assert str(cut) in str(error)
            assert end < 100
            assert not saved.exists()
        saved.unlink(missing_ok=True)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_beginning_of_a_cut_chunk_is_saved_if_its_compression_allows(
    tmp_path: Path, compression: CompressionType
):
    path = tmp_path / "run.mcap"
    payloads = [random.Random(number).randbytes(1000) for number in range(500)]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start("ros2")
        channel = writer.register_channel("/a", "cdr", 0)
        for number, payload in enumerate(payloads):
            writer.add_message(channel, number, payload, number)
        writer.finish()
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:400_000])
    report = recover(tmp_path / "cut.mcap", tmp_path / "saved.mcap")
    read = by_mcap(tmp_path / "saved.mcap")
    assert read == payloads[: len(read)]
    assert len(read) > 200
    assert f"but for {len(read)} messages" in str(report.losses[0])


def test_damaged_chunk_is_reported_and_the_rest_is_saved(
    tmp_path: Path, run: tuple[bytes, list[int], list[bytes]]
):
    data, flushed, payloads = run
    for damaged in range(1, 6):
        broken = bytearray(data)
        broken[flushed[damaged] + 60] ^= 1
        (tmp_path / "broken.mcap").write_bytes(broken)
        report = recover(tmp_path / "broken.mcap", tmp_path / "saved.mcap", overwrite=True)
        lost = range(1 + 10 * damaged, 11 + 10 * damaged)
        assert by_mcap(tmp_path / "saved.mcap") == [p for n, p in enumerate(payloads) if n not in lost]
        (loss,) = report.losses
        assert loss.offset == flushed[damaged]
        assert 0 < loss.length < flushed[damaged + 1] - flushed[damaged]


def test_zeros_in_the_middle_lose_only_the_chunks_they_cover(
    tmp_path: Path, run: tuple[bytes, list[int], list[bytes]]
):
    data, flushed, payloads = run
    broken = data[: flushed[2] - 50] + bytes(100) + data[flushed[2] + 50 :]
    (tmp_path / "broken.mcap").write_bytes(broken)
    report = recover(tmp_path / "broken.mcap", tmp_path / "saved.mcap")
    read = by_mcap(tmp_path / "saved.mcap")
    assert read == [payload for number, payload in enumerate(payloads) if number not in range(21, 31)]
    assert not report.was_complete


def test_false_end_in_the_middle_is_ignored(tmp_path: Path, run: tuple[bytes, list[int], list[bytes]]):
    data, flushed, payloads = run
    for body in (b"", bytes(4)):
        false_end = b"\x0f" + len(body).to_bytes(8, "little") + body
        (tmp_path / "broken.mcap").write_bytes(
            data[: flushed[2]] + false_end + data[flushed[2] + len(false_end) :]
        )
        report = recover(tmp_path / "broken.mcap", tmp_path / "saved.mcap", overwrite=True)
        read = by_mcap(tmp_path / "saved.mcap")
        assert read == [payload for number, payload in enumerate(payloads) if number not in range(21, 31)]
        assert not report.was_complete


def test_summary_replaces_a_lost_channel_declaration(
    tmp_path: Path, run: tuple[bytes, list[int], list[bytes]]
):
    data, flushed, payloads = run
    first_chunk = data.index(b"\x04\x00\x00\x00zstd")
    broken = bytearray(data)
    broken[first_chunk + 30] ^= 1
    for name, end, saved in (("whole", len(data), 60), ("cut", flushed[3], 0)):
        (tmp_path / f"{name}.mcap").write_bytes(broken[:end])
        report = recover(tmp_path / f"{name}.mcap", tmp_path / f"{name}_saved.mcap")
        assert by_mcap(tmp_path / f"{name}_saved.mcap") == payloads[1 : 1 + saved]
        assert any("description is lost" in loss.reason for loss in report.losses) == (saved == 0)


def test_metadata_and_attachments_are_kept(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "another recorder")
        writer.add_metadata("run", {"operator": "Eva"})
        writer.add_attachment(1, 2, "note", "text/plain", b"hello")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/json", "json", schema, {"key": "value"})
        writer.add_message(channel, 7, b"{}", 6, 5)
        writer.finish()
    recover(path, tmp_path / "saved.mcap")
    with (tmp_path / "saved.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        header = reader.get_header()
        ((schema, channel, message),) = reader.iter_messages()
        ((attachment),) = reader.iter_attachments()
        ((metadata),) = reader.iter_metadata()
    assert header.profile == "ros2"
    assert "another recorder" in header.library
    assert schema and (schema.name, schema.encoding, schema.data) == (
        "std_msgs/msg/String",
        "ros2msg",
        b"string data",
    )
    assert (channel.topic, channel.message_encoding, channel.metadata) == ("/json", "json", {"key": "value"})
    assert (message.log_time, message.data, message.publish_time, message.sequence) == (7, b"{}", 6, 5)
    assert (attachment.name, attachment.data, attachment.log_time) == ("note", b"hello", 2)
    assert (metadata.name, metadata.metadata) == ("run", {"operator": "Eva"})


def test_recovered_splits_remain_one_recording(tmp_path: Path):
    (tmp_path / "saved").mkdir()
    write_run(tmp_path / "run.mcap", joint_states(500), max_seconds=2.0)
    for file in list(tmp_path.glob("*.mcap")):
        data = file.read_bytes()
        file.write_bytes(data[: len(data) - 1])
        recover(file, tmp_path / "saved" / file.name)
    with RecordingReader(tmp_path / "saved" / "run.mcap") as reader:
        assert reader.complete
        assert len(list(reader.records(["/joint_states"]))) == 500


def test_report_has_counts_by_topic_and_the_span(tmp_path: Path):
    write_run(tmp_path / "run.mcap", joint_states(101))
    report = recover(tmp_path / "run.mcap", tmp_path / "saved.mcap")
    assert report.messages == {"/robot_description": 1, "/joint_states": 101}
    assert (report.message_count, report.span) == (102, (START, START + S))
    assert (report.was_complete, report.losses) == (True, ())


def test_original_and_existing_target_are_never_touched(tmp_path: Path):
    path, target = tmp_path / "run.mcap", tmp_path / "saved.mcap"
    write_run(path, joint_states(10))
    before = path.read_bytes()
    target.write_text("mine")
    with pytest.raises(RecordingError, match="exists; choose another name"):
        recover(path, target)
    assert target.read_text() == "mine"
    with pytest.raises(RecordingError, match="into itself"):
        recover(path, path, overwrite=True)
    recover(path, target, overwrite=True)
    assert path.read_bytes() == before


def test_other_file_is_refused_and_no_target_created(tmp_path: Path):
    (tmp_path / "notes.txt").write_text("hello, this is a note")
    with pytest.raises(RecordingError, match="is not a recording"):
        recover(tmp_path / "notes.txt", tmp_path / "saved.mcap")
    with pytest.raises(RecordingError, match="No such file"):
        recover(tmp_path / "nothing.mcap", tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()
