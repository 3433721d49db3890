"""zstate and other implementations of ROS 2 over Zenoh find each other in the graph."""

from __future__ import annotations

import pytest
import zenoh
from helpers.processes import until
from helpers.robots import RRBOT, STAMP
from peers import DOMAIN, Peer, repeat_until
from rmw_format import Attachment, gid
from ros_messages import JOINT_STATE, LASER_SCAN, OCCUPANCY_GRID, STRING, TF_MESSAGE

from zstate.net.session import Session
from zstate.nodes.publisher import StatePublisher
from zstate.scans import Grid, MapPublisher, ScanPublisher
from zstate.wire.ros2 import types
from zstate.wire.ros2.graph import EndpointToken, NodeToken, parse_token
from zstate.wire.ros2.qos import Qos

WIRE = f"ros2:domain={DOMAIN},namespace=r1,node=zstate"
LATCHED = Qos(durability="transient_local", depth=1)
OURS = {
    "/r1/joint_states": (JOINT_STATE, Qos(depth=10)),
    "/r1/robot_description": (STRING, LATCHED),
    "/tf": (TF_MESSAGE, Qos(depth=100)),
    "/tf_static": (TF_MESSAGE, LATCHED),
}

SDK = pytest.param("sdk", marks=pytest.mark.sdk)
PYZEROS = pytest.param("pyzeros", marks=pytest.mark.pyzeros)
pytestmark = pytest.mark.processes


def tokens(session: Session) -> set[str]:
    """All tokens alive in the domain. Zenoh reports its own tokens to a session twice."""
    replies = session.zenoh.liveliness().get(f"@ros2_lv/{DOMAIN}/**")
    return {str(reply.ok.key_expr) for reply in replies if reply.ok}


def our_tokens(session: Session) -> list[str]:
    return [token for token in tokens(session) if session.zid in token]


def theirs(session: Session) -> list[NodeToken | EndpointToken]:
    """What the tokens mean that are not ours."""
    found = [parse_token(token) for token in tokens(session)]
    assert None not in found, found
    return [token for token in found if token and token.zid != session.zid]


def endpoints(session: Session) -> dict[str, EndpointToken]:
    """Their publisher and their subscription, by kind."""
    return {token.kind: token for token in theirs(session) if isinstance(token, EndpointToken)}


def dds_type(name: str) -> str:
    package, kind, name = name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


@pytest.mark.parametrize("peer", [SDK], indirect=True)
def test_a_peer_finds_what_we_publish_with_its_types_and_qos(peer: Peer, session: Session):
    with StatePublisher(session, RRBOT, "r1", wires=(WIRE,)):
        until(lambda: set(OURS) <= set(peer.ask("graph")))
        found = peer.ask("graph")
    for topic, (type_name, qos) in OURS.items():
        (endpoint,) = found[topic]["publishers"]
        assert found[topic]["types"] == [type_name]
        assert (endpoint["node"], endpoint["namespace"]) == ("zstate", "/r1")
        assert endpoint["qos"] == qos.encode_rmw()
        assert endpoint["hash"].startswith("RIHS01_")
    until(lambda: not set(OURS) & set(peer.ask("graph")))


@pytest.mark.parametrize("peer", [SDK], indirect=True)
def test_a_peer_finds_scans_and_maps_with_their_types_and_qos(peer: Peer, session: Session):
    geometry = {"angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.1, "range_max": 10.0}
    published = {
        "/r1/front": (LASER_SCAN, Qos("best_effort", depth=5)),
        "/r1/map": (OCCUPANCY_GRID, LATCHED),
    }
    with (
        ScanPublisher(session, "r1", "front", WIRE, **geometry),
        MapPublisher(session, "r1", Grid([[0]], 1.0, (0.0, 0.0, 0.0), stamp=STAMP), WIRE),
    ):
        until(lambda: set(published) <= set(peer.ask("graph")))
        found = peer.ask("graph")
    for topic, (type_name, qos) in published.items():
        (endpoint,) = found[topic]["publishers"]
        assert found[topic]["types"] == [type_name]
        assert endpoint["qos"] == qos.encode_rmw()


@pytest.mark.parametrize("peer", [SDK], indirect=True)
def test_a_peer_computes_the_type_hashes_in_our_keys(peer: Peer, session: Session):
    known = (types.JOINT_STATE, types.TF_MESSAGE, types.STRING, types.LASER_SCAN, types.OCCUPANCY_GRID)
    for number, kind in enumerate(known):
        key = peer.ask("advertise", topic=f"/topic{number}", type=kind.name)
        assert key == f"{DOMAIN}/topic{number}/{kind.dds}/{kind.hash}"


@pytest.mark.parametrize("peer", [SDK, PYZEROS], indirect=True)
def test_we_find_what_a_peer_publishes_and_subscribes(peer: Peer, session: Session):
    peer.advertise("/r1/joint_states", JOINT_STATE)
    peer.subscribe("/tf", TF_MESSAGE)
    until(lambda: {"MP", "MS"} <= set(endpoints(session)))
    published, subscribed = (endpoints(session)[kind] for kind in ("MP", "MS"))
    (node,) = {token.name for token in theirs(session) if isinstance(token, NodeToken)}
    assert {token.node.name for token in (published, subscribed)} == {node}
    assert (published.topic, published.dds_type) == ("/r1/joint_states", dds_type(JOINT_STATE))
    assert (subscribed.topic, subscribed.dds_type) == ("/tf", dds_type(TF_MESSAGE))
    assert published.qos == subscribed.qos == Qos(depth=10)


@pytest.mark.parametrize("peer", [PYZEROS], indirect=True)
def test_a_peer_would_write_our_tokens_and_gids_as_we_do(peer: Peer, session: Session):
    with StatePublisher(session, RRBOT, "r1", wires=(WIRE,)):
        until(lambda: len(our_tokens(session)) == 1 + len(OURS))
        ours = our_tokens(session)
    for token in ours:
        what = parse_token(token)
        assert what is not None
        identity = {"domain": DOMAIN, "zid": session.zid, "namespace": "/r1"}
        if isinstance(what, NodeToken):
            assert token == peer.ask("node_token", node_id=what.nid, name="zstate", **identity)
        else:
            assert peer.ask("gid", token=token) == gid(token).hex()
            type_name, qos = OURS[what.topic]
            described = {"name": what.topic, "dds_type": dds_type(type_name), "hash": what.hash, **identity}
            wanted = {"latched": qos.durability == "transient_local", "depth": qos.depth}
            ids = (what.node.nid, what.eid)
            assert token == peer.ask(
                "endpoint_token", kind="MP", ids=ids, node_name="zstate", **described, **wanted
            )


def test_samples_have_the_gid_of_the_publisher_in_the_graph(router: str, session: Session):
    config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{router}"]}}}}')
    received: dict[str, list[bytes]] = {"/r1/joint_states": [], "/tf": []}
    with zenoh.open(config) as other, StatePublisher(session, RRBOT, "r1", wires=(WIRE,)) as publisher:
        for topic, attachments in received.items():
            other.declare_subscriber(
                f"{DOMAIN}{topic}/*/*",
                lambda sample, kept=attachments: kept.append(sample.attachment.to_bytes()),
            )
        repeat_until(
            lambda: publisher.publish([0.1, 0.2], stamp=STAMP),
            lambda: all(len(attachments) >= 5 for attachments in received.values()),
        )
        writers = {gid(token): parse_token(token) for token in tokens(session)}
    for topic, attachments in received.items():
        signed = [Attachment.parse(attachment) for attachment in attachments]
        (identity,) = {attachment.gid for attachment in signed}
        assert writers[identity].topic == topic
        first = signed[0].seq
        assert first >= 1
        assert [attachment.seq for attachment in signed] == list(range(first, first + len(signed)))
