"""A client of Foxglove's WebSocket protocol, with the decoders of mcap-ros2-support."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable
from typing import Any

from helpers.processes import DEADLINE_S
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets.sync.client import connect
from websockets.typing import Subprotocol


class FoxgloveClient:
    """A connection to ``url``; a context manager.

    ``channels`` are the advertised ones by topic, ``frames`` the message data (time [ns], payload) by topic,
    ``times`` the broadcast ones, ``infos``, ``statuses`` and ``parameters`` (by name) what the server sent.
    """

    def __init__(self, url: str, subprotocol: str = "foxglove.sdk.v1", **options: Any) -> None:
        self.channels: dict[str, dict[str, Any]] = {}
        self.frames: dict[str, list[tuple[int, bytes]]] = {}
        self.times: list[int] = []
        self.infos: list[dict[str, Any]] = []
        self.statuses: list[dict[str, Any]] = []
        self.parameters: dict[str, Any] = {}
        self._topics: dict[int, str] = {}
        self.websocket = connect(
            url, subprotocols=[Subprotocol(subprotocol)], compression=None, max_size=None, **options
        )
        self.until(lambda: self.infos)

    def __enter__(self) -> FoxgloveClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.websocket.close()

    def request(self, op: str, **fields: Any) -> None:
        self.websocket.send(json.dumps({"op": op, **fields}))

    def subscribe(self, *topics: str) -> None:
        """Subscribes to topics, once they are advertised; the id is that of the channel, plus 1000."""
        self.until(lambda: set(topics) <= self.channels.keys())
        numbers = [self.channels[topic]["id"] for topic in topics]
        self._topics |= {1000 + number: topic for number, topic in zip(numbers, topics, strict=True)}
        subscriptions = [{"id": 1000 + number, "channelId": number} for number in numbers]
        self.request("subscribe", subscriptions=subscriptions)

    def unsubscribe(self, topic: str) -> None:
        self.request("unsubscribe", subscriptionIds=[1000 + self.channels[topic]["id"]])

    def until(self, condition: Callable[[], object], timeout_s: float = DEADLINE_S) -> None:
        """Receives until ``condition()`` is true; fails after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            self._receive(self.websocket.recv(max(0.0, deadline - time.monotonic())))

    def drain(self) -> None:
        """Receives what the server had sent before it answers this request."""
        answers = len(self.statuses)
        self.request("drain")
        self.until(lambda: any("drain" in one["message"] for one in self.statuses[answers:]))

    def messages(self, topic: str) -> list[Any]:
        """The decoded messages of a topic so far."""
        channel = self.channels[topic]
        schema = Schema(1, channel["schema"].encode(), channel["schemaEncoding"], channel["schemaName"])
        decode = DecoderFactory().decoder_for(channel["encoding"], schema)
        assert decode is not None
        return [decode(payload) for _, payload in self.frames.get(topic, ())]

    def _receive(self, frame: str | bytes) -> None:
        if isinstance(frame, bytes):
            if frame[0] == 2:
                self.times += struct.unpack("<Q", frame[1:])
                return
            opcode, subscription, stamp = struct.unpack_from("<BIQ", frame)
            assert opcode == 1
            self.frames.setdefault(self._topics[subscription], []).append((stamp, frame[13:]))
            return
        fields = json.loads(frame)
        match fields["op"]:
            case "serverInfo":
                self.infos.append(fields)
            case "advertise":
                self.channels |= {channel["topic"]: channel for channel in fields["channels"]}
            case "unadvertise":
                gone = set(fields["channelIds"])
                self.channels = {topic: one for topic, one in self.channels.items() if one["id"] not in gone}
            case "parameterValues":
                self.parameters |= {one["name"]: one.get("value") for one in fields["parameters"]}
            case "status":
                self.statuses.append(fields)
