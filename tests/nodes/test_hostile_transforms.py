"""A hostile writer on the keys and tokens of moving transforms does not disturb the edges of a good one."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from contextlib import ExitStack

import msgspec
import numpy as np
import pytest
from helpers.fault_programs import resource_counts
from helpers.processes import DEADLINE_S, until
from helpers.robots import put
from helpers.tokens import current_tokens

from zstate.errors import SecondWriter
from zstate.net.presence import announce
from zstate.nodes.listener import TransformListener
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.streams import SAMPLE_BYTES
from zstate.transform import Transform
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import EDGE_TOKEN, WRITER_TOKEN
from zstate.wire.messages import WriterTransforms, order_digest, to_block
from zstate.wire.native import encode, encoding_of

KEY = "zstate/r1/transforms/thief"
ENCODING = encoding_of(WriterTransforms)
REST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
EDGE = (("odom", "base_link"),)
CUP = (("odom", "cup"),)
SESSIONS = 10_000


def sample(
    edges: tuple[tuple[str, str], ...] = EDGE, *, session: int = 666, seq: int = 0, rows: object = None
) -> bytes:
    poses = to_block([REST] * len(edges) if rows is None else rows)
    return encode(WriterTransforms(time.time_ns(), seq, session, order_digest(edges), poses, edges))


def garbage() -> Iterator[tuple[str, bytes]]:
    """Payloads that no reader can use, with the reasons of their refusal."""
    good = sample()
    fields = msgspec.msgpack.decode(good)
    encoder = msgspec.msgpack.Encoder()
    head = b"\x97" + b"".join(map(encoder.encode, fields[:4]))
    yield "truncated", good[:-1]
    yield "truncated", head + b"\xc6\xff\xff\xff\xff"  # a block of 4 GB
    yield "truncated", head + encoder.encode(fields[4]) + b"\xdd\xff\xff\xff\xff"  # 2^32 - 1 edges
    yield "malformed", b"\x96" + b"\x91" * 10_000
    yield "malformed", encoder.encode([*fields[:4], b"1234567", fields[5]])
    yield "malformed", encoder.encode([*fields[:4], b"", fields[5]])
    yield "malformed", encoder.encode([*fields[:6], b"12345678"])  # covariances
    yield "malformed", encoder.encode([*fields[:3], b"\0" * 8, *fields[4:]])  # another digest
    yield "too large", sample((("odom", "x" * 1_000_000),))
    yield "too large", bytes(SAMPLE_BYTES + 1)
    yield "not a pose", sample(CUP, rows=[(np.nan, *REST[1:])])
    yield "not a pose", sample(CUP, rows=[(np.inf, *REST[1:])])
    yield "not a pose", sample(CUP, rows=[(0.0,) * 7])
    yield "bad numbers", sample((("odom", "x" * 2000),))
    yield "bad numbers", sample((("odom", ""),))
    yield "bad numbers", sample((("odom", "a\nb"),))
    yield "self edge", sample((("odom", "odom"),))
    yield "second parent", sample((("odom", "a"), ("odom", "a")))
    yield "second writer", sample()
    yield "second writer", sample(rows=[(np.nan, *REST[1:])])
    yield "second parent", sample((("map", "base_link"),))
    yield "loop", sample((("base_link", "odom"),))


@pytest.fixture
def listener(sessions) -> Iterator[TransformListener]:
    with TransformListener(sessions[1], "r1", history_s=1000.0) as listener:
        yield listener


class GoodWriter:
    """Publishes odom -> base_link, and checks that the listener has exactly its samples."""

    def __init__(self, publisher: TransformPublisher, listener: TransformListener) -> None:
        self._publisher = publisher
        self._listener = listener
        self._count = 0

    def publish(self) -> None:
        self._count += 1
        stamp, x = time.time_ns(), float(self._count)
        self._publisher.publish([Transform("odom", "base_link", (x, 0, 0), (0, 0, 0, 1))], stamp)
        found = self._listener.buffer.wait("odom", "base_link", stamp, timeout_s=DEADLINE_S)
        assert found.translation[0] == x
        (frame,) = self._listener.buffer.frames(("r1/base_link",))
        assert frame.count == self._count


@pytest.fixture
def good(sessions, listener) -> Iterator[GoodWriter]:
    with TransformPublisher(sessions[0], "r1", "wheels") as publisher:
        yield GoodWriter(publisher, listener)


def test_unusable_samples_are_refused_with_a_reason_and_move_nothing(sessions, listener, good: GoodWriter):
    good.publish()
    for reason, payload in garbage():
        before = listener.stats.refused.get(reason, 0)
        put(sessions[1], KEY, payload, ENCODING)
        until(lambda reason=reason, before=before: listener.stats.refused.get(reason, 0) > before)
        good.publish()
    placed = {frame.name for frame in listener.buffer.frames() if frame.parent}
    assert placed == {"r1/base_link"}
    assert "refused: an unannounced writer" in listener.refusals["second writer"]


def test_edges_of_an_unannounced_writer_yield_to_those_of_an_announced_one(
    sessions, listener, good: GoodWriter
):
    put(sessions[1], KEY, sample(rows=[(9.0, *REST[1:])]), ENCODING)
    listener.buffer.wait("odom", "base_link", timeout_s=DEADLINE_S)
    for _ in range(10):
        good.publish()
        put(sessions[1], KEY, sample(rows=[(9.0, *REST[1:])]), ENCODING)
    until(lambda: listener.stats.refused.get("second writer", 0) >= 10)
    good.publish()


@pytest.mark.long
def test_ten_thousand_sessions_take_little_memory_and_disturb_no_writer(sessions, listener, good: GoodWriter):
    good.publish()
    before = resource_counts()
    for session in range(SESSIONS):
        put(sessions[1], KEY, sample((("odom", f"cup{session}"),), session=session + 1), ENCODING)
        if session % 1000 == 0:
            good.publish()
    until(lambda: listener.stats.received + listener.stats.dropped >= SESSIONS, timeout_s=60.0)
    good.publish()
    after = resource_counts()
    assert after["rss_kb"] - before["rss_kb"] < 100_000
    assert after["threads"] <= before["threads"] + 6
    placed = [frame for frame in listener.buffer.frames() if frame.parent]
    assert len(placed) <= 258


def test_malformed_tokens_disturb_no_writer_and_a_made_up_one_is_named(sessions, listener, good: GoodWriter):
    dice = random.Random(7)
    letters = "abz019%~._-=;:,|\\ \u00e9"
    thief = Announcement("r1", "transforms", WriterId("thief", "laptop", 9, 1, 99), "thief")
    with ExitStack() as opened:
        for _ in range(100):
            child, parent, identity = (
                "".join(dice.choices(letters, k=dice.randrange(1, 60))) for _ in range(3)
            )
            for token in (
                f"zstate/r1/@edge/{child}/{parent}/{identity}",
                f"zstate/r1/@edge/r1%2Fbase_link/{parent}/{identity}",
                f"zstate/r1/@writer/transforms/{identity}",
            ):
                opened.enter_context(announce(sessions[1], token))
        good.publish()
        opened.enter_context(announce(sessions[1], WRITER_TOKEN.key("r1", "transforms", thief.identity)))
        opened.enter_context(announce(sessions[1], EDGE_TOKEN.key("r1", "r1/cup", "r1/odom", thief.identity)))
        until(lambda: current_tokens(sessions[0], "zstate/r1/@edge/r1%2Fcup/*/*", 1.0))
        hand = opened.enter_context(TransformPublisher(sessions[0], "r1", "hand"))
        with pytest.raises(SecondWriter, match=r"thief@laptop.* places 'r1/cup' on 'r1/odom'"):
            hand.publish([Transform("odom", "cup", (0, 0, 0), (0, 0, 0, 1))])
        good.publish()
