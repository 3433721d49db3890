"""Access control on the ROS 2 wire, enforced by a router in a process of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh
from helpers import access_routers
from helpers.access_routers import assert_only_allowed_writes_arrive, publish_and_check, replies
from helpers.processes import DEADLINE_S, Child, until
from helpers.robots import RRBOT, UPRIGHT
from helpers.tokens import current_tokens

from zstate import StatePublisher, StaticPublisher, Transform, TransformListener, discover
from zstate.errors import AccessDenied, InvalidInput
from zstate.fleet.acl import AclRoles, access_control
from zstate.fleet.router_config import access_text
from zstate.net.session import Session
from zstate.wire.ros2.types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, JOINT_STATE, LASER_SCAN, RosType

WIRE = "ros2:domain=7,namespace=*"
FLEET = AclRoles(("r1", "r2"), ("desk",), ("hand",), ("simulator",), wires=(WIRE,), commanders=("teleop",))
USERS = (*FLEET.identities, "stranger")
JOINTS = "sensor_msgs::msg::dds_::JointState_/hash"
TRAJECTORY = "trajectory_msgs::msg::dds_::JointTrajectory_/hash"
NUMBERS = "std_msgs::msg::dds_::Float64MultiArray_/hash"
ENDPOINT = "@ros2_lv/7/z/0/{number}/{kind}/%/%{robot}/node/%{topic}/type/hash/::,10:,:,:,,"

Join = Callable[[str], Session]


@pytest.fixture
def join(tmp_path: Path, spawn: Callable[..., Child], free_port: int) -> Iterator[Join]:
    """``join(user)``: a client of the router with that identity."""
    users, acl = access_routers.write_users(tmp_path, USERS), tmp_path / "acl.json5"
    acl.write_text(access_text(FLEET))
    endpoint = f"tcp/127.0.0.1:{free_port}"
    arguments = ("router", "--listen", endpoint, "--users", str(users), "--acl", str(acl))
    spawn("from zstate.cli.main import main; main()", *arguments).line()
    with ExitStack() as opened:
        yield lambda user: opened.enter_context(access_routers.join(endpoint, user))


WRITES = [
    ("r1", f"7/r1/joint_states/{JOINTS}", True),
    ("r1", f"7/r1/arm/scan/{JOINTS}", True),
    ("r1", f"7/tf/{JOINTS}", True),
    ("r1", f"7/tf_static/{JOINTS}", True),
    ("r1", f"7/rosout/{JOINTS}", True),
    ("r1", f"7/r2/joint_states/{JOINTS}", False),
    ("r1", f"7/r10/joint_states/{JOINTS}", False),
    ("r1", f"7/*/joint_states/{JOINTS}", False),
    ("r1", f"7/joint_states/{JOINTS}", False),
    ("r1", f"7/clock/{JOINTS}", False),
    ("r1", f"5/r1/joint_states/{JOINTS}", False),
    ("r1", "zstate/r1/joint_states", False),
    ("desk", f"7/r1/joint_states/{JOINTS}", False),
    ("desk", f"7/tf/{JOINTS}", False),
    ("hand", f"7/r1/joint_states/{JOINTS}", False),
    ("hand", f"7/r1/arm_controller/commands/{NUMBERS}", True),
    ("teleop", f"7/r1/arm_controller/commands/{NUMBERS}", True),
    ("teleop", f"7/r1/arm_controller/joint_trajectory/{TRAJECTORY}", True),
    ("desk", f"7/r1/arm_controller/joint_trajectory/{TRAJECTORY}", False),
    ("teleop", f"7/r1/arm_controller/state/{NUMBERS}", False),
    ("teleop", f"7/r1/joint_states/{JOINTS}", False),
    ("desk", f"7/r1/arm_controller/commands/{NUMBERS}", False),
    ("r2", f"7/r1/arm_controller/commands/{NUMBERS}", False),
    ("simulator", f"7/clock/{JOINTS}", True),
    ("simulator", f"7/r1/joint_states/{JOINTS}", False),
    ("stranger", f"7/r1/joint_states/{JOINTS}", False),
]


def test_each_role_can_write_only_its_own_topics(join: Join):
    writers = {user: join(user) for user in USERS}
    assert_only_allowed_writes_arrive(WRITES, writers, join("desk"), "7/**", "5/**", "zstate/**")


TOKENS = [
    ("r1", ENDPOINT.format(number=1, kind="MP", robot="r1", topic="r1%joint_states"), True),
    ("r1", ENDPOINT.format(number=2, kind="MP", robot="r1%arm", topic="r1%arm%scan"), True),
    ("r1", ENDPOINT.format(number=3, kind="MP", robot="r1", topic="tf"), True),
    ("r1", ENDPOINT.format(number=4, kind="MS", robot="r1", topic="tf"), True),
    ("r1", "@ros2_lv/7/z/5/5/NN/%/%r1/node", True),
    ("r1", ENDPOINT.format(number=6, kind="MP", robot="r1", topic="r2%joint_states"), False),
    ("r1", ENDPOINT.format(number=7, kind="MP", robot="r2", topic="r1%joint_states"), False),
    ("r1", ENDPOINT.format(number=8, kind="SS", robot="r1", topic="r2%stop"), False),
    ("r1", "@ros2_lv/7/z/9/9/NN/%/%r10/node", False),
    ("desk", ENDPOINT.format(number=11, kind="MS", robot="r1", topic="r1%joint_states"), True),
    ("desk", "@ros2_lv/7/z/12/12/NN/%/%/rviz", True),
    ("desk", ENDPOINT.format(number=13, kind="MP", robot="r1", topic="r1%joint_states"), False),
    ("teleop", ENDPOINT.format(number=16, kind="MP", robot="", topic="r1%arm_controller%commands"), True),
    ("desk", ENDPOINT.format(number=17, kind="MP", robot="", topic="r1%arm_controller%commands"), False),
    ("simulator", ENDPOINT.format(number=14, kind="MP", robot="gz", topic="clock"), True),
    ("stranger", "@ros2_lv/7/z/15/15/NN/%/%r1/node", False),
]


def test_each_role_can_announce_only_its_own_endpoints(join: Join):
    sessions = {user: join(user) for user in USERS}
    tokens = [sessions[user].zenoh.liveliness().declare_token(key) for user, key, _ in TOKENS]
    allowed = {key for _, key, is_allowed in TOKENS if is_allowed}
    for observer in ("hand", "r2"):

        def seen(session: Session = sessions[observer]) -> frozenset[str]:
            return current_tokens(session, "@ros2_lv/7/**", 1.0)

        until(lambda seen=seen: len(seen()) >= len(allowed))
        assert seen() == allowed
    del tokens


def test_late_viewer_receives_all_streams_of_a_robot(join: Join):
    robot = join("r1")
    with (
        StatePublisher(robot, RRBOT, "r1", WIRE) as publisher,
        StaticPublisher(robot, "r1", "mount", WIRE) as mount,
    ):
        mount.set(Transform("base", "camera", (0.0, 0.0, 1.0), UPRIGHT))
        viewer = join("desk")
        assert [info.name for info in discover(viewer, wire=WIRE) if info.name == "r1"] == ["r1"]
        with TransformListener(viewer, "r1", wire=WIRE) as listener:
            listener.buffer.wait("base", "camera", timeout_s=DEADLINE_S)
            until(lambda: publish_and_check(publisher, listener))


@pytest.mark.parametrize("user", ["r2", "desk", "hand"])
def test_writing_as_another_robot_is_denied(join: Join, user: str):
    with pytest.raises(AccessDenied, match="write as robot 'r1'"):
        StatePublisher(join(user), RRBOT, "r1", WIRE)


def test_only_operators_call_services_and_only_their_robot_replies(join: Join):
    robot, other = join("r1"), join("r2")
    service = "7/r1/stop/std_srvs::srv::dds_::Trigger_/hash"

    def answer(query: zenoh.Query) -> None:
        query.reply(service, b"stopped")

    robot.zenoh.declare_queryable(service, answer)
    other.zenoh.declare_queryable(service, lambda query: query.reply(service, b"never"))

    hand = join("hand")
    until(lambda: replies(hand, service))
    assert replies(hand, service) == ["stopped"]
    assert replies(join("desk"), service) == []


def test_a_state_viewer_is_given_no_pictures_compressed_or_raw():
    listed = access_control(AclRoles(state_viewers=("desk",), wires=("ros2:domain=5",)))["rules"]
    given = [
        zenoh.KeyExpr(key) for rule in listed for key in rule["key_exprs"] if rule["id"].startswith("state")
    ]

    def is_given(topic: str, kind: RosType) -> bool:
        key = zenoh.KeyExpr(f"5/r1/{topic}/{kind.dds}/{kind.hash}")
        return any(one.includes(key) for one in given)

    assert is_given("joint_states", JOINT_STATE)
    assert is_given("front", LASER_SCAN)
    assert is_given("wrist/camera_info", CAMERA_INFO)
    assert not is_given("wrist/image_raw/compressed", COMPRESSED_IMAGE)
    assert not is_given("wrist/image_raw", IMAGE)


def test_rules_of_several_wires_are_combined():
    def rules(*wires: str) -> list[object]:
        listed = access_control(AclRoles(("r1",), ("desk",), wires=wires))["rules"]
        return [rule["id"] for rule in listed]  # type: ignore[index, union-attr]

    other = "ros2:domain=5,namespace=*"
    assert rules("native", WIRE, other) == [*rules("native"), *rules(WIRE), *rules(other)]
    assert len(set(rules("native", WIRE, other))) == len(rules("native", WIRE, other))


def test_single_robot_in_the_root_namespace_has_the_whole_domain():
    (written, *_) = access_control(AclRoles(("r1",), wires=("ros2:domain=5",)))["rules"]  # type: ignore[misc]
    assert written["key_exprs"] == ["5/**", "5/**/@adv/**", "@ros2_lv/5/**"]


@pytest.mark.parametrize(
    ("fleet", "text"),
    [
        (AclRoles(("r1", "r2"), wires=("ros2",)), "'ros2:namespace=*'"),
        (AclRoles(("r1", "r2"), wires=("ros2:namespace=site",)), "the same topics"),
        (AclRoles(("r-1",), wires=("ros2:namespace=*",)), "ROS names are made of"),
        (AclRoles(("r1",), namespace="hall", wires=("ros2",)), "no Zenoh namespace"),
        (AclRoles(("r1",), wires=("ros2dds",)), "no access control for the wire 'ros2dds'"),
        (AclRoles(("r1",), wires=("pigeon",)), "there is for 'native' and 'ros2'"),
    ],
)
def test_robots_in_one_namespace_and_unknown_wires_are_refused(fleet: AclRoles, text: str):
    with pytest.raises(InvalidInput, match=text.replace("*", r"\*")):
        access_control(fleet)
