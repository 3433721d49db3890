"""Plugins of other packages: found by their entry points, known to every command, and harmless if broken."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.cli_runner import run_cli
from helpers.pages import blocks
from helpers.plugins import BATTERY_FOLDER, forget_plugins
from helpers.processes import repeated, until
from helpers.prometheus_text import collected, row

from zstate import StreamListener, StreamPublisher, other_plugins, stream_registry
from zstate.errors import InvalidInput, SecondWriter
from zstate.metrics.collectors import add_publishers, add_writers
from zstate.net.discovery import discover
from zstate.net.session import Session
from zstate.streams import Stream
from zstate.wire.identity import WriterId
from zstate.wire.keys import READER_TOKEN
from zstate.wire.native import NativeWire
from zstate.wire.protocol import GraphNode

ROOT = Path(__file__).parents[1]
WRITER = WriterId("reader", "host", 1, 2, 3)


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of packages that this process finds, beside that of the battery."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), str(BATTERY_FOLDER), *sys.path])
    forget_plugins()
    yield tmp_path
    for module in tmp_path.glob("*.py"):
        sys.modules.pop(module.stem, None)
    forget_plugins()


def install(folder: Path, name: str, code: str) -> None:
    """The distribution ``name`` with a module and an entry point."""
    module = name.replace("-", "_")
    (folder / f"{module}.py").write_text(code)
    info = folder / f"{module}-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text(f"[zstate.plugins]\n{module} = {module}:PLUGIN\n")


def test_the_guide_shows_the_package_of_these_tests():
    page = (ROOT / "docs/guides/streams.md").read_text()
    shown = blocks("text", page)
    assert shown[0] == (BATTERY_FOLDER / "zstate_battery/__init__.py").read_text()
    assert (BATTERY_FOLDER / "zstate_battery/checks.py").read_text() in shown


def test_a_stream_is_published_and_received_with_its_name(
    sessions: tuple[Session, Session], battery_plugin: Stream
):
    writing, reading = sessions
    with (
        StreamListener(reading, "*", battery_plugin) as listener,
        StreamPublisher(writing, "panda", battery_plugin, name="main") as publisher,
    ):
        until(lambda: (publisher.publish(voltage=24.1, charge=0.8, stamp=7), len(listener))[1])
        received = listener.get(0.0)
        assert received is not None
        assert received[:2] == ("panda", "main")
        message = received.message
        assert (message.stamp, message.voltage, message.charge) == (7, 24.1, 0.8)
        with pytest.raises(SecondWriter, match="already writes battery of 'panda' under the name 'main'"):
            StreamPublisher(reading, "panda", "battery", name="main")


LOG = """
from zstate.plugins import Plugin
from zstate.streams import StampedMessage, Stream

class Data(StampedMessage, frozen=True, array_like=True, gc=False):
    data: bytes

ROWS = [Stream(name, Data, max_bytes=3_000_000, bulk=name == "video") for name in ("video", "log")]
PLUGIN = Plugin("log", streams=tuple(ROWS))
"""


def test_messages_above_1_mb_are_received_on_a_stream_of_bulk_data_only_and_the_newest_8_wait(
    installed: Path, sessions: tuple[Session, Session]
):
    install(installed, "zstate-log", LOG)
    writing, reading = sessions
    with (
        StreamListener(reading, "panda", "video") as videos,
        StreamListener(reading, "panda", "log") as logs,
        StreamPublisher(writing, "panda", "video") as video,
        StreamPublisher(writing, "panda", "log") as log,
    ):
        data = bytes(2_000_000)
        with repeated(lambda: log.publish(data=data), every_s=0.05):
            until(lambda: logs.refused)
        with repeated(lambda: video.publish(data=data), every_s=0.05):
            until(lambda: videos.lost)
        assert (len(logs), len(videos)) == (0, 8)
        assert list(logs.refused) == ["too large"]
        received = videos.get(0.0)
        assert received is not None
        assert (len(received.message.data), videos.refused) == (2_000_000, {})
        with repeated(lambda: video.publish(data=bytes(3_000_001)), every_s=0.05):
            until(lambda: videos.refused)
        assert list(videos.refused) == ["too large"]
    for command in ("hz panda --stream video --once", "echo panda --stream video --once --field stamp", "ls"):
        with (
            StreamPublisher(writing, "panda", "video") as video,
            repeated(lambda publisher=video: publisher.publish(data=data), every_s=0.05),
        ):
            ended = run_cli(*command.split())
            assert ended.code == 0, ended.stderr


def test_a_stream_is_not_both_latched_and_of_bulk_data():
    with pytest.raises(InvalidInput, match="a latched value always arrives, bulk data may not"):
        Stream("map", "m:Map", latched=True, bulk=True)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"voltage": "high", "charge": 0.5}, "Expected `float`, got `str`"),
        ({"voltage": 1.0}, "Missing required argument 'charge'"),
        ({"voltage": 1.0, "charge": 0.5, "amps": 1.0}, "Unexpected keyword argument 'amps'"),
    ],
)
def test_fields_that_are_none_of_the_message_are_refused_and_counted(
    sessions: tuple[Session, Session], battery_plugin: Stream, fields: dict[str, object], reason: str
):
    with StreamPublisher(sessions[0], "panda", battery_plugin, name="main") as publisher:
        with pytest.raises(InvalidInput, match="whose fields are voltage, charge") as caught:
            publisher.publish(**fields)
        assert reason in str(caught.value)
        assert (publisher.stats.sent, publisher.stats.refused) == (0, 1)


@pytest.mark.parametrize(
    ("stream", "wires", "reason"),
    [
        ("joint_states", ("native",), "has its own publisher"),
        ("map", ("native",), "has its own publisher"),
        ("leak", ("native",), "there is no stream 'leak'; known are joint_states"),
        ("battery", ("ros2",), "the stream 'battery' is not carried by ROS 2"),
    ],
)
@pytest.mark.usefixtures("battery_plugin")
def test_streams_that_cannot_be_published_so_are_refused(
    sessions: tuple[Session, Session], stream: str, wires: tuple[str, ...], reason: str
):
    with pytest.raises(InvalidInput, match=reason):
        StreamPublisher(sessions[0], "panda", stream, name="main", wires=wires)


def test_a_payload_that_is_no_message_is_counted_and_named(
    sessions: tuple[Session, Session], battery_plugin: Stream
):
    with StreamListener(sessions[1], "panda", battery_plugin) as listener:
        key, encoding = "zstate/panda/battery/main", "zstate/Battery;v=1"
        until(lambda: (sessions[0].zenoh.put(key, b"\x01", encoding=encoding), listener.refused)[1])
        assert set(listener.refused) == {"malformed"}
        until(lambda: (sessions[0].zenoh.put(key, b"", encoding="text/plain"), len(listener.refused) > 1)[1])
        assert "foreign" in listener.refused


def test_commands_know_the_stream(sessions: tuple[Session, Session], battery_plugin: Stream):
    with StreamPublisher(sessions[0], "panda", battery_plugin, name="main") as publisher:
        publishing = _Repeated(lambda: publisher.publish(voltage=24.1, charge=0.8))
        with publishing:
            assert "battery/main" in run_cli("ls").stdout
            assert run_cli("hz", "panda", "--stream", "battery", "--once").stdout.startswith("average rate: ")
            echoed = run_cli("echo", "panda", "--stream", "battery", "--once", "--json")
            assert json.loads(echoed.stdout).items() >= {"voltage": 24.1, "charge": 0.8}.items()
            field = run_cli("echo", "panda", "--stream", "battery", "--once", "--field", "charge")
            assert field.stdout == "0.8\n"
            assert "battery/main" in run_cli("graph").stdout
            checks = json.loads(run_cli("doctor", "--json").stdout)["checks"]
            (check,) = [one for one in checks if one["name"] == "battery"]
            assert (check["state"], "as 'main'" in check["text"]) == ("ok", True)
            assert run_cli("battery", "panda").stdout == "80 %\n"
    assert "battery" in run_cli("hz", "--help").stdout


@pytest.mark.usefixtures("battery_plugin")
def test_a_command_of_the_package_is_a_table_of_up(tmp_path: Path):
    file = tmp_path / "cell.toml"
    file.write_text("[[battery]]\nrobot = 'panda'\n")
    shown = run_cli("up", str(file), "--check").stdout
    assert shown.split() == ["panda/battery", "zstate", "battery", "panda"]
    file.write_text("[[battery]]\nrobots = 'panda'\n")
    assert "battery[0].robots: there is no such key; did you mean 'robot'?" in run_cli("up", str(file)).stderr


def doctors_checks() -> dict[str, tuple[str, str]]:
    """The state and the text of each check of doctor, by its name."""
    checks = json.loads(run_cli("doctor", "--json").stdout)["checks"]
    return {one["name"]: (one["state"], one["text"]) for one in checks}


def test_doctor_has_the_checks_of_the_package(sessions: tuple[Session, Session], battery_plugin: Stream):
    with (
        StreamPublisher(sessions[0], "panda", battery_plugin, name="main") as publisher,
        _Repeated(lambda: publisher.publish(voltage=21.0, charge=0.07)),
    ):
        assert doctors_checks()["charge"] == ("warning", "'main' is at 7%")


@pytest.mark.parametrize("method", ["__init__", "is_complete", "has_data", "checks", "close"])
def test_a_check_that_fails_is_a_warning_and_costs_no_other_one_anything(
    sessions: tuple[Session, Session], battery_plugin: Stream, monkeypatch: pytest.MonkeyPatch, method: str
):
    from zstate_battery.checks import BatteryChecks

    def fail(*_: object) -> None:
        raise OSError("no such cell")

    monkeypatch.setattr(BatteryChecks, method, fail)
    with (
        StreamPublisher(sessions[0], "panda", battery_plugin, name="main") as publisher,
        _Repeated(lambda: publisher.publish(voltage=24.1, charge=0.8)),
    ):
        found = doctors_checks()
    assert found["battery"][0] == "ok"
    if method in ("__init__", "checks"):
        text = "the checks of zstate-battery have failed: OSError: no such cell"
        assert found["plugins"] == ("warning", text)


LEAK = """
from zstate.plugins import Plugin
from zstate.streams import StampedMessage, Stream

class Leak(StampedMessage, frozen=True, array_like=True, gc=False):
    frame: str

PLUGIN = Plugin("leak", streams=(Stream("leak", Leak, named=True),))
"""


@pytest.mark.parametrize(
    ("frame", "text", "echoed"),
    [
        ("/", "the leak of 'bilge': the frame name '/' of robot 'panda' is empty or has a slash", "/"),
        ("deck", "the leak of 'bilge' is in 'panda/deck', which no writer places", "panda/deck"),
    ],
)
def test_a_frame_that_the_robot_does_not_have_is_a_finding_and_is_echoed(
    installed: Path, sessions: tuple[Session, Session], frame: str, text: str, echoed: str
):
    install(installed, "zstate-leak", LEAK)
    with (
        StreamPublisher(sessions[0], "panda", "leak", name="bilge") as publisher,
        _Repeated(lambda: publisher.publish(frame=frame)),
    ):
        found = doctors_checks()["leak"]
        assert (found[0], text in found[1]) == ("broken", True), found
        shown = run_cli("echo", "panda", "--stream", "leak", "--once", "--field", "frame")
        assert json.loads(shown.stdout) == echoed


def test_metrics_count_its_messages_and_writers(sessions: tuple[Session, Session], battery_plugin: Stream):
    with StreamPublisher(sessions[0], "panda", battery_plugin, name="main") as publisher:
        publisher.publish(voltage=24.1, charge=0.8)
        samples = row("zstate_publisher_samples_total", robot="panda", wire="native", stream="battery")
        assert collected(lambda families: add_publishers(families, [publisher]))[samples] == 1
        writers = collected(lambda families: add_writers(families, discover(sessions[1])))
        assert writers[row("zstate_writers", robot="panda", stream="battery")] == 1


@pytest.mark.usefixtures("battery_plugin")
def test_a_reader_of_several_streams_announces_those_of_others_apart():
    """A program without the package ignores a token that names its stream."""
    tokens = NativeWire().reader_tokens(
        GraphNode("panda", WRITER, "zid", 0), ("battery", "tf", "imu"), lambda: 1
    )
    assert [READER_TOKEN.parse(token)[1] for token in tokens] == [("tf", "imu"), ("battery",)]


def test_plugins_are_listed_with_what_they_bring(battery_plugin: Stream):
    assert run_cli("plugins").stdout == (
        "battery  (zstate-battery 1.0)\n  streams: battery\n  commands: battery\n"
    )
    (facts,) = json.loads(run_cli("plugins", "--json").stdout)
    assert facts == {
        **{"plugin": "battery", "package": "zstate-battery", "version": "1.0"},
        **{"streams": ["battery"], "commands": ["battery"], "problems": []},
    }


BROKEN = {
    "raises": ("raise OSError('no such device')", "cannot be imported: OSError: no such device"),
    "exits": ("raise SystemExit(3)", "cannot be imported: SystemExit: 3"),
    "none": ("PLUGIN = 5", "is not a zstate.plugins.Plugin, but of type int"),
    "lazy": (
        "from zstate.plugins import Plugin\nfrom zstate.streams import Stream\n"
        "PLUGIN = Plugin('lazy', streams=(Stream('leak', 'missing_module:Leak'),))",
        "the stream 'leak' of zstate-broken is not used: its message 'missing_module:Leak' cannot be loaded",
    ),
    "joints": (
        "from zstate.plugins import Plugin\nfrom zstate.streams import StampedMessage, Stream\n"
        "PLUGIN = Plugin('joints', streams=(Stream('fingers', StampedMessage, group='joints'),))",
        "the streams of other packages are measurements",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_plugin_that_cannot_be_used_is_reported_once_and_costs_no_other_one_anything(
    installed: Path, caplog: pytest.LogCaptureFixture, name: str
):
    code, problem = BROKEN[name]
    install(installed, "zstate-broken", code)
    for _ in range(2):
        assert stream_registry.stream_named("battery").summary == "voltage and charge of a battery"
        assert stream_registry.find_stream("leak") is None
    assert len([record for record in caplog.records if problem in record.getMessage()]) == 1
    ended = run_cli("plugins")
    assert ended.code == 1
    assert "zstate-broken" in ended.stdout.replace("\n", " ")
    assert "battery  (zstate-battery 1.0)" in ended.stdout


def test_of_two_that_bring_one_name_both_are_named_and_zstate_itself_wins(installed: Path):
    install(
        installed,
        "zstate-other",
        "from zstate.plugins import Plugin\nfrom zstate.streams import StampedMessage, Stream\n"
        "ROWS = (Stream('battery', StampedMessage), Stream('imu', StampedMessage))\n"
        "PLUGIN = Plugin('other', streams=ROWS, commands={'battery': 'x:y', 'tf': 'x:y'})",
    )
    other = next(one for one in other_plugins.found_plugins() if one.distribution == "zstate-other")
    assert other.plugin.streams == ()
    assert "the stream 'battery' of zstate-other is not used: zstate-battery brings one" in other.problem
    assert "the stream 'imu' of zstate-other is not used: zstate brings one" in other.problem
    assert "the command 'battery' of zstate-other is not used: zstate-battery brings one" in other.problem
    assert "zstate brings one of that name" in " ".join(run_cli("plugins").stdout.split())
    assert run_cli("tf", "--help").stdout.startswith("Usage: zstate tf")
    assert stream_registry.stream_named("imu").type.__name__ == "Imu"


def test_a_command_that_cannot_be_loaded_is_an_error_with_its_package(installed: Path):
    install(
        installed,
        "zstate-other",
        "from zstate.plugins import Plugin\n"
        "PLUGIN = Plugin('other', commands={'leak': 'missing_module:leak'})",
    )
    ended = run_cli("leak")
    assert ended.code == 1
    assert "the command 'leak' of zstate-other (missing_module:leak) cannot be loaded" in ended.stderr


class _Repeated:
    """Calls ``function`` twenty times a second in a thread."""

    def __init__(self, function: Callable[[], object]) -> None:
        self._stop = threading.Event()

        def run() -> None:
            while not self._stop.wait(0.05):
                function()

        self._thread = threading.Thread(target=run)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
