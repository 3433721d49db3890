from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, failure, interrupted, published_robot, run_cli, run_until, started
from helpers.processes import until
from helpers.recording_builder import LATENCY, MS, START, Bag, RecordingBuilder, S, swing_positions

from zstate import TransformListener, connect, discover
from zstate.scans.messages import OccupancyGrid
from zstate.wire.messages import to_block


@pytest.fixture
def file(tmp_path: Path) -> str:
    """Half a second of an arm."""
    with RecordingBuilder(tmp_path / "run.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(51):
            builder.joints("arm", START + n * 10 * MS, swing_positions(n / 50))
    return str(tmp_path / "run.mcap")


def test_replay_prints_a_heading_and_a_summary(file: str):
    ended = run_cli("replay", file)
    first, last = ended.stdout.splitlines()
    # The first message is the description, the last one a sample half a second after it.
    assert first == (
        f"replaying 'arm' from {file}: 0.5 s, {START // S}.000000000 to {START // S}.500200000, "
        "at 1 times its speed"
    )
    assert LATENCY == 200_000
    assert last.startswith("replayed 51 samples at ")
    assert " (median), " in last
    assert "not published" not in last


@pytest.mark.processes
def test_listener_receives_the_recorded_stamps(file: str, spawn: Spawn):
    with connect() as session, TransformListener(session, "arm") as listener:
        child = started(spawn, "replay", file, "arm", "--loop", "--rate", "5")
        until(lambda: listener.buffer.can_lookup("world", "tool"))
        newest = listener.buffer.lookup("world", "tool").stamp
        assert newest is not None
        assert (newest - START) % (10 * MS) == 0
        assert 0 <= newest - START <= 500 * MS
        interrupted(child)
    assert child.line().startswith("replaying 'arm' from ")
    assert child.line().startswith("replayed ")


def test_writers_have_the_name_of_their_command(file: str):
    with connect() as session:
        _, (robot,) = run_until(lambda: discover(session) or None, "replay", file, "--rate", "0.001")
    assert robot.name == "arm"
    assert {writer.program for _, writer in robot.writers} == {"zstate-replay"}


def test_replay_prints_progress_each_second(file: str):
    ended = run_cli("replay", file, "--rate", "0.1", "--seconds", "0.2")
    assert ended.code == 0
    assert "of 0.2 s" in ended.stderr
    assert "samples" in ended.stderr


def test_live_robot_is_not_replayed_without_takeover(file: str):
    with published_robot("arm"):
        message = failure("replay", file)
        assert "already published on the network: 'arm' by " in message
        assert "--takeover" in message
        assert run_cli("replay", file, "--takeover").code == 0


def test_a_part_can_be_replayed(file: str):
    # From 200 to 300 ms: the samples of 200 to 290 ms arrived a little later than their stamps.
    last = run_cli("replay", file, "--start", "0.2", "--seconds", "0.1", "--rate", "inf").stdout
    assert "as fast as possible" in last
    assert "replayed 10 samples" in last


def test_readable_topics_of_a_ros_bag_are_replayed(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        for n in range(5):
            bag.joints(START + n, {"shoulder": 0.5, "elbow": 0.1})
            bag.joints(START + n, {"knee": 0.5}, "/dog/joint_states")
    output = run_cli("replay", str(tmp_path / "bag"), "--rate", "inf").stdout
    assert "replaying 'dog', 'ros'" in output
    assert "replayed 10 samples" in output


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("leg",), 1, "has no robot 'leg'; its robots: 'arm'"),
        (("--rate", "0"), 2, "rate above 0"),
        (("--start", "100"), 1, "start_s is 100; the recording is 0.5"),
        (("--wire", "pigeon"), 2, "no wire 'pigeon'"),
    ],
)
def test_missing_robot_rate_start_or_wire_is_refused(
    file: str, arguments: tuple[str, ...], code: int, text: str
):
    assert text in failure("replay", file, *arguments, code=code)


def test_file_that_is_not_a_recording_is_refused(tmp_path: Path):
    (tmp_path / "x.mcap").write_text("hello")
    assert "is not a recording" in failure("replay", str(tmp_path / "x.mcap"))


def test_maps_alone_are_published_until_the_command_is_interrupted(tmp_path: Path):
    path = tmp_path / "maps.mcap"
    grid = OccupancyGrid(4, START, "map", 0.5, 1, 1, to_block([0, 0, 0, 0, 0, 0, 1]), b"\x64")
    with RecordingBuilder(path) as builder:
        builder.encoder.write_message("hall", grid, START, "floor")
    with connect() as session:
        ended, (place,) = run_until(lambda: discover(session) or None, "replay", str(path))
    first, last = ended.stdout.splitlines()
    assert first.endswith("no samples; what is latched is published until Ctrl-C")
    assert [name for name, _ in place.named("map")] == ["floor"]
    assert last == "replayed what is latched"
