"""Peers in tests: other implementations of ROS 2 over Zenoh, each in its own process."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from helpers.processes import DEADLINE_S, Child, until
from oracles import ORACLES

HERE = Path(__file__).parent
RUN = "import os, sys; os.execv(sys.argv[1], sys.argv[1:])"
DOMAIN = 5

Message = dict[str, Any]
Spawn = Callable[..., Child]


def interpreter(oracle: str) -> str:
    return os.environ[ORACLES[oracle].variable]


def repeat_until(publish: Callable[[], object], condition: Callable[[], object]) -> None:
    """Calls ``publish`` until ``condition()`` is true; first samples may be lost before discovery."""

    def is_done() -> object:
        publish()
        return condition()

    until(is_done)


class Program:
    """A program of this folder, in the environment of ``oracle``; json_lines.py describes its protocol."""

    def __init__(self, spawn: Spawn, oracle: str, file: str, *arguments: object) -> None:
        self._child = spawn(RUN, interpreter(oracle), str(HERE / file), *map(str, arguments))
        self._received: list[tuple[str, Message]] = []
        self._answer("start")

    def ask(self, do: str, **arguments: Any) -> Any:
        self._child.send_line(json.dumps({"do": do, **arguments}))
        return self._answer(do)

    def _answer(self, did: str) -> Any:
        while True:
            line = json.loads(self._child.line(DEADLINE_S))
            if line.get("did") == did:
                return line["answer"]
            assert "received" in line, (line, self._child.stderr)
            self._received.append((line["received"], line["message"]))

    def receive(self, topic: str, publish: Callable[[], object] = lambda: None) -> Message:
        """The first message on ``topic`` since the last call; calls ``publish`` until one arrives."""
        found: list[Message] = []

        def has_arrived() -> bool:
            self.ask("sync")
            found.extend(message for name, message in self._received if name == topic)
            self._received = [(name, message) for name, message in self._received if name != topic]
            return bool(found)

        repeat_until(publish, has_arrived)
        return found[0]


class Peer(Program):
    """A node that publishes and subscribes topics under the keys of rmw_zenoh_cpp."""

    can_latch = True
    node = "sdk_peer"

    def subscribe(self, topic: str, type: str, latched: bool = False) -> None:
        self.ask("subscribe", topic=topic, type=type, latched=latched)

    def advertise(self, topic: str, type: str, latched: bool = False) -> None:
        self.ask("advertise", topic=topic, type=type, latched=latched)

    def publish(self, topic: str, message: Message) -> None:
        self.ask("publish", topic=topic, message=message)


class PyzerosPeer(Peer):
    """A peer on pyzeros, which supports only volatile durability."""

    can_latch = False
    node = "pyzeros_peer"


class BridgedPeer(Peer):
    """An rclpy node on DDS, behind a bridge that forwards its bytes unchanged."""

    node = "dds_bridge"

    def __init__(self, spawn: Spawn, endpoint: str, ros_domain: int) -> None:
        self._bridge = Program(spawn, "kilted", "rclpy_bridge.py", endpoint, DOMAIN, ros_domain)
        super().__init__(spawn, "kilted", "rclpy_peer.py", ros_domain)

    def subscribe(self, topic: str, type: str, latched: bool = False) -> None:
        super().subscribe(topic, type, latched)
        self._bridge.ask("to_ros", topic=topic, type=type, latched=latched)

    def advertise(self, topic: str, type: str, latched: bool = False) -> None:
        self._bridge.ask("to_zenoh", topic=topic, type=type, latched=latched)
        super().advertise(topic, type, latched)


def start_peer(oracle: str, spawn: Spawn, endpoint: str) -> Peer:
    """A peer on ``oracle``, connected to the router at ``endpoint``."""
    if oracle == "kilted":
        # A DDS domain that other test runs on this host are unlikely to use.
        return BridgedPeer(spawn, endpoint, 1 + os.getpid() % 100)
    kind = PyzerosPeer if oracle == "pyzeros" else Peer
    return kind(spawn, oracle, f"{oracle}_peer.py", endpoint, DOMAIN)
