"""Playback of a stream with an active writer is refused, with or without a model."""

from __future__ import annotations

import math
import threading
from collections import defaultdict
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until
from helpers.recording_builder import MS, START, Bag, RecordingBuilder, S, pose, recorded_buffer
from helpers.robots import RRBOT, SampleCollector, wait_for_reader, wait_for_stream_readers
from helpers.tokens import current_tokens
from msgspec import structs

from zstate.errors import SecondWriter
from zstate.net.session import connect
from zstate.net.subscription import Received, subscribe
from zstate.nodes.listener import TransformListener
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import (
    Datum,
    DatumPublisher,
    FixPublisher,
    ImuPublisher,
    MagneticFieldPublisher,
    OdometryPublisher,
    PosePublisher,
    PressurePublisher,
    VelocityPublisher,
)
from zstate.odometry.messages import MapDatum, Odometry
from zstate.recording.decode import DecodedRecording
from zstate.recording.player import Player
from zstate.recording.reader import RecordingReader
from zstate.recording.recorder import Recorder
from zstate.scans import ScanPublisher
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.transform import Transform
from zstate.wire.keys import WRITER_TOKEN
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import JointState, TransformSample, order_digest, poses_from_block, to_block
from zstate.wire.native import decode, encoding_of
from zstate.wire.registry import get_wire
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import RmwKeys

SCAN_STREAMS = ("scan", "map")
ODOMETRY_STREAMS = ("imu", "velocity", "pose", "fix", "magnetic_field", "pressure", "odometry")

COUNT = 20
SENSORS = (
    *("imu/chest", "velocity/flow", "pose/mocap", "fix/gps", "magnetic_field/mag", "pressure/bmp"),
    "odometry/wheels",
)
CAMERA = Transform("cart/base", "cart/camera", [1, 0, 0], [0, 0, 0, 1])


@pytest.fixture
def cart(tmp_path: Path) -> Path:
    """A cart without a model, on which two writers have put the same camera."""
    path = tmp_path / "cart.mcap"
    with RecordingBuilder(path, "cart") as builder:
        for writer in ("mount", "gripper"):
            builder.statics("cart", START, {("cart/base", "cart/camera"): pose(z=0.1)}, writer=writer)
        for n in range(COUNT):
            builder.edges("cart", START + n * 10 * MS, {("odom", "base"): pose(n)})
    return path


@pytest.fixture
def tracked(tmp_path: Path) -> Path:
    """A cart without a model, with two writers of transforms."""
    path = tmp_path / "tracked.mcap"
    with RecordingBuilder(path, "cart") as builder:
        for n in range(COUNT):
            stamp = START + n * 10 * MS
            builder.edges("cart", stamp, {("odom", "base"): pose(y=n)}, session=5, writer="odometry")
            builder.edges("cart", stamp, {("odom", "ball"): pose(x=n)}, session=6, writer="camera")
    return path


def replay(session, path: Path, **options: object) -> int:
    with Player(session, path, rate=math.inf, **options) as replayer:
        return replayer.run().samples


def test_samples_of_an_active_writer_are_played_only_with_takeover(sessions, cart: Path):
    with StatePublisher(sessions[0], RRBOT, "cart", streams=["tf"], program="driver"):
        until(lambda: current_tokens(sessions[1], "zstate/cart/@writer/$*tf$*/*", 1.0))
        with pytest.raises(SecondWriter) as raised:
            replay(sessions[1], cart)
        assert (raised.value.stream, raised.value.first.program) == ("tf", "driver")
        assert replay(sessions[1], cart, takeover=True) == COUNT
    assert replay(sessions[1], cart) == COUNT


@pytest.mark.parametrize(("name", "edge"), [("mount", None), ("room", ("cart/base", "cart/camera"))])
def test_static_edges_of_an_active_writer_are_played_only_with_takeover(
    sessions, cart: Path, name: str, edge: tuple[str, str] | None
):
    with StaticPublisher(sessions[0], "cart", name, program="calibration") as live:
        live.set(CAMERA)
        with pytest.raises(SecondWriter) as raised:
            replay(sessions[1], cart)
        assert (raised.value.edge, raised.value.first.program) == (edge, "calibration")
        assert replay(sessions[1], cart, takeover=True) == COUNT


def test_playback_excludes_other_writers_of_its_streams(sessions, cart: Path):
    with Player(sessions[0], cart, rate=0.01) as replayer:
        thread = threading.Thread(target=replayer.run)
        thread.start()
        until(lambda: current_tokens(sessions[1], "zstate/cart/@writer/$*tf$*/*", 1.0))
        with pytest.raises(SecondWriter):
            StatePublisher(sessions[1], RRBOT, "cart", streams=["tf"])
        replayer.close()
        thread.join()


def test_passes_of_a_loop_do_not_conflict(sessions, cart: Path):
    with Player(sessions[0], cart, rate=math.inf, loop=True) as replayer:
        thread = threading.Thread(target=replayer.run)
        thread.start()
        until(lambda: replayer.report().passes >= 5)
        replayer.close()
        thread.join()
    assert not replayer.report().refused


def test_ownership_is_the_same_behind_a_router(cart: Path, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        connect(mode="router", listen=endpoint),
        connect(mode="client", endpoints=endpoint) as ours,
        connect(mode="client", endpoints=endpoint) as theirs,
        StatePublisher(theirs, RRBOT, "cart", streams=["tf"]),
    ):
        until(lambda: current_tokens(ours, "zstate/cart/@writer/$*tf$*/*", 1.0))
        with pytest.raises(SecondWriter):
            replay(ours, cart)


def test_transforms_are_played_by_writers_of_the_same_names(sessions, tracked: Path):
    with (
        closing(SampleCollector(sessions[0], "zstate/cart/transforms/odometry")) as odometry,
        closing(SampleCollector(sessions[0], "zstate/cart/transforms/camera")) as camera,
    ):
        wait_for_stream_readers(sessions[1], "cart", "transforms/odometry", "transforms/camera")
        assert replay(sessions[1], tracked) == 2 * COUNT
        for collector, edge, column in ((odometry, ("odom", "base"), 1), (camera, ("odom", "ball"), 0)):
            payloads = collector.payloads(COUNT)
            samples = [decode(one, encoding_of(TransformSample), TransformSample) for one in payloads]
            assert [sample.edges for sample in samples] == [(edge,)] * COUNT
            assert [sample.seq for sample in samples] == list(range(COUNT))
            assert [sample.stamp for sample in samples] == [START + n * 10 * MS for n in range(COUNT)]
            poses = [poses_from_block(sample.poses)[0, column] for sample in samples]
            assert poses == list(range(COUNT))


@pytest.fixture
def restarted(tmp_path: Path) -> Path:
    """A cart whose writers of transforms were replaced by one with another name in the middle."""
    path = tmp_path / "restarted.mcap"
    with RecordingBuilder(path, "cart") as builder:
        for n in range(2 * COUNT):
            stamp = START + n * 10 * MS
            base, ball = {("odom", "base"): pose(y=n)}, {("odom", "ball"): pose(x=n)}
            if n < COUNT:
                builder.edges("cart", stamp, base, session=5, writer="odometry-12-ab")
                builder.edges("cart", stamp, ball, session=6, writer="camera-13-cd")
            else:
                builder.edges("cart", stamp, base | ball, session=7, writer="rover-99-ef")
    return path


def test_writer_restarted_under_another_name_is_played_without_loss(sessions, restarted: Path):
    with (
        TransformListener(sessions[0], "cart", history_s=100.0) as listener,
        Player(sessions[1], restarted, rate=math.inf) as player,
    ):
        wait_for_stream_readers(sessions[1], "cart", "transforms/odometry", "transforms/camera")
        assert player.run().samples == 3 * COUNT
        stamps = [START + n * 10 * MS for n in range(2 * COUNT)]
        for child in ("base", "ball"):
            listener.buffer.lookup("cart/odom", f"cart/{child}", stamps[-1], timeout_s=DEADLINE_S)
        base, has_base = listener.buffer.lookup_many("cart/odom", "cart/base", stamps)
        ball, has_ball = listener.buffer.lookup_many("cart/odom", "cart/ball", stamps)
        assert has_base.all()
        assert has_ball.all()
        assert base[:, 1].tolist() == ball[:, 0].tolist() == list(range(2 * COUNT))
        assert not listener.stats.refused


@pytest.mark.parametrize("names", [("rover", "rover"), ("rover-1", "rover-2")])
def test_frame_that_a_restarted_writer_places_on_another_is_played(
    sessions, tmp_path: Path, names: tuple[str, str]
):
    path = tmp_path / "moved.mcap"
    with RecordingBuilder(path, "cart") as builder:
        builder.edges("cart", START, {("odom", "ball"): pose(x=1)}, session=5, writer=names[0])
        # As live, listeners refuse the first ones until they have processed that the other writer left.
        for n in range(20 * COUNT):
            builder.edges(
                "cart", START + S + n * 50 * MS, {("map", "ball"): pose(x=2)}, session=6, writer=names[1]
            )
    with TransformListener(sessions[0], "cart") as listener, Player(sessions[1], path) as player:
        thread = threading.Thread(target=player.run)
        thread.start()
        until(lambda: listener.buffer.can_lookup("cart/map", "cart/ball"))
        player.close()
        thread.join()
        assert listener.buffer.lookup("cart/map", "cart/ball").translation[0] == 2.0


def test_covariances_are_played_with_their_samples(sessions, tmp_path: Path):
    path, known = tmp_path / "run.mcap", np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    with RecordingBuilder(path, "cart") as builder:
        poses = {("odom", "base"): pose(x=1), ("odom", "ball"): pose(y=2)}
        builder.edges("cart", START, poses, writer="odometry", covariances={("odom", "base"): known})
        builder.edges("cart", START + MS, poses, writer="odometry")
    with (
        TransformListener(sessions[0], "cart") as listener,
        Player(sessions[1], path, rate=math.inf) as player,
    ):
        assert player.run().samples == 2
        without = listener.buffer.lookup("cart/odom", "cart/base", START + MS, timeout_s=DEADLINE_S)
        assert without.covariance is None
        found = listener.buffer.lookup("cart/odom", "cart/base", START)
        assert np.array_equal(found.covariance, known)
        assert listener.buffer.lookup("cart/odom", "cart/ball", START).covariance is None


def test_transforms_of_an_active_writer_are_played_only_with_takeover(sessions, tracked: Path):
    with TransformPublisher(sessions[0], "cart", "odometry", program="driver") as live:
        until(lambda: current_tokens(sessions[1], WRITER_TOKEN.expression("cart"), 1.0))
        with pytest.raises(SecondWriter) as raised:
            replay(sessions[1], tracked)
        assert (raised.value.edge, raised.value.first.program) == (None, "driver")
        assert replay(sessions[1], tracked, takeover=True) == 2 * COUNT
    with TransformPublisher(sessions[0], "cart", "other", program="driver") as live:
        live.publish([Transform("odom", "base", [0, 0, 0], [0, 0, 0, 1])])
        until(lambda: current_tokens(sessions[1], "zstate/cart/@edge/**", 1.0))
        with pytest.raises(SecondWriter) as raised:
            replay(sessions[1], tracked)
        assert raised.value.edge == ("cart/odom", "cart/base")


SHOULDER, ELBOW = RRBOT.joint_names


@pytest.fixture
def drivers(tmp_path: Path) -> Path:
    """An arm with two drivers at different rates; one is restarted in the middle, under another name."""
    path = tmp_path / "drivers.mcap"
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm")
        for n in range(2 * COUNT):
            at = START + n * 10 * MS
            name, session = ("lower-1", 4) if n < COUNT else ("lower-2", 6)
            builder.part("arm", at, {SHOULDER: math.sin(n)}, name, session=session, velocities=[n])
            if n % 3 == 0:
                builder.part("arm", at + 3 * MS, {ELBOW: math.cos(n)}, "upper", session=5)
    return path


def assert_listener_has_the_recorded_joints(sessions, path: Path, robot: str):
    """Play a recording; a listener's positions and poses equal those of the file, bit for bit."""
    tool, recorded = RRBOT.links[-1], recorded_buffer(path)
    newest = recorded.latest("world", tool)
    stamps = np.random.default_rng(5).integers(START + 3 * MS, newest, 200)
    with TransformListener(sessions[0], robot, history_s=100.0) as listener:
        wait_for_stream_readers(sessions[1], robot, "partial_joint_states/any", "robot_description")
        samples = replay(sessions[1], path)
        until(lambda: listener.stats.received == samples)
        until(lambda: listener.buffer.can_lookup("world", tool, newest))
        positions, valid = listener.buffer.joint_positions_many(robot, stamps)
        poses, _ = listener.buffer.lookup_many("world", tool, stamps)
        assert not listener.stats.refused
    assert valid.all()
    assert np.array_equal(positions, recorded.joint_positions_many(robot, stamps)[0])
    assert np.array_equal(poses, recorded.lookup_many("world", tool, stamps)[0])


def test_listener_has_the_joints_of_played_drivers_bit_for_bit(sessions, drivers: Path):
    assert_listener_has_the_recorded_joints(sessions, drivers, "arm")


def test_drivers_are_played_on_the_keys_of_their_names(sessions, drivers: Path):
    with (
        closing(SampleCollector(sessions[0], "zstate/arm/partial_joint_states/lower-1")) as lower,
        closing(SampleCollector(sessions[0], "zstate/arm/partial_joint_states/upper")) as upper,
    ):
        names = "partial_joint_states/lower-1", "partial_joint_states/upper"
        wait_for_stream_readers(sessions[1], "arm", *names)
        replay(sessions[1], drivers)
        # The restarted driver continues as its predecessor.
        samples = [decode(one, encoding_of(JointState), JointState) for one in lower.payloads(2 * COUNT)]
        assert {sample.names for sample in samples} == {(SHOULDER,)}
        assert [sample.seq for sample in samples] == list(range(2 * COUNT))
        assert [sample.velocities for sample in samples] == [
            np.float64(n).tobytes() for n in range(2 * COUNT)
        ]
        assert len(upper.payloads(-(-2 * COUNT // 3))) == -(-2 * COUNT // 3)


def test_joints_of_an_active_driver_are_played_only_with_takeover(sessions, drivers: Path):
    with PartialStatePublisher(sessions[0], RRBOT, [ELBOW], "arm", writer="wrist", program="wrist.py"):
        until(lambda: current_tokens(sessions[1], "zstate/arm/@writer/$*partial_joint_states$*/*", 1.0))
        with pytest.raises(SecondWriter) as raised:
            replay(sessions[1], drivers)
        assert raised.value.first.program == "wrist.py"
        assert replay(sessions[1], drivers, takeover=True) > 2 * COUNT


def test_nodes_of_a_bag_are_played_as_drivers(sessions, tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        for n in range(COUNT):
            bag.joints(START + n * 10 * MS, {SHOULDER: math.sin(n)})
            bag.joints(START + n * 10 * MS + 3 * MS, {ELBOW: math.cos(n)})
    assert_listener_has_the_recorded_joints(sessions, tmp_path / "bag", "ros")


@pytest.fixture
def scanned(tmp_path: Path) -> Path:
    """Scans of two sensors of a cart, and a map of a hall that changes and is withdrawn."""
    path, geometry = tmp_path / "scanned.mcap", (-2.0, 0.5, 1000, 4000, 0.125, 8.0)
    with RecordingBuilder(path) as builder:
        for n, cells in enumerate((b"\0\x64", b"\xff\0")):
            grid = OccupancyGrid(4, START, "map", 0.5, 2, 1, to_block([1, 2, 0, 0, 0, 0, 1]), cells)
            builder.encoder.write_message("hall", grid, START + n * 50 * MS, "floor")
        for n in range(COUNT):
            stamp, ranges = START + n * 10 * MS, to_float32_block([n, math.inf, math.nan])
            front = LaserScan(stamp, n, 5, "laser", *geometry, ranges, ranges)
            rear = LaserScan(stamp, n, 6, "fleet/laser", *geometry, ranges)
            builder.encoder.write_message("cart", front, stamp, "front")
            builder.encoder.write_message("cart", rear, stamp, "rear")
        builder.encoder.withdraw("hall", "map", "floor", START + 195 * MS)
    return path


def scans_and_maps(path: Path) -> dict[tuple[str, str | None], list[object]]:
    """The messages of each writer, without its session."""
    found: defaultdict[tuple[str, str | None], list[object]] = defaultdict(list)
    with RecordingReader(path) as reader:
        for writer, message, _ in DecodedRecording(reader, lambda *_: None).messages(streams=SCAN_STREAMS):
            facts = structs.asdict(message)
            del facts["session"]
            found[writer.robot, writer.edge_writer].append(facts)
    return dict(found)


def recorded_scans_and_maps(recorder: Recorder) -> int:
    return sum(count for (_, stream), count in recorder.stats.messages.items() if stream in SCAN_STREAMS)


@pytest.mark.parametrize("robots", [(), ("cart",)])
def test_scans_and_maps_are_replayed_and_recorded_again_as_they_were(
    sessions, scanned: Path, tmp_path: Path, robots: tuple[str, ...]
):
    writer, reader = sessions
    again, expected = tmp_path / "again.mcap", scans_and_maps(scanned)
    if robots:
        del expected["hall", "floor"]
    with Recorder(reader, again, ["cart", "hall"]) as recorder:
        for sensor in ("front", "rear"):
            wait_for_reader(writer, f"zstate/cart/scan/{sensor}")
        with Player(writer, scanned, robots) as player:
            report = player.run()
        until(lambda: recorded_scans_and_maps(recorder) >= sum(map(len, expected.values())))
    assert (report.samples, report.refused) == (2 * COUNT, {})
    assert scans_and_maps(again) == expected


def test_playback_in_the_middle_starts_with_the_map_in_effect(sessions, scanned: Path):
    writer, reader = sessions
    received: list[OccupancyGrid] = []

    def add(arrivals: list[Received]) -> None:
        received.extend(one.message for one in arrivals)

    with (
        subscribe(reader, get_wire("native"), "hall", "map", add),
        Player(writer, scanned, start_s=0.1) as player,
    ):
        player.run()
        until(lambda: received)
    assert [one.cells for one in received] == [b"\xff\0"]


def test_an_active_sensor_is_not_replayed(sessions, scanned: Path):
    writer, reader = sessions
    geometry = {"angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.0, "range_max": 1.0}
    with ScanPublisher(reader, "cart", "rear", **geometry):
        until(lambda: current_tokens(writer, WRITER_TOKEN.expression("cart"), 1.0))
        with pytest.raises(SecondWriter, match="rear"):
            replay(writer, scanned)
        assert replay(writer, scanned, takeover=True) == 2 * COUNT


@pytest.fixture
def driven(sessions, tmp_path: Path) -> Path:
    """A cart with a sensor of each kind and odometry, recorded from the native wire."""
    writer, reader = sessions
    path = tmp_path / "driven.mcap"
    with (
        ImuPublisher(writer, "cart", "chest") as imu,
        VelocityPublisher(writer, "cart", "flow") as velocity,
        OdometryPublisher(writer, "cart", "wheels") as odometry,
        PosePublisher(writer, "cart", "mocap") as mocap,
        FixPublisher(writer, "cart", "gps") as gps,
        PressurePublisher(writer, "cart", "bmp") as barometer,
        MagneticFieldPublisher(writer, "cart", "mag", covariance=np.eye(3) * 1e-14) as mag,
        Recorder(reader, path, ["cart"]) as recorder,
    ):
        wait_for_stream_readers(writer, "cart", *SENSORS)
        for n in range(COUNT):
            stamp = START + n * 10 * MS
            imu.publish([n, 0, 0], [0, 0, 9.81], stamp)
            velocity.publish([n, 0, 0], stamp=stamp)
            base = Transform("odom", "base", [n, 0, 0], [0, 0, 0, 1]).with_covariance(np.eye(6) * (n + 1))
            odometry.publish(base, [n, 0, 0], [0, 0, 0], stamp)
            mocap.publish(base, stamp)
            barometer.publish(101325.0 - n, stamp, variance=2.25 if n % 2 else None)
            mag.publish([n * 1e-6, 0, -4e-5], stamp)
            if n % 2:
                gps.publish(47.5, n, 450.0, stamp, covariance=np.eye(3) * (n + 1), status=2, service=9)
            else:
                gps.publish(None, None, None, stamp, status=-1)
        until(lambda: measured(recorder) == len(SENSORS) * COUNT)
    return path


def measured(recorder: Recorder) -> int:
    return sum(count for (_, stream), count in recorder.stats.messages.items() if stream in ODOMETRY_STREAMS)


def test_sensors_and_odometry_are_replayed_as_they_were_recorded(sessions, driven: Path, tmp_path: Path):
    writer, reader = sessions

    def messages(path: Path) -> list[object]:
        with RecordingReader(path) as opened:
            decoded = DecodedRecording(opened, lambda *_: None).messages(streams=ODOMETRY_STREAMS)
            facts = [
                (one.writer.stream, one.writer.edge_writer, structs.asdict(one.message) | {"session": 0})
                for one in decoded
            ]
        return sorted(facts, key=lambda fact: (fact[0], fact[2]["seq"]))

    again = tmp_path / "again.mcap"
    with (
        TransformListener(reader, "cart") as listener,
        Recorder(reader, again, ["cart"]) as recorder,
    ):
        wait_for_stream_readers(writer, "cart", *SENSORS)
        with Player(writer, driven) as player:
            report = player.run()
        until(lambda: measured(recorder) == len(SENSORS) * COUNT)
        found = listener.buffer.wait("odom", "base", START + 50 * MS, timeout_s=DEADLINE_S)
    assert (report.samples, report.refused) == (len(SENSORS) * COUNT, {})
    assert messages(again) == messages(driven)
    assert found.translation[0] == 5.0
    assert found.covariance == pytest.approx(np.eye(6) * 6)


def test_the_datum_of_a_map_is_recorded_and_replayed_as_the_latched_value_that_it_is(
    sessions, tmp_path: Path
):
    writer, reader = sessions
    path, found = tmp_path / "run.mcap", list[MapDatum]()
    with (
        DatumPublisher(writer, "cart", "site/map") as publisher,
        Recorder(reader, path, ["cart"]) as recorder,
    ):
        for count, datum in enumerate((Datum(47.5, 8.25, 450.0), Datum(47.5, 8.5, 450.0)), 1):
            publisher.set(datum)
            until(lambda count=count: recorder.stats.messages.get(("cart", "datum")) == count)

    def on_messages(received: list[Received]) -> None:
        for one in received:
            assert isinstance(one.message, MapDatum)
            found.append(one.message)

    with (
        subscribe(reader, get_wire("native"), "cart", "datum", on_messages),
        Player(writer, path, rate=math.inf) as player,
    ):
        player.run()
        until(lambda: found and found[-1].longitude == 8.5)
    assert (found[-1].frame, found[-1].datum) == ("site/map", Datum(47.5, 8.5, 450.0))


def test_odometry_is_replayed_to_ros_with_its_edge_on_tf(sessions, driven: Path):
    writer, reader = sessions
    samples: list[Received] = []
    with (
        TransformListener(reader, "cart", wire="ros2", follow="tf") as listener,
        subscribe(reader, get_wire("ros2"), "cart", "odometry", samples.extend),
        Player(writer, driven, wires="ros2") as player,
    ):
        for stream, name in (("odometry", "wheels"), ("tf", "")):
            wait_for_reader(writer, RmwKeys(Ros2Options()).key("cart", stream, name))
        assert player.run().samples == (len(SENSORS) + 1) * COUNT
        assert (
            listener.buffer.wait("odom", "base", START + 50 * MS, timeout_s=DEADLINE_S).translation[0] == 5.0
        )
        until(lambda: len(samples) == COUNT)


def test_odometry_of_ros_nodes_is_no_edge_on_the_native_wire(sessions, tmp_path: Path):
    path = tmp_path / "ros.mcap"
    edge = (("odom", "base"),)
    with RecordingBuilder(path, "cart") as builder:
        builder.edges("cart", START, {edge[0]: pose(1)}, session=5)
        head = (START, 1, 6, order_digest(edge))
        sample = Odometry(*head, to_block(pose(2)), edge, None, to_block([0.0] * 6))
        builder.encoder.write_message("cart", sample, START, "odom")
    assert replay(sessions[0], path) == 1
    assert recorded_buffer(path).lookup("odom", "base", START).translation[0] == 1.0
