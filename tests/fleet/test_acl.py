"""Access control on the native wire, enforced by a router with the robots r1 and r2."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest
import zenoh
from helpers.access_routers import (
    assert_only_allowed_writes_arrive,
    publish_and_check,
    replies,
    router_with_users,
)
from helpers.processes import DEADLINE_S, find_free_port, repeated, until
from helpers.robots import RRBOT, UPRIGHT, SampleCollector

from zstate import StatePublisher, StaticPublisher, Transform, TransformListener, connect, discover
from zstate.errors import AccessDenied, InvalidInput, SecondWriter
from zstate.fleet.acl import AclRoles, access_control
from zstate.fleet.router_config import access_text
from zstate.net.discovery import discover_readers
from zstate.net.latched import LatchedPublisher, LatchedSubscriber
from zstate.net.presence import announce
from zstate.net.session import Session
from zstate.net.sites import SITE_TOKEN
from zstate.net.streams import KeyPublisher, StreamSubscriber
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.nodes.publisher import STREAMS
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.stream_registry import own_streams
from zstate.wire import keys
from zstate.wire.messages import TransformSample, order_digest, to_block
from zstate.wire.native import encode, encoding_of

FLEET = AclRoles(
    ("r1", "r2"), ("desk",), ("hand",), ("simulator",), placers=("site",), commanders=("teleop",)
)
USERS = (*FLEET.identities, "stranger")


class Site:
    """Sessions of clients of a router with users."""

    def __init__(self, endpoint: str, opened: ExitStack) -> None:
        self._endpoint = endpoint
        self._opened = opened

    def join(self, user: str, **more: object) -> Session:
        """A client with the identity ``user``."""
        settings = {
            "mode": "client",
            "connect": {"endpoints": [self._endpoint], "timeout_ms": 5000},
            "scouting": {"multicast": {"enabled": False}},
            "transport": {"auth": {"usrpwd": {"user": user, "password": "secret"}}},
            **more,
        }
        return self._opened.enter_context(connect(settings))


@contextmanager
def a_site(folder: Any, fleet: AclRoles) -> Iterator[Site]:
    with router_with_users(folder, fleet, USERS) as endpoint, ExitStack() as opened:
        yield Site(endpoint, opened)


@pytest.fixture
def site(tmp_path) -> Iterator[Site]:
    with a_site(tmp_path, FLEET) as one:
        yield one


WRITES = [
    ("r1", "zstate/r1/joint_states", True),
    ("r1", "zstate/r1/joint_commands", True),
    ("r1", "zstate/r1/transforms/odometry", True),
    ("r1", "zstate/r2/transforms/odometry", False),
    ("r1", "zstate/r1/partial_joint_states/gripper", True),
    ("r1", "zstate/r2/partial_joint_states/gripper", False),
    ("r1", "zstate/r1/scan/front", True),
    ("r1", "zstate/r2/scan/front", False),
    ("r1", "zstate/r1/map/room", True),
    ("r1", "zstate/r2/map/room", False),
    ("desk", "zstate/r1/map/room", False),
    ("site", "zstate/site/map/room", False),
    ("r1", "zstate/r2/joint_states", False),
    ("r1", "zstate/*/joint_states", False),
    ("r1", "zstate/$*1/joint_states", False),
    ("r1", "zstate/**", False),
    ("r1", "zstate/clock", False),
    ("desk", "zstate/r1/joint_states", False),
    ("desk", "zstate/r1/joint_commands", False),
    ("desk", "zstate/r1/transforms/odometry", False),
    ("desk", "zstate/clock", False),
    ("hand", "zstate/r1/joint_commands", True),
    ("teleop", "zstate/r1/joint_commands", True),
    ("teleop", "zstate/r1/release/teleop", True),
    ("teleop", "zstate/r1/stop/teleop", True),
    ("teleop", "zstate/r1/joint_states", False),
    ("teleop", "zstate/r1/driver", False),
    ("r1", "zstate/r1/joint_setpoints", True),
    ("teleop", "zstate/r1/joint_setpoints", False),
    ("desk", "zstate/r1/stop/desk", True),
    ("desk", "zstate/r1/release/desk", False),
    ("r2", "zstate/r1/stop/r2", True),
    ("site", "zstate/r1/stop/site", True),
    ("teleop", "zstate/r1/relax/teleop", True),
    ("hand", "zstate/r1/relax/hand", True),
    ("r1", "zstate/r1/relax/r1", True),
    ("r2", "zstate/r1/relax/r2", False),
    ("desk", "zstate/r1/relax/desk", False),
    ("simulator", "zstate/r1/relax/simulator", False),
    ("site", "zstate/r1/relax/site", False),
    ("stranger", "zstate/r1/relax/stranger", False),
    ("r2", "zstate/r1/joint_commands", False),
    ("r2", "zstate/r1/release/r2", False),
    ("stranger", "zstate/r1/stop/stranger", False),
    ("hand", "zstate/r1/joint_states", False),
    ("simulator", "zstate/clock", True),
    ("simulator", "zstate/r1/joint_states", False),
    ("stranger", "zstate/r1/joint_states", False),
    ("site", "zstate/site/tf_static/map", True),
    ("site", "zstate/site/joint_states", False),
    ("desk", "zstate/r1/partial_joint_states/gripper", False),
    ("site", "zstate/site/transforms/map", False),
    ("site", "zstate/site/partial_joint_states/gripper", False),
    ("site", "zstate/r1/tf_static/map", False),
]


def test_each_role_can_write_only_its_own_keys(site: Site):
    writers = {user: site.join(user) for user in USERS}
    assert_only_allowed_writes_arrive(WRITES, writers, site.join("desk"), "zstate/**")


def test_late_viewer_receives_all_streams(site: Site):
    robot = site.join("r1")
    with (
        StatePublisher(robot, RRBOT, "r1") as publisher,
        StaticPublisher(robot, "r1", "mount") as mount,
    ):
        mount.set(Transform("base", "camera", (0.0, 0.0, 1.0), UPRIGHT))
        viewer = site.join("desk")
        (info,) = discover(viewer)
        assert info.name == "r1"
        assert {stream for stream, _ in info.writers} == set(STREAMS)
        with TransformListener(viewer, "*") as model, TransformListener(viewer, "r1", follow="tf") as poses:
            for listener in (model, poses):
                assert listener.buffer.wait("base", "camera", timeout_s=DEADLINE_S).kind == "static"
                until(lambda reader=listener: publish_and_check(publisher, reader))


def test_robots_read_the_map_of_a_place_but_not_the_scans_of_another_robot(site: Site):
    hall = OccupancyGrid(1, 1, "map", 0.5, 1, 1, to_block([0, 0, 0, 0, 0, 0, 1]), b"\x64")
    front = LaserScan(1, 0, 1, "laser", 0.0, 0.1, 0, 0, 0.0, 1.0, b"")
    received: list[bytes] = []
    keys_of = {"map": "zstate/r2/map/hall", "scan": "zstate/r2/scan/front", "own": "zstate/r1/scan/front"}
    with ExitStack() as opened:
        place, robot = site.join("r2"), site.join("r1")
        published = opened.enter_context(LatchedPublisher(place, keys_of["map"], encoding_of(OccupancyGrid)))
        published.set(encode(hall))
        opened.enter_context(
            LatchedSubscriber(robot, "zstate/*/map/*", lambda one: received.append(one.payload))
        )
        until(lambda: received == [encode(hall)])
        scans: list[str] = []
        opened.enter_context(
            StreamSubscriber(robot, "zstate/*/scan/*", lambda batch: scans.extend(one.key for one in batch))
        )
        foreign = opened.enter_context(KeyPublisher(place, keys_of["scan"], encoding_of(LaserScan)))
        own = opened.enter_context(KeyPublisher(robot, keys_of["own"], encoding_of(LaserScan)))

        def publish() -> None:
            foreign.put(encode(front))
            own.put(encode(front))

        with repeated(publish):
            until(lambda: scans.count(keys_of["own"]) > 10)
        assert set(scans) == {keys_of["own"]}


def test_late_viewer_receives_the_transforms_of_a_robot_and_one_writer_owns_an_edge(site: Site):
    edge = [Transform("odom", "world", (1.0, 0.0, 0.0), UPRIGHT)]
    with (
        TransformPublisher(site.join("r1"), "r1", "odometry") as odometry,
        TransformPublisher(site.join("r1"), "r1", "lidar") as lidar,
    ):
        odometry.publish(edge)
        with TransformListener(site.join("desk"), "*") as late:
            assert late.buffer.wait("odom", "world", timeout_s=DEADLINE_S).translation[0] == 1.0
        with pytest.raises(SecondWriter) as raised:
            lidar.publish(edge)
        assert raised.value.edge == ("r1/odom", "r1/world")
    for user in ("r2", "desk", "site", "stranger"):
        with pytest.raises(AccessDenied, match="'r1'"):
            TransformPublisher(site.join(user), "r1", "odometry")


def test_late_viewer_receives_the_parts_of_a_robot_and_one_driver_owns_a_joint(site: Site):
    joints = RRBOT.joint_names
    with (
        StatePublisher(site.join("r1"), RRBOT, "r1", streams=("robot_description",)),
        PartialStatePublisher(site.join("r1"), RRBOT, joints[:1], "r1") as arm,
        PartialStatePublisher(site.join("r1"), RRBOT, joints[1:], "r1", program="hand.py") as hand,
    ):
        stamp = time.time_ns()
        arm.publish([0.25], stamp=stamp)
        hand.publish([0.5], stamp=stamp)
        with TransformListener(site.join("desk"), "*") as late:
            late.buffer.wait("world", RRBOT.links[-1], timeout_s=DEADLINE_S)
            assert late.buffer.joint_states("r1").positions[-1].tolist() == [0.25, 0.5]
        with pytest.raises(SecondWriter, match=r"hand\.py"):
            PartialStatePublisher(site.join("r1"), RRBOT, joints[1:], "r1")
    for user in ("r2", "desk"):
        with pytest.raises(AccessDenied, match=r"'r1 writes'.*`zstate acl --robot r1`"):
            PartialStatePublisher(site.join(user), RRBOT, joints[:1], "r1")


def test_robot_receives_only_the_clock_of_others(site: Site):
    taps = {
        user: SampleCollector(site.join(user), "zstate/r1/joint_commands")
        for user in ("r1", "r2", "stranger")
    }
    clock = SampleCollector(site.join("r2"), "zstate/clock")
    hand, simulator = site.join("hand"), site.join("simulator")

    def publish_until_received() -> bool:
        hand.zenoh.put("zstate/r1/joint_commands", b"go")
        simulator.zenoh.put("zstate/clock", b"tick")
        return min(len(taps["r1"].arrivals), len(clock.arrivals)) >= 10

    until(publish_until_received)
    assert (taps["r2"].arrivals, taps["stranger"].arrivals) == ([], [])


def test_every_identity_reads_the_states_of_drivers_and_nothing_else_that_they_write(site: Site):
    robot = site.join("r1")
    written = ("driver", "joint_setpoints", "joint_states")
    taps = {user: SampleCollector(site.join(user), "zstate/r1/*") for user in ("r2", "site", "stranger")}
    states = {user: SampleCollector(site.join(user), "zstate/*/driver") for user in taps}

    def publish_until_received() -> bool:
        for name in written:
            robot.zenoh.put(f"zstate/r1/{name}", name.encode())
        return min(len(states[user].arrivals) for user in ("r2", "site")) >= 10

    until(publish_until_received)
    assert states["stranger"].arrivals == []
    assert all(tap.arrivals == [] for tap in taps.values())


def test_a_state_viewer_reads_all_streams_of_a_robot_but_private_ones(tmp_path):
    rows = [row for row in own_streams() if row.group != "time"]
    assert {row.name for row in rows if row.private} == {"image"}
    keys_of = {row.name: f"zstate/r1/{row.name}{'/one' if row.named else ''}" for row in rows}
    fleet = AclRoles(("r1",), ("desk",), state_viewers=("hand",))
    with a_site(tmp_path, fleet) as site:
        robot = site.join("r1")
        readers = {user: site.join(user) for user in ("desk", "hand")}
        taps = {
            (user, name): SampleCollector(session, key)
            for user, session in readers.items()
            for name, key in keys_of.items()
        }
        everything = SampleCollector(site.join("hand"), "zstate/**")

        def publish_until_received() -> bool:
            for key in keys_of.values():
                robot.zenoh.put(key, b"x")
            return all(tap.arrivals for one, tap in taps.items() if one != ("hand", "image"))

        until(publish_until_received)
        assert taps["hand", "image"].arrivals == everything.arrivals == []


def test_a_state_viewer_follows_a_robot_that_it_finds(tmp_path):
    with (
        a_site(tmp_path, AclRoles(("r1",), state_viewers=("desk",))) as site,
        StatePublisher(site.join("r1"), RRBOT, "r1") as publisher,
        TransformListener(site.join("desk"), "r1") as listener,
    ):
        until(lambda: publish_and_check(publisher, listener))
        assert [one.name for one in discover(site.join("desk"))] == ["r1"]


def test_a_robot_may_not_have_the_name_of_the_clock():
    with pytest.raises(InvalidInput, match=r"'clock' is that of the simulated time, 'zstate/clock'"):
        access_control(AclRoles(("clock",)))
    with pytest.raises(InvalidInput, match="/clock of all robots"):
        access_control(AclRoles(("r1",), wires=("ros2:namespace=clock",)))


def test_robot_discovers_others_and_their_static_edges(site: Site):
    with (
        StatePublisher(site.join("r1"), RRBOT, "r1"),
        TransformListener(site.join("r2"), "r1", follow="tf") as listener,
    ):
        assert [info.name for info in discover(site.join("r2"))] == ["r1"]
        assert listener.buffer.wait("world", "base", timeout_s=DEADLINE_S).kind == "static"


def test_named_placer_places_robot_roots_and_robots_only_their_own(site: Site):
    robot, thief, placer = site.join("r1"), site.join("r2"), site.join("site")
    with (
        StatePublisher(robot, RRBOT, "r1") as publisher,
        StaticPublisher(thief, "r2", "thief", takeover=True) as stolen,
        StaticPublisher(placer, "site", "map", takeover=True) as placed,
        TransformListener(site.join("desk"), "*", placers=["site"]) as listener,
        TransformListener(site.join("desk"), "*", follow="tf", placers=["site"]) as poses,
    ):
        stolen.set(Transform("r2/base", "r1/world", (9.0, 0.0, 0.0), UPRIGHT))
        stolen.set(Transform("r2/base", "r1/camera", (9.0, 0.0, 0.0), UPRIGHT))
        for reader in (listener, poses):
            until(lambda reader=reader: reader.stats.refused.get("foreign frame", 0) >= 2)
        placed.set(Transform("map", "r1/world", (1.0, 0.0, 0.0), UPRIGHT))
        with StaticPublisher(robot, "r1", "mount") as mount:
            mount.set(Transform("base", "camera", (2.0, 0.0, 0.0), UPRIGHT))
            for reader in (listener, poses):
                until(lambda reader=reader: publish_and_check(publisher, reader))
                reader.buffer.wait("site/map", "r1/camera", timeout_s=DEADLINE_S)
                assert {frame.writer for frame in reader.buffer.frames(("r1/camera",))} == {"mount"}
                assert "not among the placers ('site')" in reader.refusals["foreign frame"]


def test_robot_announced_as_another_takes_over_no_edges(site: Site):
    robot, thief = site.join("r1"), site.join("r2")
    edges = (("r1/upper", "r1/lower"),)
    with (
        StatePublisher(robot, RRBOT, "r1") as publisher,
        TransformListener(site.join("desk"), "*", follow="tf") as listener,
        KeyPublisher(thief, "zstate/r2/tf", encoding_of(TransformSample)) as stream,
    ):
        until(lambda: publish_and_check(publisher, listener))
        (info,) = discover(site.join("desk"))
        (theirs,) = {writer for stream_of, writer in info.writers if stream_of == "tf"}

        def is_named() -> bool:
            publisher.publish([0.5, 0.25])  # a sample is inserted under the name that is known by then
            return listener.buffer.frames(("r1/lower",))[0].writer == str(theirs)

        until(is_named)
        with announce(thief, f"zstate/r2/@writer/tf/{theirs.identity}"):
            until(lambda: [one.robot for one in listener.events() if one.robot == "r2"])
            before = listener.buffer.frames(("r1/lower",))[0].count
            for seq in range(3):
                sample = (time.time_ns(), seq, theirs.session, order_digest(edges))
                pose = to_block([[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
                stream.put(encode(TransformSample(*sample, pose, edges)))
            until(lambda: listener.stats.refused == {"foreign frame": 3})
        until(lambda: [one.kind for one in listener.events() if one.robot == "r2"][-1] == "left")
        publisher.publish([0.5, 0.25])
        until(lambda: listener.buffer.frames(("r1/lower",))[0].count > before)
        assert listener.stats.refused == {"foreign frame": 3}
        assert listener.buffer.lookup("upper", "lower").translation[0] != 9.0


def test_viewers_discover_all_readers(site: Site):
    with (
        StatePublisher(site.join("r1"), RRBOT, "r1"),
        TransformListener(site.join("r2"), "r1", follow="tf"),
        TransformListener(site.join("hand")),
        TransformListener(site.join("stranger"), "r1"),
    ):
        viewer = site.join("desk")
        until(lambda: {one.robot for one in discover_readers(viewer)} == {"*", "r1"})
        assert {one.stream for one in discover_readers(viewer) if one.robot == "r1"} == {
            "robot_description",
            "tf_static",
            "tf",
            "transforms",
            "odometry",
        }


def test_a_robot_that_is_a_viewer_too_sees_the_others_move(tmp_path):
    with (
        a_site(tmp_path, AclRoles(("r1", "r2"), ("r2",))) as site,
        StatePublisher(site.join("r1"), RRBOT, "r1") as publisher,
        TransformListener(site.join("r2"), "r1") as listener,
    ):
        until(lambda: publish_and_check(publisher, listener))


def test_viewers_query_lookup_services_under_their_own_robot(site: Site):
    robot, other, viewer = site.join("r1"), site.join("r2"), site.join("desk")

    def answer(query: zenoh.Query) -> None:
        query.reply(query.key_expr, b"here")

    robot.zenoh.declare_queryable("zstate/r1/lookup", answer)
    other.zenoh.declare_queryable("zstate/$*1/lookup", answer)

    until(lambda: replies(viewer, "zstate/r1/lookup"))
    assert replies(viewer, "zstate/r1/lookup") == ["here"]


def test_namespace_prefixes_every_key(tmp_path):
    with (
        a_site(tmp_path, AclRoles(("r1",), ("desk",), namespace="hall/east")) as site,
        StatePublisher(site.join("r1", namespace="hall/east"), RRBOT, "r1") as publisher,
        TransformListener(site.join("desk", namespace="hall/east"), "r1") as listener,
    ):
        until(lambda: publish_and_check(publisher, listener))
        assert discover(site.join("desk"), 0.2) == ()  # without any robot


def test_router_without_users_denies_everything(tmp_path):
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    settings = {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "access_control": access_control(AclRoles(("r1",), ("desk",))),
    }
    with (
        connect(settings),
        connect(mode="client", endpoints=endpoint) as one,
        connect(mode="client", endpoints=endpoint) as other,
        StatePublisher(one, RRBOT, "r1"),
    ):
        assert discover(other, 0.3) == ()


def test_rules_name_every_chunk_that_wildcards_skip():
    rows = (*vars(keys).values(), SITE_TOKEN)
    forms = [one for one in rows if isinstance(one, keys.Key) and "/@" in one.form]
    requests = (keys.MOTION, keys.ODOMETRY_REQUEST)
    chunks = {"@adv", *(one.verbatim for one in forms if one not in requests)}
    assert len(chunks) >= 2
    for rule in access_control(AclRoles(("r1",), ("desk",)))["rules"]:
        if rule["id"] in ("r1 writes", "viewers read"):
            root = rule["key_exprs"][0].removesuffix("/**")
            assert {f"{root}/**/{chunk}/**" for chunk in chunks} <= set(rule["key_exprs"])


def test_zenoh_parses_the_text_to_the_same_rules():
    parsed = json.loads(str(zenoh.Config.from_json5(access_text(FLEET))))["access_control"]
    rules_by_section = access_control(FLEET)
    for section in ("rules", "subjects", "policies"):
        named = [{k: v for k, v in one.items() if v is not None} for one in parsed[section]]
        assert named == rules_by_section[section]
    assert (parsed["enabled"], parsed["default_permission"]) == (True, "deny")


def test_rules_without_a_role_are_omitted():
    rules = [rule["id"] for rule in access_control(AclRoles(viewers=("desk", "desk")))["rules"]]
    stops = ["everyone stops", "everyone is asked for stops"]
    assert rules == ["viewers read", "viewers are given", "readers are known", *stops]


@pytest.mark.parametrize("name", ["", "*", "a/b", "two words", "@r1", "r1:x", "x" * 65, "röbi"])
def test_invalid_identity_name_is_refused(name: str):
    with pytest.raises(InvalidInput, match="cannot be the name of an identity"):
        AclRoles((name,))


@pytest.mark.parametrize("namespace", ["/hall", "hall/", "a//b", "h*", "@x"])
def test_invalid_namespace_is_refused(namespace: str):
    with pytest.raises(InvalidInput, match="is not made of chunks"):
        AclRoles(("r1",), namespace=namespace)


def test_roles_without_names_are_refused():
    with pytest.raises(InvalidInput, match="no role has a name"):
        AclRoles()
