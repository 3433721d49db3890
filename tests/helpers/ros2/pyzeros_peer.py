"""A peer on pyzeros: ``pyzeros_peer.py ENDPOINT DOMAIN``, run by the interpreter of that oracle.

Without arguments it compiles the message classes into the cache and exits.

Requests (json_lines.py): subscribe, advertise, publish, and the token and gid that it would generate for an
endpoint. It supports only volatile durability, and has no view of the graph.
"""

import asyncio
import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import zenoh
from json_lines import report_message, serve

os.environ["CYDR_CACHE_DIR"] = f"{sys.prefix}/cydr_cache"  # default: the working directory
from pyzeros import pub, sub
from pyzeros.builtin_msgs import Attachment
from pyzeros.node import Node
from pyzeros.node import token_keyexpr as node_token
from pyzeros.qos import QosProfile
from pyzeros.utils import rmw_zenoh_gid
from ros2_pyterfaces.cyclone.all_msgs import (
    Header,
    JointState,
    Quaternion,
    String,
    Time,
    Transform,
    TransformStamped,
    Vector3,
)
from ros2_pyterfaces.cyclone.idl import IdlStruct, types

NODE = "pyzeros_peer"
Json = dict[str, Any]


# IdlStruct reads the annotations of its fields, so this module must not postpone them.
@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs/msg/TFMessage"):
    transforms: types.sequence[TransformStamped] = field(default_factory=list)


def header(values: Json) -> Header:
    return Header(stamp=Time(**values["stamp"]), frame_id=values["frame_id"])


def joint_state(values: Json) -> JointState:
    return JointState(**{**values, "header": header(values["header"])})


def transform_stamped(values: Json) -> TransformStamped:
    pose = values["transform"]
    transform = Transform(Vector3(**pose["translation"]), Quaternion(**pose["rotation"]))
    return TransformStamped(header(values["header"]), values["child_frame_id"], transform)


def tf_message(values: Json) -> TFMessage:
    return TFMessage([transform_stamped(transform) for transform in values["transforms"]])


KINDS: dict[str, tuple[type, Callable[[Json], Any]]] = {
    "sensor_msgs/msg/JointState": (JointState, joint_state),
    "std_msgs/msg/String": (String, lambda values: String(**values)),
    "tf2_msgs/msg/TFMessage": (TFMessage, tf_message),
}


class PyzerosPeer:
    def __init__(self, session: zenoh.Session, domain: int) -> None:
        self._node = Node(NODE, session, domain)
        self._opened: list[Any] = []
        self._publishers: dict[str, tuple[pub.Pub[Any], Callable[[Json], Any]]] = {}

    def subscribe(self, topic: str, type: str, latched: bool = False) -> str:
        kind, _ = KINDS[type]

        def on_sample(sample: zenoh.Sample) -> None:
            report_message(topic, asdict(kind.deserialize(sample.payload.to_bytes())))

        subscriber = sub.RawSub(kind, topic, on_sample, _qos(latched), self._node, scope=None)
        self._opened.append(subscriber)
        return subscriber.token_keyexpr

    def advertise(self, topic: str, type: str, latched: bool = False) -> str:
        kind, build = KINDS[type]
        publisher = pub.Pub(kind, topic, _qos(latched), self._node, scope=None)
        self._publishers[topic] = (publisher, build)
        return publisher.token_keyexpr

    def publish(self, topic: str, message: Json) -> None:
        publisher, build = self._publishers[topic]
        publisher.publish(build(message))

    def node_token(self, domain: int, zid: str, node_id: int, **described: Any) -> str:
        """The token of a given node: ``name``, ``namespace``."""
        ids = {"_zenoh_id": zid, "_node_id": node_id, "_entity_id": node_id}
        return node_token(session=self._node.session, domain_id=domain, **ids, **described)

    def endpoint_token(self, kind: str, domain: int, zid: str, ids: tuple[int, int], **described: Any) -> str:
        """The token of a given publisher (MP) or subscription (MS)."""
        keyexpr = {"MP": pub.token_keyexpr, "MS": sub.token_keyexpr}[kind]
        durability = "transient_local" if described.pop("latched") else "volatile"
        qos = QosProfile(depth=described.pop("depth"), durability=durability)
        identity = {"domain_id": domain, "_zenoh_id": zid, "_node_id": ids[0], "_entity_id": ids[1]}
        return keyexpr(session=self._node.session, qos_profile=qos, **identity, **described)


def _qos(latched: bool) -> QosProfile:
    return QosProfile(depth=1, durability="transient_local") if latched else QosProfile()


def main() -> None:
    Attachment().serialize()
    if not sys.argv[1:]:
        return
    endpoint, domain = sys.argv[1:]
    asyncio.set_event_loop(asyncio.new_event_loop())
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with zenoh.open(config) as session:
        peer = PyzerosPeer(session, int(domain))
        serve(
            {
                "subscribe": peer.subscribe,
                "advertise": peer.advertise,
                "publish": peer.publish,
                "node_token": peer.node_token,
                "endpoint_token": peer.endpoint_token,
                "gid": lambda token: rmw_zenoh_gid(token).hex(),
            }
        )


if __name__ == "__main__":
    main()
