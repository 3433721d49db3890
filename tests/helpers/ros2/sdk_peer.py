"""A peer on zenoh-ros2-sdk: ``sdk_peer.py ENDPOINT DOMAIN``, run by the interpreter of that oracle.

Requests (json_lines.py): subscribe, advertise, publish, and the graph that it sees.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from json_lines import report_message, serve
from message_texts import write_messages

os.environ.pop("ZENOH_SESSION_CONFIG_URI", None)
os.environ["ZENOH_CONFIG_OVERRIDE"] = 'listen/endpoints=["tcp/127.0.0.1:0"]'
import numpy as np
from rosbags.interfaces import Nodetype
from zenoh_ros2_sdk import (
    ROS2Publisher,
    ROS2Subscriber,
    ZenohSession,
    get_topic_info,
    get_topic_names_and_types,
)
from zenoh_ros2_sdk.message_registry import get_registry
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

NODE = "sdk_peer"


class Messages:
    """Conversion between JSON and the classes that the store generates from message definitions."""

    def __init__(self, store: Any) -> None:
        self._store = store

    def build(self, type_name: str, values: dict[str, Any]) -> Any:
        return self._store.types[type_name](**self.fields(type_name, values))

    def fields(self, type_name: str, values: dict[str, Any]) -> dict[str, Any]:
        _, fields = self._store.fielddefs[type_name]
        return {name: self._field(form, values[name]) for name, form in fields}

    def _field(self, form: Any, value: Any) -> Any:
        kind, what = form
        if kind == Nodetype.NAME:
            return self.build(what, value)
        if kind == Nodetype.SEQUENCE:
            element = what[0]
            if element[0] == Nodetype.BASE and element[1][0] != "string":
                return np.array(value, dtype=element[1][0])
            return [self._field(element, item) for item in value]
        return value

    def plain(self, type_name: str, message: Any) -> dict[str, Any]:
        _, fields = self._store.fielddefs[type_name]
        return {name: self._plain_field(form, getattr(message, name)) for name, form in fields}

    def _plain_field(self, form: Any, value: Any) -> Any:
        kind, what = form
        if kind == Nodetype.NAME:
            return self.plain(what, value)
        if kind == Nodetype.SEQUENCE:
            return [self._plain_field(what[0], item) for item in value]
        return value.item() if isinstance(value, np.generic) else value


class SdkPeer:
    def __init__(self, endpoint: str, domain: int) -> None:
        ip, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
        self._where = {"domain_id": domain, "router_ip": ip, "router_port": int(port)}
        self._messages = Messages(ZenohSession.get_instance(ip, int(port)).store)
        self._opened: list[Any] = []
        self._publishers: dict[str, ROS2Publisher] = {}

    def subscribe(self, topic: str, type: str, latched: bool = False) -> str:
        def on_message(message: Any) -> None:
            report_message(topic, self._messages.plain(type, message))

        options = {"node_name": NODE, "qos": _qos(latched), **self._where}
        subscriber = ROS2Subscriber(topic, type, on_message, **options)
        self._opened.append(subscriber)
        return subscriber.keyexpr

    def advertise(self, topic: str, type: str, latched: bool = False) -> str:
        publisher = ROS2Publisher(topic, type, node_name=NODE, qos=_qos(latched), **self._where)
        self._publishers[topic] = publisher
        return publisher.keyexpr

    def publish(self, topic: str, message: dict[str, Any]) -> None:
        publisher = self._publishers[topic]
        publisher.publish(**self._messages.fields(publisher.msg_type, message))

    def graph(self) -> dict[str, Any]:
        """Topics with their types, publishers and subscribers."""
        topics = get_topic_names_and_types(**self._where)
        return {topic: {"types": types, **self._endpoints(topic)} for topic, types in topics}

    def _endpoints(self, topic: str) -> dict[str, Any]:
        info = get_topic_info(topic, verbose=True, **self._where)
        found = {"publishers": info.publishers, "subscribers": info.subscribers} if info else {}
        return {role: [vars_of(endpoint) for endpoint in endpoints] for role, endpoints in found.items()}


def vars_of(endpoint: Any) -> dict[str, str]:
    return {
        "node": endpoint.node_name,
        "namespace": endpoint.node_namespace,
        "type": endpoint.topic_type,
        "hash": endpoint.type_hash,
        "qos": endpoint.qos,
    }


def _qos(latched: bool) -> QosProfile:
    return QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1) if latched else QosProfile()


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_messages(Path(folder))
        get_registry(folder)
        peer = SdkPeer(sys.argv[1], int(sys.argv[2]))
        serve(
            {
                "subscribe": peer.subscribe,
                "advertise": peer.advertise,
                "publish": peer.publish,
                "graph": peer.graph,
            }
        )
        ZenohSession.get_instance().close()


if __name__ == "__main__":
    main()
