"""Bridge between rmw_zenoh keys and Fast DDS: ``rclpy_bridge.py ENDPOINT DOMAIN ROS_DOMAIN``.

There is no wheel of rmw_zenoh_cpp, so this bridge connects a genuine ROS 2 on DDS with zstate. On the
Zenoh side it declares, checks and sends what rmw_zenoh_cpp does; on the DDS side rclpy receives and sends
the same bytes, unchanged. Requests (json_lines.py) name the topics to forward and their direction.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import xxhash  # noqa: F401 - fails here, by name, if it is missing, instead of in a callback
import zenoh
from json_lines import print_line, serve
from rclpy_local import qos, spinning_node
from rclpy_messages import message_class, type_hash
from rmw_format import QOS, Attachment, data_key, dds_name, endpoint_token, gid, node_token
from zenoh import ext

NODE = "dds_bridge"


class Bridge:
    """A node on DDS, and the same node on Zenoh."""

    def __init__(self, node: Any, session: zenoh.Session, domain: int) -> None:
        self.node = node
        self._session = session
        self._domain = domain
        self._entities = 0
        self._open: list[Any] = []
        self._node_token = self._token(node_token(domain, str(session.zid()), 0, "/", NODE))

    def to_ros(self, topic: str, type: str, latched: bool = False) -> str:
        """Publishes on DDS the samples of the topic's key, with any type hash."""
        publisher = self.node.create_publisher(message_class(type), topic, qos(latched))

        def on_sample(sample: zenoh.Sample) -> None:
            try:
                Attachment.parse(sample.attachment.to_bytes() if sample.attachment else b"")
            except ValueError as error:
                print_line(refused=topic, why=str(error))
            else:
                publisher.publish(sample.payload.to_bytes())

        key = f"{self._domain}/{topic.strip('/')}/{dds_name(type)}/*"
        self._subscribe(key, on_sample, latched)
        return self._endpoint("MS", topic, type, latched)

    def to_zenoh(self, topic: str, type: str, latched: bool = False) -> str:
        """Puts messages that are published on DDS on the topic's key."""
        key = data_key(self._domain, topic, type, type_hash(type))
        publisher = self._publisher(key, latched)
        token = self._endpoint("MP", topic, type, latched)
        sent = 0

        def on_bytes(data: bytes) -> None:
            nonlocal sent
            sent += 1
            publisher.put(data, attachment=Attachment(sent, time.time_ns(), gid(token)).pack())

        self.node.create_subscription(message_class(type), topic, on_bytes, qos(latched), raw=True)
        return token

    def _subscribe(self, key: str, on_sample: Any, latched: bool) -> None:
        if latched:
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            recovery = ext.RecoveryConfig(heartbeat=True)
            options = {"history": history, "recovery": recovery, "subscriber_detection": True}
            self._open.append(ext.declare_advanced_subscriber(self._session, key, on_sample, **options))
        else:
            self._open.append(self._session.declare_subscriber(key, on_sample))

    def _publisher(self, key: str, latched: bool) -> Any:
        if not latched:
            return self._session.declare_publisher(key)
        detection = ext.MissDetectionConfig(sporadic_heartbeat=0.5)
        options = {"sample_miss_detection": detection, "publisher_detection": True}
        return ext.declare_advanced_publisher(self._session, key, cache=ext.CacheConfig(1), **options)

    def _endpoint(self, kind: str, topic: str, type: str, latched: bool) -> str:
        self._entities += 1
        described = (type, type_hash(type), QOS["latched" if latched else "volatile"])
        return self._token(endpoint_token(self._node_token, self._entities, kind, topic, described))

    def _token(self, token: str) -> str:
        self._open.append(self._session.liveliness().declare_token(token))
        return token


def session_config(endpoint: str) -> zenoh.Config:
    """The configuration that rmw_zenoh_cpp gives a node: a peer that connects to its router."""
    config = zenoh.Config()
    for path, value in {
        "mode": "peer",
        "connect/endpoints": [endpoint],
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return config


def main() -> None:
    endpoint, domain, ros_domain = sys.argv[1:]
    with spinning_node(NODE, int(ros_domain)) as node, zenoh.open(session_config(endpoint)) as session:
        bridge = Bridge(node, session, int(domain))
        serve({"to_ros": bridge.to_ros, "to_zenoh": bridge.to_zenoh})


if __name__ == "__main__":
    main()
