"""Random bytes on every key: no crash, and every unusable payload is counted."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass

import pytest
import zenoh
from helpers.message_types import MESSAGE_TYPES
from helpers.processes import until
from helpers.robots import RRBOT, wait_for_reader

from zstate.net.presence import announce
from zstate.net.session import Session, connect
from zstate.nodes.listener import Follow, TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.streams import StreamName
from zstate.wire.native import encoding_of
from zstate.wire.registry import get_wire

BATCH = 150  # the batches of all four targets fit into every ring, so that none overflows
FOLLOWS: tuple[Follow, ...] = ("joint_states", "tf")
ENCODED = (*map(encoding_of, MESSAGE_TYPES), "", "text/plain", "zenoh/bytes", "application/cdr")
NAMES = ("r1", "r2", "\u0440\u043e\u0431\u043e\u0442", "a" * 200, "%", "r 3", "-", "1")
UNREAD = (
    "zstate/r1/joint_commands",
    "zstate/r1/lookup",
    "zstate/clock",
    "zstate/r1",
    "zstate/r1/tf/x",
    "other",
)
TYPE_HASH = "RIHS01_" + "0" * 64


@dataclass(frozen=True)
class Target:
    """A listener, and the keys that it reads."""

    listener: TransformListener
    keys: tuple[str, ...]

    def counted(self) -> int:
        stats = self.listener.stats
        return stats.received + stats.late + stats.dropped + sum(stats.refused.values())


def native_keys(follow: Follow) -> tuple[str, ...]:
    writers = ("w", "\u00fc", "w" * 99)
    named = [f"{stream}/{writer}" for stream in ("tf_static", "transforms") for writer in writers]
    streams = (follow, "robot_description", *named)
    return tuple(f"zstate/{name}/{stream}" for name in NAMES for stream in streams)


def ros_keys(follow: Follow) -> tuple[str, ...]:
    streams: tuple[StreamName, ...] = (follow, "robot_description", "tf_static")
    return tuple(get_wire("ros2").expression("r1", stream).replace("*", TYPE_HASH) for stream in streams)


def put(session: Session, key: str, dice: random.Random) -> None:
    payload = dice.randbytes(dice.choice((1, 2, 8, 60, 110, 1000, 20_000)))  # an empty one is a withdrawal
    attachment = dice.choice((None, b"", dice.randbytes(33)))
    session.zenoh.put(
        key,
        payload,
        encoding=dice.choice(ENCODED),
        attachment=attachment,
        congestion_control=zenoh.CongestionControl.BLOCK,  # no payload is dropped
    )


def odd_tokens(dice: random.Random) -> list[str]:
    """Malformed announcements."""
    letters = "abz019%~._-=;:|\\ \u00e9"
    parts = ["".join(dice.choices(letters, k=dice.randrange(1, 60))) for _ in range(20)]
    native = [f"zstate/{dice.choice(NAMES)}/@writer/{part}/{part[::-1]}" for part in parts]
    native += [f"zstate/{dice.choice(NAMES)}/@edge/{part}/{part[::-1]}/{part}" for part in parts]
    return [*native, *(f"@ros2_lv/0/{part}/0/0/MP/%/%/{part}" for part in parts)]


@pytest.mark.parametrize(
    "seconds", [1.0, pytest.param(60.0, marks=[pytest.mark.soak, pytest.mark.timeout(300)])]
)
def test_random_bytes_on_every_key_are_each_counted_and_stop_no_listener(
    monkeypatch: pytest.MonkeyPatch, seconds: float
):
    crashes: list[object] = []
    monkeypatch.setattr(threading, "excepthook", crashes.append)
    dice, sent = random.Random(6), Counter[str]()
    with ExitStack() as opened:
        writer, reader = opened.enter_context(connect()), opened.enter_context(connect())
        targets = [
            Target(opened.enter_context(TransformListener(reader, wire=wire, follow=follow)), keys(follow))
            for wire, keys in (("native", native_keys), ("ros2", ros_keys))
            for follow in FOLLOWS
        ]
        for key in {key for target in targets for key in target.keys}:
            wait_for_reader(writer, key)
        for token in odd_tokens(dice):
            opened.enter_context(announce(writer, token))
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            for target in targets:
                for key in dice.choices(target.keys, k=BATCH):
                    put(writer, key, dice)
                    sent[key] += 1
            for key in UNREAD:
                put(writer, key, dice)
            for target in targets:
                expected = sum(sent[key] for key in target.keys)
                until(lambda target=target, expected=expected: crashes or target.counted() >= expected)
        for target in targets:
            assert target.counted() == sum(sent[key] for key in target.keys), target.listener.stats
        print(f"{sent.total()} random payloads on {len(sent)} keys; refused: ")
        print(*(target.listener.stats.refused for target in targets), sep="\n")
        assert crashes == []
        # A valid robot is received as before.
        with StatePublisher(writer, RRBOT, "fresh") as fresh:
            wait_for_reader(writer, "zstate/fresh/joint_states")
            fresh.publish([0.1, 0.2])
            targets[0].listener.buffer.wait("fresh/world", "fresh/tool", timeout_s=10.0)
