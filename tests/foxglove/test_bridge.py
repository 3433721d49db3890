"""FoxgloveBridge: what a client of Foxglove decodes, beside lookups and recordings of the same robots."""

from __future__ import annotations

import json
import os
import subprocess
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.access_routers import join, router_with_users
from helpers.foxglove_client import FoxgloveClient
from helpers.processes import repeated, until
from helpers.robots import RRBOT, STAMP, UPRIGHT, wait_for_reader, wait_for_stream_readers
from mcap.reader import make_reader

from zstate.fleet.acl import AclRoles
from zstate.foxglove.bridge import FoxgloveBridge
from zstate.foxglove.server import SUBPROTOCOLS, FoxgloveServer, ServedMessage
from zstate.net.discovery import discover_readers
from zstate.nodes.clock import ClockPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.nodes.stream_publisher import StreamPublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import FixPublisher, OdometryPublisher
from zstate.recording.recorder import Recorder
from zstate.se3 import to_matrix
from zstate.sources import SineSource
from zstate.transform import Transform

PERIOD = 10_000_000
CLIENT = str(Path(__file__).parents[1] / "helpers" / "foxglove_client.js")
TOPICS = ("/joint_states", "/tf", "/tf_static", "/robot_description")


def stamp_of(header: Any) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def edges_of(message: Any) -> dict[str, tuple[str, np.ndarray]]:
    """Parent and pose (4, 4) of each child of a TFMessage."""
    found = {}
    for edge in message.transforms:
        move, turn = edge.transform.translation, edge.transform.rotation
        pose = [move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w]
        found[edge.child_frame_id] = edge.header.frame_id, to_matrix(np.array(pose))
    return found


def prefixes(client: FoxgloveClient, topic: str) -> set[str]:
    """The robots in the names of the child frames of all messages of a topic."""
    messages = client.messages(topic)
    return {edge.child_frame_id.split("/")[0] for message in messages for edge in message.transforms}


def placed(edges: dict[str, tuple[str, np.ndarray]], root: str, frame: str) -> np.ndarray:
    """``root_from_frame``, the product of the edges between them."""
    pose = np.eye(4)
    while frame != root:
        frame, parent_from_child = edges[frame]
        pose = parent_from_child @ pose
    return pose


def test_decoded_transforms_joints_and_description_are_those_of_lookups(sessions, serve):
    writer, reader = sessions
    sine = SineSource(RRBOT)
    sent = {STAMP + k * PERIOD: sine.read(STAMP + k * PERIOD).positions for k in range(50)}
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1") as listener,
        FoxgloveClient(serve("r1").url) as client,
    ):
        client.subscribe(*TOPICS)
        client.until(lambda: {"/tf_static", "/robot_description"} <= client.frames.keys())
        wait_for_stream_readers(writer, "r1", "joint_states", "tf")
        for stamp, positions in sent.items():
            publisher.publish(positions, stamp=stamp)
        client.until(lambda: all(len(client.frames.get(topic, ())) == 50 for topic in TOPICS[:2]))
        (static,) = client.messages("/tf_static")
        transforms = client.messages("/tf")
        assert [stamp_of(message.transforms[0].header) for message in transforms] == list(sent)
        listener.buffer.lookup("world", "tool", at=STAMP + 49 * PERIOD, timeout_s=5.0)
        for stamp, message in zip(sent, transforms, strict=True):
            edges = edges_of(static) | edges_of(message)
            for frame in edges:
                looked_up = listener.buffer.lookup("world", frame, at=stamp).matrix
                assert np.abs(placed(edges, "world", frame) - looked_up).max() < 1e-9
        for (stamp, positions), message in zip(sent.items(), client.messages("/joint_states"), strict=True):
            assert stamp_of(message.header) == stamp
            assert tuple(message.name) == RRBOT.joint_names
            assert message.position == pytest.approx(positions, abs=1e-9)
        (description,) = client.messages("/robot_description")
        client.request("getParameters", parameterNames=[], id="all")
        client.until(lambda: client.parameters)
        assert client.parameters == {"/robot_description": RRBOT.urdf}
        assert description.data == RRBOT.urdf


def test_clouds_give_way_to_other_messages(sessions, serve, monkeypatch: pytest.MonkeyPatch):
    clouds = pytest.importorskip("zstate.clouds")
    sent: list[ServedMessage] = []
    send = FoxgloveServer.send

    def recorded_send(server: FoxgloveServer, messages: Sequence[ServedMessage]) -> None:
        sent.extend(messages)
        send(server, messages)

    monkeypatch.setattr(FoxgloveServer, "send", recorded_send)
    with (
        StatePublisher(sessions[0], RRBOT, "r1") as publisher,
        clouds.CloudPublisher(sessions[0], "r1", "top", frame="tool") as lidar,
        FoxgloveClient(serve("r1").url) as client,
    ):
        client.subscribe("/joint_states", "/top")
        wait_for_stream_readers(sessions[0], "r1", "joint_states", "cloud/top")
        with repeated(lambda: (publisher.publish(RRBOT.neutral), lidar.publish(np.ones((100, 3))))):
            client.until(lambda: {"/joint_states", "/top"} <= client.frames.keys())
        payloads = {payload: topic for topic, frames in client.frames.items() for _, payload in frames}
    gives_way = {payloads[one.payload]: one.is_bulk for one in sent if one.payload in payloads}
    assert gives_way == {"/joint_states": False, "/top": True}


@pytest.mark.npm
@pytest.mark.parametrize("subprotocol", SUBPROTOCOLS)
def test_the_published_client_decodes_what_lookups_answer(sessions, serve, subprotocol: str):
    writer, reader = sessions
    node_js, packages = os.environ["ZSTATE_NODE"], os.environ["ZSTATE_FOXGLOVE_CLIENT"]
    counts = {"/tf": 20, "/joint_states": 20, "/tf_static": 1, "/robot_description": 1}
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1") as listener,
        subprocess.Popen(
            [node_js, CLIENT, packages, serve("r1").url, subprotocol, json.dumps(counts)],
            stdout=subprocess.PIPE,
            text=True,
        ) as node,
    ):
        assert node.stdout is not None
        assert node.stdout.readline() == "subscribed\n"
        wait_for_stream_readers(writer, "r1", "joint_states", "tf")
        sent = {STAMP + k * PERIOD: (0.1 * k, -0.05 * k) for k in range(20)}
        for stamp, positions in sent.items():
            publisher.publish(positions, stamp=stamp)
        decoded = json.loads(node.stdout.readline())
        listener.buffer.lookup("world", "tool", at=max(sent), timeout_s=5.0)

        def edges(message: dict[str, Any]) -> dict[str, tuple[str, np.ndarray]]:
            poses = {one["child_frame_id"]: one["transform"] for one in message["transforms"]}
            parents = [one["header"]["frame_id"] for one in message["transforms"]]
            blocks = [[*pose["translation"].values(), *pose["rotation"].values()] for pose in poses.values()]
            return dict(zip(poses, zip(parents, map(to_matrix, np.array(blocks)), strict=True), strict=True))

        for stamp, message in zip(sent, decoded["/tf"], strict=True):
            known = edges(decoded["/tf_static"][0]) | edges(message)
            for frame in known:
                looked_up = listener.buffer.lookup("world", frame, at=stamp).matrix
                assert np.abs(placed(known, "world", frame) - looked_up).max() < 1e-9
    assert [tuple(message["position"]) for message in decoded["/joint_states"]] == list(sent.values())
    assert decoded["/robot_description"] == [{"data": RRBOT.urdf}]
    assert decoded["parameters"] == {"/robot_description": RRBOT.urdf}


def test_messages_have_the_bytes_of_a_recording(sessions, serve, tmp_path: Path):
    writer, reader = sessions
    path = tmp_path / "run.mcap"
    with ExitStack() as opened:
        robot = opened.enter_context(StatePublisher(writer, RRBOT, "r1"))
        wheels = opened.enter_context(OdometryPublisher(writer, "r1", "wheels"))
        tracker = opened.enter_context(TransformPublisher(writer, "r1", "tracker"))
        gps = opened.enter_context(FixPublisher(writer, "r1", "gps"))
        client = opened.enter_context(FoxgloveClient(serve("r1").url))
        recorder = opened.enter_context(Recorder(reader, path, ["r1"]))

        def publish(k: int) -> None:
            stamp, place = STAMP + k * PERIOD, (0.1 * k, 0.0, 0.0)
            robot.publish([0.1 * k, -0.2 * k], stamp=stamp)
            wheels.publish(
                Transform("odom", "world", place, UPRIGHT), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), stamp
            )
            ball = Transform("world", "ball", place, UPRIGHT).with_covariance(np.eye(6))
            tracker.publish([ball], stamp)
            gps.publish(47.5, 8.0 + k, None, stamp, covariance=np.eye(3))

        def received(number: int, *topics: str) -> bool:
            return all(len(client.frames.get(topic, ())) == number for topic in topics)

        client.subscribe(*TOPICS, "/wheels", "/gps")
        until(lambda: Counter(one.stream for one in discover_readers(writer, 0.3))["transforms"] == 2)
        publish(0)
        client.until(lambda: received(3, "/tf"))
        client.subscribe("/pose_with_covariance/ball")  # its channel comes with the first covariance
        client.drain()
        for k in range(1, 10):
            publish(k)
        client.until(lambda: received(30, "/tf") and received(10, "/wheels", "/gps", "/joint_states"))
        client.until(lambda: received(9, "/pose_with_covariance/ball"))
        for topic in (*TOPICS, "/wheels", "/gps"):
            client.unsubscribe(topic)
        client.drain()
        publish(10)  # covariances are received without /tf
        client.until(lambda: received(10, "/pose_with_covariance/ball"))
        until(lambda: sum(recorder.stats.messages["r1", one] for one in ("tf", "transforms")) == 33)
    with path.open("rb") as stream:
        recorded: dict[str, set[bytes]] = {}
        schemas = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            recorded.setdefault(channel.topic, set()).add(message.data)
            schemas[channel.topic] = schema.name, schema.data.decode(), channel.message_encoding
    for topic, frames in client.frames.items():
        assert {payload for _, payload in frames} <= recorded[topic], topic
        channel = client.channels[topic]
        assert (channel["schemaName"], channel["schema"], channel["encoding"]) == schemas[topic]
    assert client.frames.keys() == recorded.keys()


def test_only_streams_that_a_client_displays_are_received(sessions, serve):
    writer, reader = sessions

    def read() -> set[str]:
        return {one.stream for one in discover_readers(reader, 0.3) if one.robot == "r1"}

    with StatePublisher(writer, RRBOT, "r1") as publisher, FoxgloveClient(serve().url) as client:
        client.until(lambda: set(TOPICS) <= client.channels.keys())
        assert read() == set()
        client.subscribe("/joint_states")
        wait_for_stream_readers(writer, "r1", "joint_states")
        until(lambda: read() == {"joint_states"})
        publisher.publish([0.1, 0.2], stamp=STAMP)
        client.until(lambda: client.frames.get("/joint_states"))
        assert client.frames.keys() == {"/joint_states"}
        client.subscribe("/tf")
        until(lambda: read() == {"joint_states", "tf"})
        client.unsubscribe("/joint_states")
        until(lambda: read() == {"tf"})
    until(lambda: read() == set())


def test_an_identity_that_may_only_view_suffices(tmp_path: Path):
    roles = AclRoles(robots=("r1",), viewers=("desk",))
    with (
        router_with_users(tmp_path, roles, ["r1", "desk"]) as endpoint,
        join(endpoint, "r1") as robot,
        join(endpoint, "desk") as desk,
        StatePublisher(robot, RRBOT, "r1") as publisher,
        FoxgloveServer(port=0) as server,
        FoxgloveBridge(desk, server),
        FoxgloveClient(server.url) as client,
    ):
        client.subscribe(*TOPICS)
        wait_for_stream_readers(robot, "r1", "joint_states", "tf")
        publisher.publish([0.1, 0.2], stamp=STAMP)
        client.until(lambda: client.frames.keys() == set(TOPICS))


def test_robots_come_and_go_with_namespaces_and_frame_prefixes(sessions, serve):
    writer, _ = sessions
    with StatePublisher(writer, RRBOT, "left") as left, FoxgloveClient(serve("left", "right").url) as client:
        client.subscribe("/left/joint_states", "/tf", "/tf_static")
        client.until(lambda: client.frames.get("/tf_static"))
        with StatePublisher(writer, RRBOT, "right") as right:
            client.subscribe("/right/joint_states", "/right/robot_description")
            client.until(lambda: client.frames.get("/right/robot_description"))
            client.request("getParameters", parameterNames=["/right/robot_description"], id="x")
            client.until(lambda: client.parameters.get("/right/robot_description") == RRBOT.urdf)
            client.request("subscribeParameterUpdates", parameterNames=["/right/robot_description"])
            client.drain()
            wait_for_stream_readers(writer, "right", "joint_states", "tf")
            for publisher in (left, right):
                publisher.publish([0.1, 0.2], stamp=STAMP)
            client.until(lambda: len(client.frames.get("/tf", ())) == 2)
            client.until(lambda: prefixes(client, "/tf_static") == {"left", "right"})
            assert prefixes(client, "/tf") == {"left", "right"}
        client.until(lambda: not any(topic.startswith("/right/") for topic in client.channels))
        client.until(lambda: client.parameters["/right/robot_description"] is None)
        assert {
            "/left/joint_states",
            "/left/robot_description",
            "/tf",
            "/tf_static",
        } <= client.channels.keys()
        # The robot returns on the same topics, and what is latched comes again.
        client.frames.clear()
        with StatePublisher(writer, RRBOT, "right"):
            client.until(lambda: client.parameters["/right/robot_description"] == RRBOT.urdf)
            client.subscribe("/right/robot_description")
            client.until(lambda: client.frames.get("/right/robot_description"))


def test_static_edges_reach_clients_that_subscribe_later_and_again(sessions, serve):
    writer, _ = sessions
    server = serve("r1")
    with StaticPublisher(writer, "r1", "camera") as static, FoxgloveClient(server.url) as client:
        static.set(Transform("tool", "camera", (0.0, 0.0, 0.1), UPRIGHT))
        for _ in range(2):
            client.subscribe("/tf_static")
            client.until(lambda: client.frames.get("/tf_static"))
            (edge,) = client.messages("/tf_static")[-1].transforms
            assert (edge.header.frame_id, edge.child_frame_id) == ("tool", "camera")
            with FoxgloveClient(server.url) as late:
                late.subscribe("/tf_static")
                late.until(lambda late=late: late.frames.get("/tf_static"))
                assert late.frames["/tf_static"][-1][1] == client.frames["/tf_static"][-1][1]
            client.unsubscribe("/tf_static")
            client.drain()
            client.frames.clear()


def test_simulated_time_is_broadcast_and_is_the_time_of_messages(sessions, serve):
    writer, _ = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        ClockPublisher(writer) as clock,
        FoxgloveClient(serve("r1").url) as client,
    ):
        client.subscribe("/joint_states")
        wait_for_stream_readers(writer, "r1", "joint_states")
        assert "time" not in client.infos[0]["capabilities"]
        clock.publish(5_000_000_000)
        client.until(lambda: client.times)
        assert client.times == [5_000_000_000]
        first, second = client.infos
        assert "time" in second["capabilities"]
        assert first["sessionId"] != second["sessionId"]
        publisher.publish([0.1, 0.2], stamp=5_000_000_000)
        client.until(lambda: client.frames.get("/joint_states"))
        assert client.frames["/joint_states"][0][0] == 5_000_000_000
        assert client.channels["/clock"]["schemaName"] == "rosgraph_msgs/msg/Clock"


def test_stream_of_another_package_is_served_in_json(sessions, serve, battery_plugin):
    writer, _ = sessions
    with (
        StreamPublisher(writer, "r1", battery_plugin, "main") as publisher,
        FoxgloveClient(serve("r1").url) as client,
    ):
        client.subscribe("/battery/main")
        wait_for_reader(writer, "zstate/r1/battery/main")
        publisher.publish(STAMP, voltage=24.5, charge=0.75)
        client.until(lambda: client.frames.get("/battery/main"))
    channel = client.channels["/battery/main"]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
    assert channel["schemaName"] == "zstate_battery.Battery"
    described = json.loads(channel["schema"])
    assert described["type"] == "object"
    assert described["properties"]["charge"] == {"type": "number"}
    ((_, payload),) = client.frames["/battery/main"]
    fields = json.loads(payload)
    assert (fields["stamp"], fields["voltage"], fields["charge"]) == (STAMP, 24.5, 0.75)
