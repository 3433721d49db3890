"""Playback on a real network: the same samples and transforms, at the recorded spacing."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, SteppingClock, until
from helpers.recording_builder import (
    LATENCY,
    MS,
    RRBOT,
    START,
    Bag,
    RecordingBuilder,
    S,
    pose,
    recorded_buffer,
    swing_positions,
    swing_velocities,
)
from helpers.robots import SampleCollector, wait_for_reader, wait_for_stream_readers
from rosbags.rosbag2 import StoragePlugin

from zstate import Recording, StatePublisher, StaticPublisher, TransformBuffer, TransformListener
from zstate.errors import InvalidInput
from zstate.model.urdf import parse_urdf
from zstate.net.latched import LatchedSubscriber
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.recording.player import CLOCK_HZ, Player, PlayerReport
from zstate.recording.recorder import Recorder
from zstate.scans.messages import OccupancyGrid
from zstate.transform import Transform
from zstate.wire.messages import (
    ClockMessage,
    JointState,
    StaticTransforms,
    TransformSample,
    from_block,
    to_block,
)
from zstate.wire.native import decode, encoding_of
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import RmwKeys

COUNT = 100
PATHS = [("world", "tool"), ("tool", "lens"), ("laser_link", "world")]


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of an arm at 100 Hz, with a lens on its tool."""
    path = tmp_path_factory.mktemp("arm") / "arm.mcap"
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm")
        builder.statics("arm", START, {("tool", "lens"): pose(z=0.1)})
        for n in range(COUNT):
            builder.joints(
                "arm", START + n * 10 * MS + n % 3, swing_positions(n / 50), swing_velocities(n / 50)
            )
    return path


def answers(buffer: TransformBuffer, stamps: np.ndarray) -> list[np.ndarray]:
    return [buffer.lookup_many(target, source, stamps)[0] for target, source in PATHS]


def assert_same(one: list[np.ndarray], other: list[np.ndarray]) -> None:
    for a, b in zip(one, other, strict=True):
        assert np.isfinite(a).all()
        assert np.array_equal(a, b)


@contextmanager
def replaying(replayer: Player) -> Iterator[list[PlayerReport]]:
    """Runs the player during the context; its report is available afterwards."""
    reports: list[PlayerReport] = []
    thread = threading.Thread(target=lambda: reports.append(replayer.run()))
    thread.start()
    try:
        yield reports
    finally:
        replayer.close()
        thread.join()


def replayed(sessions: tuple[Session, Session], path: Path, **options: object) -> TransformBuffer:
    """What a listener's buffer knows after a replay."""
    writer, reader = sessions
    with TransformListener(reader, "arm", history_s=100.0) as listener, Player(writer, path) as whole:
        wait_for_stream_readers(writer, "arm")
        last = whole.span[1]
        with Player(writer, path, **options) as replayer:
            report = replayer.run()
        assert report.samples == COUNT
        assert not report.refused
        assert last >= START
        until(lambda: listener.stats.received == COUNT)
        until(lambda: listener.buffer.can_lookup("tool", "lens"))
        assert listener.stats.missed == 0
        return listener.buffer


@pytest.mark.parametrize("rate", [1.0, 10.0, math.inf])
def test_playback_gives_the_same_lookups_as_the_file(sessions, arm: Path, rate: float):
    buffer = replayed(sessions, arm, rate=rate)
    stamps = np.random.default_rng(1).integers(START, START + (COUNT - 1) * 10 * MS, 300)
    assert_same(answers(buffer, stamps), answers(recorded_buffer(arm), stamps))


def test_live_played_back_and_recorded_lookups_agree(sessions, tmp_path: Path):
    writer, reader = sessions
    path = tmp_path / "r.mcap"
    with (
        TransformListener(reader, "arm", history_s=100.0) as listener,
        Recorder(reader, path, ["arm"]) as recorder,
        StatePublisher(writer, RRBOT, "arm") as publisher,
        StaticPublisher(writer, "arm", "lens") as static,
    ):
        static.set(Transform("tool", "lens", [0, 0, 0.1], [0, 0, 0, 1]))
        wait_for_stream_readers(writer, "arm", "joint_states", "tf")
        for n in range(COUNT):
            publisher.publish(
                swing_positions(n / 50), swing_velocities(n / 50), stamp=START + n * 10 * MS + n % 3
            )
        until(lambda: listener.stats.received == COUNT)
        until(lambda: recorder.stats.messages.get(("arm", "joint_states")) == COUNT)
        until(lambda: recorder.stats.messages.get(("arm", "tf_static"), 0) >= 2)
        until(lambda: listener.buffer.can_lookup("tool", "lens"))
        stamps = np.random.default_rng(2).integers(START, START + (COUNT - 1) * 10 * MS, 300)
        live = answers(listener.buffer, stamps)
    assert_same(live, answers(recorded_buffer(path), stamps))
    with Recording(path, "arm") as recording:
        assert_same(live, [recording.lookup_many(*frames, stamps)[0] for frames in PATHS])
    # The publisher of the lens has left since; playback withdraws its edge too.
    with TransformListener(reader, "arm", history_s=100.0) as listener:
        wait_for_stream_readers(writer, "arm")
        with Player(writer, path, ["arm"], rate=10.0) as replayer:
            replayer.run()
        until(lambda: listener.stats.received == COUNT)
        poses, valid = listener.buffer.lookup_many("world", "tool", stamps)
    assert valid.all()
    assert np.array_equal(poses, live[0])


def joint_states(tap: SampleCollector) -> list[JointState]:
    return [decode(arrival.payload, arrival.encoding, JointState) for arrival in tap.arrivals]


def test_playback_keeps_stamps_and_numbers(sessions, arm: Path):
    writer, reader = sessions
    tap = SampleCollector(reader, "zstate/arm/joint_states")
    wait_for_reader(writer, "zstate/arm/joint_states")
    with Player(writer, arm, rate=math.inf) as replayer:
        replayer.run()
    states = tap.joint_states(COUNT)
    assert [state.stamp for state in states] == [START + n * 10 * MS + n % 3 for n in range(COUNT)]
    assert [state.seq for state in states] == list(range(COUNT))
    assert len({state.session for state in states}) == 1
    assert [from_block(state.positions).tolist() for state in states] == [
        swing_positions(n / 50) for n in range(COUNT)
    ]


def test_playback_keeps_the_spacing_of_samples(sessions, arm: Path):
    clock = SteppingClock(5)
    with Player(sessions[0], arm, rate=2.0, clock=clock) as replayer:
        report = replayer.run()
    expected = {(LATENCY + n * 10 * MS + n % 3) // 2 + 5 for n in range(COUNT)}
    # Half nanoseconds are rounded to even ones.
    assert len(expected - {wait + off for wait in clock.waits for off in (-1, 0, 1)}) == 0
    assert clock.waits == sorted(clock.waits)
    assert (report.samples, report.lateness_max, report.delays) == (COUNT, 0, 0)
    assert math.isclose(report.rate, 2.0, rel_tol=1e-6)


def test_lateness_is_reported(sessions, arm: Path):
    clock = SteppingClock(5, {50: 40 * MS})
    with Player(sessions[0], arm, clock=clock) as replayer:
        report = replayer.run()
    # 40 ms late at one wait, which the samples of the next 40 ms, four at most, cannot quite make up for.
    assert 30 * MS < report.lateness_max <= 40 * MS
    assert report.lateness_p50 == 0


def test_start_within_the_recording_has_the_latched_values_of_that_time(sessions, tmp_path: Path):
    path = tmp_path / "r.mcap"
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm")
        builder.statics("arm", START, {("tool", "lens"): pose(z=0.1)})
        builder.statics("arm", START + S, {("tool", "lens"): pose(z=0.2)})
        for n in range(5):
            builder.joints("arm", START + n * S, swing_positions(n))
        builder.statics("arm", START + 4 * S + MS, {("tool", "lens"): pose(z=0.3)})
    writer, reader = sessions
    tap = SampleCollector(reader, "zstate/arm/joint_states")
    heights: list[float] = []

    def collect(arrival: SerializedSample) -> None:
        message = decode(arrival.payload, arrival.encoding, StaticTransforms)
        heights.append(from_block(message.poses)[2])

    wait_for_reader(writer, "zstate/arm/joint_states")
    with (
        LatchedSubscriber(reader, "zstate/arm/tf_static/camera", collect),
        Player(writer, path, rate=math.inf, start_s=2.0, duration_s=2.5) as replayer,
    ):
        wait_for_reader(writer, "zstate/arm/tf_static/camera")
        assert replayer.run().samples == 3
        until(lambda: len(heights) == 2)
    assert heights == [0.2, 0.3]
    assert [state.stamp for state in tap.joint_states(3)] == [START + n * S for n in (2, 3, 4)]


def test_each_pass_of_a_loop_starts_a_new_epoch(sessions, arm: Path):
    writer, reader = sessions
    tap, clocks = SampleCollector(reader, "zstate/arm/joint_states"), SampleCollector(reader, "zstate/clock")
    with TransformListener(reader, "arm", history_s=100.0) as listener:
        wait_for_stream_readers(writer, "arm")
        with replaying(Player(writer, arm, rate=100.0, loop=True)):
            until(lambda: len(tap.arrivals) > 3 * COUNT)
        until(lambda: listener.stats.received > 3 * COUNT)
        assert not listener.stats.refused
    by_session: dict[int, list[JointState]] = {}
    for state in joint_states(tap):
        by_session.setdefault(state.session, []).append(state)
    assert len(by_session) >= 3
    for states in list(by_session.values())[:3]:
        assert [state.seq for state in states] == list(range(COUNT))
        assert states[0].stamp == START
    until(
        lambda: (
            len({decode(p, encoding_of(ClockMessage), ClockMessage).session for p in clocks.payloads(1)}) >= 3
        )
    )


def test_recording_time_is_published_on_the_clock(sessions, arm: Path):
    writer, reader = sessions
    tap = SampleCollector(reader, "zstate/clock")
    wait_for_reader(writer, "zstate/clock")
    with Player(writer, arm, rate=5.0, clock=SteppingClock()) as replayer:
        replayer.run()
        first, last = replayer.span
        # 100 times a second at five times the speed: every 50 ms of the recording.
        expected = list(range(first, last + 1, 50 * MS))
        stamps = [
            decode(p, encoding_of(ClockMessage), ClockMessage).stamp for p in tap.payloads(len(expected))
        ]
    assert stamps == expected


def test_recorded_clock_is_published_unchanged(sessions, tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(5):
            builder.encoder.write_message("ros", ClockMessage(n * MS, n, 9), START + n * S)
    writer, reader = sessions
    tap = SampleCollector(reader, "zstate/clock")
    wait_for_reader(writer, "zstate/clock")
    with Player(writer, tmp_path / "r.mcap", rate=math.inf) as replayer:
        replayer.run()
    assert [decode(p, encoding_of(ClockMessage), ClockMessage).stamp for p in tap.payloads(5)] == [
        n * MS for n in range(5)
    ]


def test_player_can_be_paused_and_resumed(sessions, arm: Path):
    tap = SampleCollector(sessions[1], "zstate/arm/joint_states")
    clocks = SampleCollector(sessions[1], "zstate/clock")
    wait_for_reader(sessions[0], "zstate/arm/joint_states")
    replayer = Player(sessions[0], arm)
    replayer.pause()
    assert replayer.is_paused
    with replaying(replayer) as reports:
        until(lambda: len(clocks.arrivals) > CLOCK_HZ)  # at least a second, as long as the recording
        assert not tap.arrivals
        replayer.resume()
        assert not replayer.is_paused
        tap.payloads(COUNT)
        until(lambda: reports)
    assert reports[0].rate > 0.5  # the pause does not count


def test_player_can_seek(sessions, arm: Path):
    tap = SampleCollector(sessions[1], "zstate/arm/joint_states")
    wait_for_reader(sessions[0], "zstate/arm/joint_states")
    replayer = Player(sessions[0], arm)
    half = START + 500 * MS
    replayer.seek(half)
    with replaying(replayer) as reports:
        until(lambda: reports)
    assert joint_states(tap)[0].stamp >= half - S // 100
    assert reports[0].passes == 1
    with Player(sessions[0], arm) as other, pytest.raises(InvalidInput, match="is not between"):
        other.seek(START - 1)


def test_seek_during_playback_starts_new_writers(sessions, arm: Path):
    tap = SampleCollector(sessions[1], "zstate/arm/joint_states")
    wait_for_reader(sessions[0], "zstate/arm/joint_states")
    replayer = Player(sessions[0], arm)
    with replaying(replayer) as reports:
        tap.payloads(10)
        replayer.seek(replayer.span[0])
        until(lambda: reports)
    assert reports[0].passes == 2
    assert len({state.session for state in joint_states(tap)}) == 2


def test_player_ends_when_it_is_closed(sessions, arm: Path):
    replayer = Player(sessions[0], arm, rate=0.001)
    with replaying(replayer) as reports:
        until(lambda: replayer.report().passes)
        replayer.close()
        until(lambda: reports)
    assert reports[0].samples < COUNT


def test_robot_without_a_model_is_published_unchanged(sessions, tmp_path: Path):
    path = tmp_path / "r.mcap"
    with RecordingBuilder(path, "cart") as builder:
        for n in range(20):
            builder.edges(
                "cart", START + n * 10 * MS, {("odom", "base"): pose(n), ("map", "odom"): pose(1.0)}
            )
    writer, reader = sessions
    tap = SampleCollector(reader, "zstate/cart/tf")
    with TransformListener(reader, "cart", follow="tf") as listener:
        wait_for_stream_readers(writer, "cart", "tf")
        with Player(writer, path, rate=math.inf) as replayer:
            assert replayer.run().samples == 20
        found = listener.buffer.wait("map", "base", START + 55 * MS, timeout_s=DEADLINE_S)
        expected = recorded_buffer(path).lookup("map", "base", START + 55 * MS)
    assert np.array_equal(found.pose7, expected.pose7)
    samples = [decode(p, encoding_of(TransformSample), TransformSample) for p in tap.payloads(20)]
    assert [(sample.stamp, sample.seq) for sample in samples] == [(START + n * 10 * MS, n) for n in range(20)]


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_ros_bag_is_played_back_natively(sessions, tmp_path: Path, storage: StoragePlugin):
    with Bag(tmp_path / "bag", storage) as bag:
        bag.describe()
        bag.tf(START, [Transform("tool", "lens", [0, 0, 0.1], [0, 0, 0, 1], 0)], "/tf_static")
        bag.tf(START, [Transform("world", "base", [0, 0, 0], [0, 0, 0, 1], 0)], "/tf_static")
        for n in range(50):
            stamp = START + n * 10 * MS
            bag.joints(stamp, dict(zip(RRBOT.joint_names, swing_positions(n / 50), strict=True)))
            bag.tf(stamp, [Transform("map", "world", [n, 0, 0], [0, 0, 0, 1], stamp)])
    writer, reader = sessions
    stamps = np.random.default_rng(4).integers(START, START + 490 * MS, 100)
    known = recorded_buffer(tmp_path / "bag")
    with (
        TransformListener(reader, "ros") as joints,
        TransformListener(reader, "ros", follow="tf") as edges,
    ):
        wait_for_stream_readers(writer, "ros", "joint_states", "tf")
        with Player(writer, tmp_path / "bag", rate=math.inf) as replayer:
            replayer.run()
        until(lambda: joints.stats.received == edges.stats.received == 50)
        until(lambda: joints.buffer.can_lookup("tool", "lens"))
        for source in ("tool", "lens"):
            poses, valid = joints.buffer.lookup_many("world", source, stamps)
            assert valid.all()
            assert np.array_equal(poses, known.lookup_many("world", source, stamps)[0])
        poses, valid = edges.buffer.lookup_many("map", "world", stamps)
        assert valid.all()
        assert np.array_equal(poses, known.lookup_many("map", "world", stamps)[0])


def test_robot_is_played_back_to_ros(sessions, arm: Path):
    wire = "ros2:domain=3,namespace=*,frame_prefix=*/"
    writer, reader = sessions
    with TransformListener(reader, wire=wire, history_s=100.0) as listener:
        wait_for_reader(writer, RmwKeys(Ros2Options(domain=3, namespace="*")).key("arm", "joint_states"))
        replayer = Player(writer, arm, wires=("native", wire), rate=math.inf)
        replayer.pause()
        with replaying(replayer) as reports:
            # Until it has the model or all tokens, a listener also receives, and counts, /tf.
            until(lambda: [one.kind for one in listener.buffer.frames(("arm/upper",))] == ["joint"])
            replayer.resume()
            until(lambda: reports)
        assert not reports[0].refused
        until(lambda: listener.stats.received == COUNT)
        until(lambda: listener.buffer.can_lookup("tool", "lens"))
        stamps = np.arange(START, START + 900 * MS, 7 * MS)
        assert_same(answers(listener.buffer, stamps), answers(recorded_buffer(arm), stamps))


def test_model_replaced_in_the_recording_is_replaced_in_playback(sessions, tmp_path: Path):
    longer = parse_urdf(RRBOT.urdf.replace('"0 0 0.6"', '"0 0 0.9"'), "longer")
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        for second, model in ((0, RRBOT), (1, longer)):
            builder.describe("arm", model, session=second, at=START + second * S)
            for n in range(10):
                stamp = START + second * S + n * 10 * MS
                builder.joints("arm", stamp, swing_positions(n), session=second, model=model)
    writer, reader = sessions
    with TransformListener(reader, "arm") as listener:
        wait_for_stream_readers(writer, "arm")
        with Player(writer, tmp_path / "r.mcap", rate=5.0) as replayer:
            assert replayer.run().samples == 20
        until(lambda: listener.stats.received == 20)
        # Models come apart from samples, and between two of them there is none.
        until(lambda: listener.buffer.wait("lower", "tool", timeout_s=DEADLINE_S).translation[2] == 0.9)
    known = recorded_buffer(tmp_path / "r.mcap")
    assert known.lookup("lower", "tool").translation[2] == 0.9


def test_unpublishable_messages_are_counted(sessions, tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        for n, elbow in enumerate([0.5, math.nan, 0.25]):
            bag.joints(START + n * MS, {"shoulder": 0.5, "elbow": elbow})
        bag.joints(START + 4 * MS, {"shoulder": 0.5})
    with Player(sessions[0], tmp_path / "bag", rate=math.inf) as replayer:
        report = replayer.run()
    assert (report.samples, report.refused) == (2, {"not representable": 1, "missing joints": 1})


def test_truncated_recording_is_played_as_far_as_possible(sessions, tmp_path: Path):
    path = tmp_path / "r.mcap"
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm")
        for n in range(1000):
            builder.joints("arm", START + n * MS, swing_positions(n))
            if n % 100 == 0:
                builder.writer.flush()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with Player(sessions[0], path, rate=math.inf) as replayer:
        report = replayer.run()
    assert 200 < report.samples < 900


def test_invalid_playback_arguments_are_refused(sessions, arm: Path):
    session = sessions[0]
    with pytest.raises(InvalidInput, match="no robot 'leg'; its robots: 'arm'"):
        Player(session, arm, ["leg"])
    with pytest.raises(InvalidInput, match="start_s is 5"):
        Player(session, arm, start_s=5.0)
    with pytest.raises(InvalidInput, match="duration_s"):
        Player(session, arm, duration_s=0.0)
    with pytest.raises(InvalidInput, match="rate above 0"):
        Player(session, arm, rate=0.0)


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    """A recording of one map alone."""
    path = tmp_path / "maps.mcap"
    grid = OccupancyGrid(4, START, "map", 0.5, 1, 1, to_block([0, 0, 0, 0, 0, 0, 1]), b"\x64")
    with RecordingBuilder(path) as builder:
        builder.encoder.write_message("hall", grid, START, "floor")
    return path


@contextmanager
def received_maps(session: Session) -> Iterator[dict[str, bytes]]:
    """The cells of the maps of the hall by key, until they are withdrawn."""
    found: dict[str, bytes] = {}

    def add(arrivals: list[Received]) -> None:
        found.update((one.key, one.message.cells) for one in arrivals)

    with subscribe(
        session, get_wire("native"), "hall", "map", add, on_withdrawn=lambda key: found.pop(key, None)
    ):
        yield found


def test_recording_of_maps_is_published_until_it_is_closed(sessions, maps: Path):
    writer, reader = sessions
    with Player(writer, maps) as player, received_maps(reader) as received:
        assert player.is_held
        with replaying(player) as reports:
            until(lambda: received == {"zstate/hall/map/floor": b"\x64"})
            player.seek(START)
            until(lambda: player.report().passes == 2)
            assert not reports
        assert [report.refused for report in reports] == [{}]
        until(lambda: not received)


@pytest.mark.parametrize("options", [{"duration_s": 0.05}, {"rate": math.inf}])
def test_recording_of_maps_ends_after_its_duration_or_at_once(sessions, maps: Path, options):
    with Player(sessions[0], maps, **options) as player:
        assert not player.is_held
        player.run()
        assert player.position == START + round(options.get("duration_s", 0.0) * 1e9)
