from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, failure, interrupted, published_robot, started, zstate
from helpers.processes import until
from helpers.recording_builder import LATENCY, MS, START, Bag, RecordingBuilder, S, swing_positions

from zstate import TransformListener, connect, discover

pytestmark = pytest.mark.processes


@pytest.fixture
def file(tmp_path: Path) -> str:
    """Half a second of an arm."""
    with RecordingBuilder(tmp_path / "run.mcap", "arm") as tale:
        tale.describe("arm")
        for n in range(51):
            tale.joints("arm", START + n * 10 * MS, swing_positions(n / 50))
    return str(tmp_path / "run.mcap")


def test_it_says_what_it_replays_and_what_became_of_it(file: str):
    ended = zstate("replay", file)
    first, last = ended.stdout.decode().splitlines()
    # The first message is the description, the last one a sample half a second after it.
    assert first == (
        f"replaying 'arm' from {file}: 0.5 s, {START // S}.000000000 to {START // S}.500200000, "
        "at 1 times its speed"
    )
    assert LATENCY == 200_000
    assert last.startswith("replayed 51 samples at ")
    assert " (median), " in last
    assert "not published" not in last


def test_a_listener_hears_the_recorded_stamps(file: str, spawn: Spawn):
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


def test_writers_are_known_by_the_command_that_they_are(file: str, spawn: Spawn):
    child = started(spawn, "replay", file, "--rate", "0.001")
    child.line()
    with connect() as session:
        until(lambda: discover(session))
        (robot,) = discover(session)
    assert robot.name == "arm"
    assert {writer.program for _, writer in robot.writers} == {"zstate-replay"}


def test_progress_is_told_each_second(file: str, spawn: Spawn):
    child = started(spawn, "replay", file, "--rate", "0.1", "--duration", "0.2")
    child.line()
    until(lambda: "of 0.2 s" in child.stderr)
    assert "samples" in child.stderr


def test_a_robot_that_is_live_is_left_alone_unless_one_insists(file: str):
    with published_robot("arm"):
        message = failure("replay", file)
        assert "there is 'arm' by " in message
        assert "--takeover" in message
        assert zstate("replay", file, "--takeover").returncode == 0


def test_a_part_can_be_replayed(file: str):
    # From 200 to 300 ms: the samples of 200 to 290 ms were heard a little later than they were made.
    last = zstate("replay", file, "--start", "0.2", "--duration", "0.1", "--rate", "inf").stdout.decode()
    assert "as fast as it can" in last
    assert "replayed 10 samples" in last


def test_a_bag_of_ros_is_replayed_as_far_as_it_is_understood(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        for n in range(5):
            bag.joints(START + n, {"shoulder": 0.5, "elbow": 0.1})
            bag.joints(START + n, {"knee": 0.5}, "/dog/joint_states")
    said = zstate("replay", str(tmp_path / "bag"), "--rate", "inf").stdout.decode()
    assert "replaying 'dog', 'ros'" in said
    assert "replayed 10 samples" in said


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("leg",), 1, "nothing of 'leg'; its robots: 'arm'"),
        (("--rate", "0"), 2, "rate above 0"),
        (("--start", "100"), 1, "start_s is 100; the recording is 0.5"),
        (("--wire", "pigeon"), 2, "no wire 'pigeon'"),
    ],
)
def test_what_is_not_there_is_told(file: str, arguments: tuple[str, ...], code: int, says: str):
    assert says in failure("replay", file, *arguments, code=code)


def test_what_is_no_recording_is_told(tmp_path: Path):
    (tmp_path / "x.mcap").write_text("hello")
    assert "is not a recording" in failure("replay", str(tmp_path / "x.mcap"))
