"""zstate and other implementations of ROS 2 over Zenoh exchange messages through a router process."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count, islice

import numpy as np
import pytest
from helpers.processes import until
from helpers.robots import RRBOT, SECOND, STAMP, assert_pose, kinematic_pose
from helpers.tokens import current_tokens
from peers import DOMAIN, Peer, repeat_until
from ros_messages import (
    JOINT_STATE,
    LASER_SCAN,
    OCCUPANCY_GRID,
    STRING,
    TF_MESSAGE,
    edges_of,
    joint_state,
    laser_scan,
    occupancy_grid,
    tf_message,
    transform_stamped,
)

from zstate.buffer.buffer import TransformBuffer
from zstate.net.session import Session, connect
from zstate.net.subscription import Received, subscribe
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.scans import Grid, MapPublisher, Scan, ScanListener, ScanPublisher
from zstate.scans.grid import grid_from_message
from zstate.scans.messages import OccupancyGrid
from zstate.transform import Transform
from zstate.wire.registry import get_wire

WIRE = f"ros2:domain={DOMAIN}"
POSITIONS, VELOCITIES = [0.4, -1.25], [0.5, 2.0]
TURN = [0.1, -0.2, 0.3, 0.0, 0.0, 0.6, 0.8]
# Exact in float32: 1953125 ns are 2^-9 s.
RAY_NS = 1_953_125
SCAN = laser_scan(
    STAMP, "laser", (-0.5, 0.25, 0.25, 2.0**-9, 0.0, 0.125, 8.0), [1.0, 9.5, 2.5, 0.5], [3.0] * 4
)
CELLS = [[0, 100, -1], [50, 1, 0]]
GRID = occupancy_grid(STAMP, "map", 0.25, TURN, CELLS)

SDK = pytest.param("sdk", marks=pytest.mark.sdk)
PYZEROS = pytest.param("pyzeros", marks=pytest.mark.pyzeros)
KILTED = pytest.param("kilted", marks=pytest.mark.kilted)
every_peer = pytest.mark.parametrize("peer", [SDK, PYZEROS, KILTED], indirect=True)
# pyzeros has no transient local durability, and its peer no scans.
every_peer_that_latches = pytest.mark.parametrize("peer", [SDK, KILTED], indirect=True)
# zenoh-ros2-sdk signs with numbers of its own, not with the hash of its token.
every_peer_that_signs = pytest.mark.parametrize("peer", [PYZEROS, KILTED], indirect=True)
pytestmark = pytest.mark.processes


def subscribe_late(peer: Peer, router: str, topic: str, type: str) -> None:
    """Subscribe a latched topic once ``router`` knows its publisher: zenoh-ros2-sdk looks for it once."""
    token = f"@ros2_lv/{DOMAIN}/*/*/*/MP/*/*/*/%{topic.removeprefix('/')}/**"
    with connect(mode="client", endpoints=router) as other:
        until(lambda: current_tokens(other, token, 1.0))
    peer.subscribe(topic, type, latched=True)


def advertise_edges(peer: Peer) -> None:
    peer.advertise("/tf_static", TF_MESSAGE, latched=peer.can_latch)
    peer.advertise("/tf", TF_MESSAGE)


def publish_edges(peer: Peer, stamp: int = STAMP) -> None:
    """world, hand and camera, each TURN from the one before; the hand moves."""
    peer.publish("/tf_static", tf_message(transform_stamped(stamp, "hand", "camera", TURN)))
    peer.publish("/tf", tf_message(transform_stamped(stamp, "world", "hand", TURN)))


def until_nothing_is_missed(
    listener: TransformListener, publish: Callable[[int], object], frame: str
) -> None:
    """Waits until ten samples in a row arrive that place ``frame``: some are lost while links are made."""
    stamps = count(STAMP + 1)

    def arrive() -> bool:
        missed, last = listener.stats.missed, 0
        for last in islice(stamps, 10):
            publish(last)
        # If the last one is lost, a later one shows how many were.
        repeat_until(lambda: publish(next(stamps)), lambda: listener.buffer.can_lookup("world", frame, last))
        return listener.stats.missed == missed

    until(arrive)


@every_peer
def test_peer_receives_joint_states_as_published(peer: Peer, session: Session):
    peer.subscribe("/joint_states", JOINT_STATE)
    with StatePublisher(session, RRBOT, "r1", wires=(WIRE,)) as publisher:
        received = peer.receive(
            "/joint_states", lambda: publisher.publish(POSITIONS, VELOCITIES, stamp=STAMP)
        )
    assert received == joint_state(STAMP, RRBOT.joint_names, POSITIONS, VELOCITIES)


@every_peer
def test_peer_receives_the_moving_edges_of_a_robot(peer: Peer, session: Session):
    peer.subscribe("/tf", TF_MESSAGE)
    with StatePublisher(session, RRBOT, "r1", wires=(WIRE,)) as publisher:
        received = peer.receive("/tf", lambda: publisher.publish(POSITIONS, stamp=STAMP))
        moving = publisher.description().moving_edges
    assert {edge["header"]["stamp"]["nanosec"] for edge in received["transforms"]} == {STAMP % SECOND}
    assert set(edges_of(received)) == set(moving)
    for (parent, child), matrix in edges_of(received).items():
        assert np.allclose(matrix, kinematic_pose(RRBOT, POSITIONS, parent, child), rtol=0, atol=1e-12)


@every_peer_that_latches
def test_late_peer_receives_the_model_and_the_fixed_edges(peer: Peer, router: str, session: Session):
    with StatePublisher(session, RRBOT, "r1", wires=(WIRE,)):
        subscribe_late(peer, router, "/robot_description", STRING)
        assert peer.receive("/robot_description") == {"data": RRBOT.urdf}
        subscribe_late(peer, router, "/tf_static", TF_MESSAGE)
        received = peer.receive("/tf_static")
    assert edges_of(received)
    for (parent, child), matrix in edges_of(received).items():
        assert np.allclose(matrix, kinematic_pose(RRBOT, POSITIONS, parent, child), rtol=0, atol=1e-12)


@every_peer_that_latches
def test_late_peer_receives_a_static_edge(peer: Peer, router: str, session: Session):
    with StaticPublisher(session, "r1", "camera_mount", wires=WIRE) as statics:
        statics.set(Transform.from_pose7("tool", "camera", TURN))
        subscribe_late(peer, router, "/tf_static", TF_MESSAGE)
        assert peer.receive("/tf_static") == tf_message(transform_stamped(0, "tool", "camera", TURN))


@every_peer
def test_a_listener_computes_transforms_from_the_joint_states_of_a_peer(peer: Peer, session: Session):
    peer.advertise("/robot_description", STRING, latched=peer.can_latch)
    peer.advertise("/joint_states", JOINT_STATE)

    def publish(stamp: int = STAMP) -> None:
        peer.publish("/robot_description", {"data": RRBOT.urdf})
        peer.publish("/joint_states", joint_state(stamp, RRBOT.joint_names, POSITIONS, VELOCITIES))

    with TransformListener(session, "r1", wire=WIRE) as listener:
        buffer = listener.buffer
        repeat_until(publish, lambda: buffer.can_lookup("world", "tool", STAMP))
        expected = kinematic_pose(RRBOT, POSITIONS, "world", "tool")
        assert_pose(buffer.lookup("world", "tool", STAMP), expected)
        until_nothing_is_missed(listener, publish, "tool")
        assert not listener.stats.refused


@every_peer
def test_listener_inserts_moving_and_static_edges_of_a_peer(peer: Peer, session: Session):
    advertise_edges(peer)
    with TransformListener(session, "r1", wire=WIRE, follow="tf") as listener:
        buffer = listener.buffer
        repeat_until(lambda: publish_edges(peer), lambda: buffer.can_lookup("world", "camera", STAMP))
        once = Transform.from_pose7("world", "hand", TURN).matrix
        assert_pose(buffer.lookup("world", "camera", STAMP), once @ once)
        until_nothing_is_missed(listener, lambda stamp: publish_edges(peer, stamp), "camera")
        assert not listener.stats.refused


@every_peer_that_signs
def test_listener_names_the_writer_of_an_edge_by_its_node(peer: Peer, session: Session):
    advertise_edges(peer)
    with TransformListener(session, "r1", wire=WIRE, follow="tf") as listener:
        wanted = {"r1/hand": f"/{peer.node}", "r1/camera": f"/{peer.node}"}

        def writers() -> dict[str, str | None]:
            return {frame.name: frame.writer for frame in listener.buffer.frames() if frame.parent}

        repeat_until(lambda: publish_edges(peer), lambda: writers() == wanted)


@pytest.mark.parametrize("peer", [KILTED], indirect=True)
def test_late_listener_receives_the_model_and_the_static_edges(peer: Peer, session: Session):
    peer.advertise("/robot_description", STRING, latched=True)
    advertise_edges(peer)
    peer.publish("/robot_description", {"data": RRBOT.urdf})
    publish_edges(peer)
    # A second reader of the bridge proves that the bridge has them.
    with TransformListener(session, "r1", wire=WIRE, follow="tf") as early:
        until(lambda: early.buffer.can_lookup("hand", "camera"))
    with TransformListener(session, "r1", wire=WIRE) as late:
        until(lambda: {"r1/tool", "r1/camera"} <= {frame.name for frame in late.buffer.frames()})


@every_peer_that_latches
def test_peer_receives_a_scan_as_published(peer: Peer, session: Session):
    peer.subscribe("/front", LASER_SCAN)
    geometry = {"angle_min": -0.5, "angle_increment": 0.25, "range_min": 0.125, "range_max": 8.0}
    with ScanPublisher(session, "r1", "front", WIRE, ray_ns=RAY_NS, frame="laser", **geometry) as publisher:
        received = peer.receive(
            "/front", lambda: publisher.publish(SCAN["ranges"], STAMP, SCAN["intensities"])
        )
    assert received == SCAN


@every_peer_that_latches
def test_listener_places_the_scans_of_a_peer(peer: Peer, session: Session):
    peer.advertise("/front", LASER_SCAN)
    buffer = TransformBuffer()
    buffer.insert_static(Transform.from_pose7("r1/odom", "r1/laser", TURN))
    with ScanListener(session, "r1", "odom", buffer=buffer, wire=WIRE) as scans:
        repeat_until(lambda: peer.publish("/front", SCAN), lambda: len(scans))
        placed = next(iter(scans))
    scan = Scan(STAMP, -0.5, 0.25, RAY_NS, SCAN["ranges"], 0.125, 8.0)
    assert (placed.sensor, placed.stamp, placed.scan.ray_ns) == ("front", STAMP, RAY_NS)
    assert placed.valid.tolist() == [True, False, True, True]
    expected = Transform.from_pose7("odom", "laser", TURN).apply(scan.points())
    assert np.allclose(placed.points, expected, rtol=0, atol=1e-6, equal_nan=True)
    assert not scans.refused


@every_peer_that_latches
def test_late_peer_receives_the_map(peer: Peer, router: str, session: Session):
    with MapPublisher(session, "hall", Grid(CELLS, 0.25, TURN, stamp=STAMP), WIRE):
        subscribe_late(peer, router, "/map", OCCUPANCY_GRID)
        assert peer.receive("/map") == GRID


@every_peer_that_latches
def test_map_of_a_peer_is_received(peer: Peer, session: Session):
    peer.advertise("/map", OCCUPANCY_GRID, latched=True)
    maps: list[Grid] = []

    def on_messages(received: list[Received]) -> None:
        for robot, _, message in received:
            assert isinstance(message, OccupancyGrid)
            maps.append(grid_from_message(message, robot))

    with subscribe(session, get_wire(WIRE), "hall", "map", on_messages):
        repeat_until(lambda: peer.publish("/map", GRID), lambda: maps)
    assert (maps[0].stamp, maps[0].frame, maps[0].resolution) == (STAMP, "hall/map", 0.25)
    assert maps[0].cells.tolist() == CELLS
    assert maps[0].origin.pose7.tolist() == TURN


@every_peer
def test_peer_publishes_and_subscribes_in_a_namespace(peer: Peer, session: Session):
    wire = f"{WIRE},namespace=*"
    peer.subscribe("/r1/joint_states", JOINT_STATE)
    peer.advertise("/r2/joint_states", JOINT_STATE)
    state = joint_state(STAMP, RRBOT.joint_names, POSITIONS)
    with (
        StatePublisher(session, RRBOT, "r1", wires=(wire,)) as publisher,
        TransformListener(session, "*", wire=wire) as listener,
    ):
        assert peer.receive("/r1/joint_states", lambda: publisher.publish(POSITIONS, stamp=STAMP)) == state
        repeat_until(lambda: peer.publish("/r2/joint_states", state), lambda: "r2" in listener.robots())
