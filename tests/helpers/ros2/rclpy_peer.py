"""An ordinary rclpy node on Fast DDS, on this host only: ``rclpy_peer.py ROS_DOMAIN``.

Requests (json_lines.py): subscribe, advertise, publish, and the graph that it sees.
"""

from __future__ import annotations

import sys
from typing import Any

from json_lines import report_message, serve
from rclpy_local import qos, spinning_node
from rclpy_messages import build, message_class, plain


class RclpyPeer:
    def __init__(self, node: Any) -> None:
        self.node = node
        self._publishers: dict[str, Any] = {}

    def subscribe(self, topic: str, type: str, latched: bool = False) -> None:
        def on_message(message: Any) -> None:
            report_message(topic, plain(message))

        self.node.create_subscription(message_class(type), topic, on_message, qos(latched))

    def advertise(self, topic: str, type: str, latched: bool = False) -> None:
        self._publishers[topic] = self.node.create_publisher(message_class(type), topic, qos(latched))

    def publish(self, topic: str, message: dict[str, Any]) -> None:
        publisher = self._publishers[topic]
        publisher.publish(build(publisher.msg_type, message))

    def graph(self) -> dict[str, Any]:
        """Topics with their types."""
        return {topic: {"types": types} for topic, types in self.node.get_topic_names_and_types()}


def main() -> None:
    with spinning_node("rclpy_peer", int(sys.argv[1])) as node:
        peer = RclpyPeer(node)
        serve(
            {
                "subscribe": peer.subscribe,
                "advertise": peer.advertise,
                "publish": peer.publish,
                "graph": peer.graph,
            }
        )


if __name__ == "__main__":
    main()
