"""Streams of other packages in recordings: as JSON, with a schema, by a package that may be missing later."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import failure, run_cli
from helpers.plugins import battery_installed
from helpers.processes import until
from helpers.recording_builder import MS, RRBOT, START, RecordingBuilder
from helpers.robots import wait_for_reader
from mcap.reader import make_reader
from mcap.writer import Writer

from zstate import StatePublisher, StreamListener, StreamPublisher
from zstate.errors import InvalidInput, MessageError
from zstate.message import StampedMessage
from zstate.net.session import Session
from zstate.recording.decode import DecodedMessage, DecodedRecording
from zstate.recording.info import read_info, recorded_robots
from zstate.recording.player import Player
from zstate.recording.reader import RecordingReader
from zstate.recording.recorder import Recorder
from zstate.recording.recording import Recording
from zstate.streams import Stream
from zstate.wire.json_form import JsonDecoder, encode_json, json_type

COUNT = 20


def batteries(row: Stream, session: int = 7) -> list[StampedMessage]:
    kind: Any = row.type
    return [kind(START + n * 10 * MS, n, session, 24.0 + n / 7, n / COUNT) for n in range(COUNT)]


@pytest.fixture
def run(battery_plugin: Stream, tmp_path: Path) -> Path:
    """The battery "main" of "arm" for 190 ms at 100 Hz, and the arm itself."""
    path = tmp_path / "run.mcap"
    with RecordingBuilder(path, programs={7: "power 1 on host"}) as builder:
        builder.describe("arm")
        for n, message in enumerate(batteries(battery_plugin)):
            builder.joints("arm", START + n * 10 * MS, [0.0, 0.0])
            builder.encoder.write_message("arm", message, START + n * 10 * MS, "main", stream="battery")
    return path


def decoded(path: Path, refused: list[tuple[str, str]] | None = None) -> list[DecodedMessage]:
    def refuse(reason: str, text: str) -> None:
        assert refused is not None, text
        refused.append((reason, text))

    with RecordingReader(path) as reader:
        return list(DecodedRecording(reader, refuse).messages(streams=("battery",)))


def test_recorded_messages_are_played_back_as_the_same_writer(
    sessions: tuple[Session, Session], battery_plugin: Stream, tmp_path: Path
):
    writer, reader = sessions
    path = tmp_path / "run.mcap"
    with (
        StatePublisher(writer, RRBOT, "arm") as arm,
        StreamPublisher(writer, "arm", "battery", "main") as publisher,
        Recorder(reader, path) as recorder,
    ):
        wait_for_reader(writer, "zstate/arm/battery/main")
        arm.publish([0.0, 0.0], stamp=START)
        sent = [(START + n * MS, 24.0 + n / 7, n / COUNT) for n in range(COUNT)]
        for stamp, voltage, charge in sent:
            publisher.publish(stamp, voltage=voltage, charge=charge)
        until(lambda: recorder.stats.messages.get(("arm", "battery")) == COUNT)
        assert (recorder.stats.missed, recorder.stats.refused) == (0, {})
    assert [(one.message.stamp, one.message.voltage, one.message.charge) for one in decoded(path)] == sent
    with StreamListener(reader, "*", "battery") as listener, Player(writer, path, rate=math.inf) as player:
        wait_for_reader(writer, "zstate/arm/battery/main")
        report = player.run()
        until(lambda: len(listener) == COUNT)
        received = [listener.get() for _ in range(COUNT)]
    assert not report.refused
    assert {(one.robot, one.name) for one in received if one} == {("arm", "main")}
    messages: list[Any] = [one.message for one in received if one]
    assert [(one.stamp, one.voltage, one.charge) for one in messages] == sent
    assert [one.seq for one in messages] == list(range(COUNT))


def test_file_has_objects_with_their_schema_and_writer(run: Path):
    with run.open("rb") as stream:
        found = [one for one in make_reader(stream).iter_messages() if one[1].topic == "/arm/battery/main"]
    schema, channel, message = found[3]
    assert (channel.message_encoding, schema.encoding, schema.name) == (
        "json",
        "jsonschema",
        "zstate_battery.Battery",
    )
    described = json.loads(schema.data)
    assert described["type"] == "object"
    assert described["properties"]["voltage"] == {"type": "number"}
    assert channel.metadata == {
        "zstate.session": "7",
        "zstate.robot": "arm",
        "zstate.frame_prefix": "arm/",
        "zstate.writer": "main",
        "zstate.program": "power 1 on host",
        "zstate.stream": "battery",
        "zstate.version": "1",
    }
    fields = {"stamp": START + 30 * MS, "seq": 3, "session": 7, "voltage": 24.0 + 3 / 7, "charge": 0.15}
    assert json.loads(message.data) == fields
    assert (message.publish_time, message.sequence) == (START + 30 * MS, 3)


def test_read_messages_are_those_that_were_written(run: Path, battery_plugin: Stream):
    read = decoded(run)
    assert [one.message for one in read] == batteries(battery_plugin)
    (writer,) = {one.writer for one in read}
    assert (writer.robot, writer.stream, writer.session) == ("arm", "battery", 7)
    assert (writer.edge_writer, writer.program, writer.foreign) == ("main", "power 1 on host", False)
    with Recording(run) as recording:
        assert [one.message for one in recording.measurements("battery", "arm")] == batteries(battery_plugin)
        assert recording.robots == ("arm",)
        assert list(recording.measurements("scan")) == []
        with pytest.raises(InvalidInput, match=r"no stream of measurements, maps or odometry: .*, battery"):
            recording.measurements("joint_states")


def test_recording_that_splits_has_the_channel_in_each_file(battery_plugin: Stream, tmp_path: Path):
    path = tmp_path / "run.mcap"
    with RecordingBuilder(path, max_bytes=1 << 16) as builder:
        for message in batteries(battery_plugin) * 100:
            builder.encoder.write_message("arm", message, message.stamp, "main", stream="battery")
    assert len(read_info(path).files) > 1
    assert len(decoded(path)) == 100 * COUNT


def test_info_lists_the_writer_with_count_and_rate(run: Path):
    (robot,) = recorded_robots(read_info(run))
    (battery,) = [one for one in robot.streams if one.stream == "battery"]
    assert (battery.topic, battery.type) == ("/arm/battery/main", "zstate_battery.Battery")
    assert (battery.count, battery.writer) == (COUNT, "main, power 1 on host")
    assert battery.rate_hz == pytest.approx(100.0, rel=0.01)
    assert "battery" in run_cli("info", str(run)).stdout


def test_recording_is_read_without_the_package_that_is_not_installed(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with battery_installed() as row, RecordingBuilder(path) as builder:
        builder.describe("arm")
        builder.joints("arm", START, [0.0, 0.0])
        for message in batteries(row):
            builder.encoder.write_message("arm", message, message.stamp, "main", stream="battery")
    with RecordingReader(path) as reader:
        recording = DecodedRecording(reader, lambda *_: None)
        assert [channel.topic for channel in recording.ignored] == ["/arm/battery/main"]
        assert [one.writer.stream for one in recording.messages()] == ["robot_description", "joint_states"]
    lines = run_cli("info", str(path)).stdout.splitlines()
    (line,) = lines[lines.index("other topics") + 1 :]
    assert line.split()[:3] == ["/arm/battery/main", "zstate_battery.Battery", str(COUNT)]
    assert "no stream 'battery'" in failure("export", str(path), "--stream", "battery")


BROKEN = [
    (b"{", "1", "malformed"),
    (b'{"stamp": 1, "seq": 0, "session": 7, "voltage": "24", "charge": 0.5}', "1", "malformed"),
    (b'{"stamp": 1, "seq": 0, "session": 7, "charge": 0.5}', "1", "malformed"),
    (b'{"stamp": 1, "seq": -1, "session": 7, "voltage": 24, "charge": 0.5}', "1", "malformed"),
    (b"\xff", "1", "malformed"),
    (b'{"a": ' * 5000, "1", "malformed"),
    (b'{"stamp": 1, "seq": 0, "session": 7, "voltage": 24, "charge": 0.5}', "2", "other version"),
]


@pytest.mark.usefixtures("battery_plugin")
@pytest.mark.parametrize(("payload", "version", "reason"), BROKEN)
def test_broken_message_is_counted_and_the_others_are_read(
    tmp_path: Path, payload: bytes, version: str, reason: str
):
    good = b'{"stamp": 5, "seq": 1, "session": 7, "voltage": 24, "charge": 0.5}'
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "")
        schema = writer.register_schema("zstate_battery.Battery", "jsonschema", b"{}")
        facts = {"zstate.session": "7", "zstate.robot": "arm", "zstate.stream": "battery"}
        for one, of_version in ((payload, version), (good, "1")):
            metadata = {**facts, "zstate.version": of_version}
            channel = writer.register_channel("/battery", "json", schema, metadata)
            writer.add_message(channel, START, one, START)
        writer.finish()
    refused: list[tuple[str, str]] = []
    (read,) = decoded(path, refused)
    assert (read.message.stamp, read.message.voltage) == (5, 24.0)
    assert [one for one, _ in refused] == [reason]


def test_too_many_writers_are_refused_as_those_of_other_streams(battery_plugin: Stream, tmp_path: Path):
    builder = RecordingBuilder(tmp_path / "run.mcap", "arm")
    for session in range(1010):
        (message, *_) = batteries(battery_plugin, session)
        builder.encoder.write_message("arm", message, START, "main", stream="battery")
    builder.writer.close()
    assert builder.refused == ["too many writers"] * 10
    assert builder.encoder.messages == {("arm", "battery"): 1000}


def test_ros_wires_get_all_but_the_stream(sessions: tuple[Session, Session], run: Path):
    writer, _ = sessions
    with Player(writer, run, rate=math.inf, wires=("ros2",)) as player:
        report = player.run()
    assert (report.samples, report.refused) == (COUNT, {})


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_export_has_a_row_for_each_message(run: Path, battery_plugin: Stream, kind: str):
    if kind == "parquet":
        parquet = pytest.importorskip("pyarrow.parquet", reason="pip install 'zstate[export]'")
    output = run_cli("export", str(run), "--stream", "battery", f"--{kind}").stdout
    table = run.with_suffix(f".battery.{kind}")
    assert " ".join(output.split()).startswith(f"exported {COUNT} messages of battery into {table} (")
    sent: list[Any] = batteries(battery_plugin)
    rows = [(one.stamp, "arm", "main", one.voltage, one.charge) for one in sent]
    names = ["stamp", "robot", "writer", "voltage", "charge"]
    if kind == "csv":
        lines = [names, *([str(value) for value in row] for row in rows)]
        assert table.read_text().splitlines() == [",".join(line) for line in lines]
    else:
        read = parquet.read_table(table)
        assert read.column_names == names
        assert [tuple(row.values()) for row in read.to_pylist()] == rows


@pytest.mark.usefixtures("battery_plugin")
def test_export_of_other_streams_and_of_nothing_is_refused(run: Path, tmp_path: Path):
    assert "'scan' has no columns: ranges, " in failure("export", str(run), "--stream", "scan")
    assert "no stream of measurements" in failure("export", str(run), "--stream", "tf")
    assert "--stream exports" in failure("export", str(run), "--stream", "battery", "--rate", "5", code=2)
    with RecordingBuilder(tmp_path / "arm.mcap") as builder:
        builder.joints("arm", START, [0.0, 0.0])
        builder.describe("arm")
    message = failure("export", str(tmp_path / "arm.mcap"), "--stream", "battery")
    assert "no message of 'battery'" in message
    assert not list(tmp_path.glob("*.battery.*"))


class Part(StampedMessage, frozen=True, array_like=True, gc=False):
    """Nested."""

    level: float


class Everything(StampedMessage, frozen=True, array_like=True, gc=False):
    """Fields of all kinds."""

    number: float
    maybe: float | None = None
    raw: bytes = b""
    names: tuple[str, ...] = ()
    table: dict[str, float] = {}  # noqa: RUF012 - msgspec copies it
    parts: tuple[Part, ...] = ()
    mode: str | None = None


class Unusable(StampedMessage, frozen=True, array_like=True, gc=False):
    """A field that JSON cannot represent."""

    cells: dict[tuple[int, int], float] = {}  # noqa: RUF012 - as above


EVERYTHING = Stream("everything", Everything)
NUMBERS = [0.5, math.inf, -math.inf, 1e300]


@pytest.mark.parametrize("number", NUMBERS)
def test_json_round_trip_is_exact(number: float):
    message = Everything(
        (1 << 63) - 1,
        5,
        (1 << 64) - 1,
        number,
        number,
        b"\0\xff",
        ("NaN", "ü"),
        {"a": number},
        (Part(1, 2, 3, number),),
    )
    encoded = encode_json(message)
    assert JsonDecoder(EVERYTHING, "1").decode(encoded) == message
    assert json.loads(encoded)["raw"] == base64.b64encode(message.raw).decode()


def test_numbers_that_are_unknown_stay_so():
    encoded = encode_json(Everything(1, 2, 3, math.nan))
    assert json.loads(encoded)["number"] == "NaN"
    message: Any = JsonDecoder(EVERYTHING, "1").decode(encoded)
    assert math.isnan(message.number)
    assert message.maybe is None


def test_schema_has_what_foxglove_displays():
    described = json.loads(json_type(EVERYTHING).definition)
    assert {name: one.get("type") for name, one in described["properties"].items()} == {
        **dict.fromkeys(("stamp", "seq", "session"), "integer"),
        **dict.fromkeys(("number", "maybe"), "number"),
        **dict.fromkeys(("raw", "mode"), "string"),
        "names": "array",
    }


def test_class_without_a_form_in_json_is_refused():
    with pytest.raises(InvalidInput, match="JSON cannot represent it"):
        encode_json(Unusable(1, 2, 3, {(1, 2): 0.5}))
    missing = Stream("missing", "no_such_module:Battery")
    with pytest.raises(InvalidInput, match="no_such_module"):
        json_type(missing)
    with pytest.raises(MessageError, match="no_such_module"):
        JsonDecoder(missing, "1").decode(b"{}")
