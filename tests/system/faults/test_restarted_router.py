"""A fleet of writers of moving edges behind a router that is killed and started again."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.fault_processes import Start
from helpers.processes import DEADLINE_S, repeated, until

from zstate import TransformListener, connect
from zstate.net.presence import LivelinessToken, announce
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.odometry.messages import Odometry
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import WRITER_TOKEN, stream_key
from zstate.wire.messages import WriterTransforms, order_digest, to_block
from zstate.wire.native import encode, encoding_of

pytestmark = pytest.mark.processes

ROBOTS = int(os.environ.get("ZSTATE_TEST_FLEET", "300"))
FLEET_DEADLINE_S = 4.0 * DEADLINE_S
NAME = "base"
EDGES = (("odom", "base"),)
ORDER = order_digest(EDGES)
REST = to_block(np.eye(7)[6])
STILL = to_block([0.0] * 6)


class Fleet:
    """Writers of ``odom -> base``, one for each robot; all share a session, so that they cost no threads."""

    def __init__(self, session: Session, stream: StreamName) -> None:
        self._message = {"transforms": WriterTransforms, "odometry": Odometry}[stream]
        self._seq = 0
        self._tokens: list[LivelinessToken] = []
        self._writers: list[tuple[int, KeyPublisher]] = []
        for number in range(ROBOTS):
            robot, writer = f"r{number}", WriterId("robot", "host", 1 + number, 1, 1 + number)
            identity = Announcement(robot, stream, writer, NAME).identity
            self._tokens.append(announce(session, WRITER_TOKEN.key(robot, stream, identity)))
            key = stream_key(robot, stream, NAME)
            publisher = KeyPublisher(session, key, encoding_of(self._message))
            self._writers.append((writer.session, publisher))

    def publish(self) -> None:
        """Publishes a sample of each robot, stamped now."""
        for session, publisher in self._writers:
            head = time.time_ns(), self._seq, session, ORDER, REST, EDGES
            more = {"twist": STILL} if self._message is Odometry else {}
            publisher.put(encode(self._message(*head, **more)))
        self._seq += 1


def frozen(listener: TransformListener, since: int) -> list[str]:
    """The robots without a pose that is newer than ``since``."""
    names = [f"r{number}" for number in range(ROBOTS)]
    frames = {frame.name: frame for frame in listener.buffer.frames([f"{name}/base" for name in names])}
    newest = {name: frames[f"{name}/base"].newest for name in names if f"{name}/base" in frames}
    return [name for name in names if (newest.get(name) or 0) <= since]


@contextmanager
def moving_fleet(endpoint: str, stream: StreamName) -> Iterator[TransformListener]:
    """A listener of a fleet that publishes twice a second."""
    with (
        connect(mode="client", endpoints=endpoint) as robots,
        connect(mode="client", endpoints=endpoint) as session,
        TransformListener(session, "*") as listener,
        repeated(Fleet(robots, stream).publish, 0.5),
    ):
        yield listener


@pytest.mark.parametrize("stream", ["transforms", "odometry"])
def test_no_robot_of_a_fleet_is_frozen_after_a_restart_of_the_router(
    start: Start, endpoint: str, stream: StreamName
):
    router = start("router", listen=endpoint)
    with moving_fleet(endpoint, stream) as listener:
        writers = listener._reader.ingests.writers
        until(lambda: len(writers) == ROBOTS and not frozen(listener, 0), FLEET_DEADLINE_S)
        router.kill()
        until(lambda: not writers, FLEET_DEADLINE_S)
        start("router", listen=endpoint)
        until(lambda: len(writers) == ROBOTS, FLEET_DEADLINE_S)
        back_at = time.time_ns()
        try:
            until(lambda: not frozen(listener, back_at), DEADLINE_S)
        finally:
            print(f"{stream}: {len(frozen(listener, back_at))} of {ROBOTS} robots are frozen")
        assert "second writer" not in listener.stats.refused
