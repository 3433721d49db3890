"""The threads of listeners and publishers, as the table of docs/architecture.md has them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT, STAMP, wait_for_stream_readers

from zstate.buffer.buffer import feed_of
from zstate.ingest.robot_ingests import RobotIngests
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry.publishers import OdometryPublisher
from zstate.transform import Transform

LISTENER = {"receiver": 2, "requests": 1}
"""One receives what is followed, one the tokens of writers."""


@contextmanager
def started() -> Iterator[list[threading.Thread]]:
    """All threads that are started in the block, also those that have ended."""
    threads: list[threading.Thread] = []
    start = threading.Thread.start

    def recorded(thread: threading.Thread) -> None:
        threads.append(thread)
        start(thread)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(threading.Thread, "start", recorded)
        yield threads


def names(threads: list[threading.Thread]) -> dict[str, int]:
    return dict(Counter(thread.name.removeprefix("zstate ") for thread in threads))


def of_listener(threads: list[threading.Thread]) -> dict[str, int]:
    """The threads without those that answer the requests of the listener."""
    return names([thread for thread in threads if thread.name != "zstate queries"])


def are_over(threads: list[threading.Thread]) -> bool:
    return not any(thread.is_alive() for thread in threads)


@pytest.mark.parametrize("robots", ["r1", "*", ("r1", "r2")])
@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_a_listener_has_three_threads_and_one_for_each_other_stream_that_it_receives(
    sessions: tuple[Session, Session], robots, follow
):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        OdometryPublisher(writer, "r1") as odometry,
        TransformPublisher(writer, "r1", "camera") as edges,
        started() as threads,
    ):
        with TransformListener(reader, robots, follow=follow) as listener:
            wait_for_stream_readers(writer, "r1", follow)
            publisher.publish([0.0, 0.0], stamp=STAMP)
            until(lambda: listener.buffer.can_lookup("world", "tool", STAMP))
            until(lambda: any(offset() for offset in feed_of(listener.buffer).clock_offsets.values()))
            assert of_listener(threads) == LISTENER
            still = Transform("odom", "world", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            odometry.publish(still, np.zeros(3), np.zeros(3), STAMP)
            until(lambda: listener.buffer.can_lookup("odom", "tool", STAMP))
            assert of_listener(threads) == {**LISTENER, "receiver": 3}
            edges.publish([Transform("tool", "camera", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0))], STAMP)
            until(lambda: listener.buffer.can_lookup("odom", "camera", STAMP))
            assert of_listener(threads) == {**LISTENER, "receiver": 4}
        assert not any(thread.is_alive() for thread in threads if thread.name != "zstate queries")


def test_a_listener_on_a_ros_wire_has_a_third_receiver_only_while_others_write_tf(
    sessions: tuple[Session, Session],
):
    writer, reader = sessions
    with started() as threads, TransformListener(reader, "r1", wire="ros2"):
        assert names(threads) == {"receiver": 2}
        with TransformPublisher(writer, "r1", "camera", wires=("ros2",)):
            until(lambda: names(threads).get("receiver") == 3)
        until(lambda: sum(thread.is_alive() for thread in threads) == 2)


def test_without_writers_a_listener_requests_nothing_and_a_callback_for_events_has_a_thread(
    sessions: tuple[Session, Session],
):
    with started() as threads:
        with TransformListener(sessions[1], "r1", on_event=lambda _: None):
            assert names(threads) == {"receiver": 2, "events": 1}
        assert are_over(threads)


def test_the_publishers_of_a_session_have_two_threads(sessions: tuple[Session, Session]):
    with started() as threads:
        with StatePublisher(sessions[0], RRBOT, "r1"), StatePublisher(sessions[0], RRBOT, "r2"):
            assert names(threads) == {"queries": 1, "status": 1}
        until(lambda: are_over(threads))


def test_a_slow_model_of_one_robot_delays_no_sample_of_another(
    sessions: tuple[Session, Session], monkeypatch: pytest.MonkeyPatch
):
    writer, reader = sessions
    is_loading, may_go_on = threading.Event(), threading.Event()
    describe = RobotIngests.describe

    def slow(ingests: RobotIngests, robot: str, description) -> None:
        if robot == "r2":
            is_loading.set()
            may_go_on.wait(DEADLINE_S)
        describe(ingests, robot, description)

    monkeypatch.setattr(RobotIngests, "describe", slow)
    with (
        TransformListener(reader) as listener,
        StatePublisher(writer, RRBOT, "r1") as publisher,
        OdometryPublisher(writer, "r1") as odometry,
    ):
        wait_for_stream_readers(writer, "r1")
        until(lambda: feed_of(listener.buffer).domain.domain_of("r1") == "system")
        with StatePublisher(writer, RRBOT, "r2"):
            assert is_loading.wait(DEADLINE_S)
            publisher.publish([0.0, 0.0], stamp=STAMP)
            still = Transform("odom", "world", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            odometry.publish(still, np.zeros(3), np.zeros(3), STAMP)
            until(lambda: listener.buffer.can_lookup("r1/odom", "r1/tool", STAMP))
            assert not may_go_on.is_set()
            may_go_on.set()
            until(lambda: "r2" in listener.robots())
