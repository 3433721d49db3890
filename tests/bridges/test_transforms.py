"""Edges of programs on the other side of a bridge, each program with a publisher of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from helpers.processes import until
from helpers.robots import RRBOT, STAMP

from zstate.bridges.transforms import TransformRelay, edge_writer_of_node
from zstate.errors import Closed
from zstate.net.discovery import discover
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.transform import Transform

POSE = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
ODOMETRY = (("odom", "world"),)


@pytest.fixture
def refusals() -> Counter[str]:
    return Counter()


@pytest.fixture
def relay(sessions: tuple[Session, Session], refusals: Counter[str]) -> Iterator[TransformRelay]:
    def open_publisher(writer: str) -> TransformPublisher:
        return TransformPublisher(sessions[0], "r1", writer)

    with TransformRelay("r1", RRBOT, open_publisher, lambda reason, _: refusals.update([reason])) as relay:
        yield relay


def names(session: Session) -> set[str]:
    return {name for info in discover(session, 0.2) for name, _ in info.named("transforms")}


def test_writers_are_named_after_their_nodes():
    assert edge_writer_of_node("/r1/ekf_node") == "r1.ekf_node"


def test_edges_of_the_model_are_left_out_under_any_of_their_names(relay, refusals):
    assert not relay.publish("rsp", (("base", "upper"),), POSE, STAMP)
    assert not relay.publish("rsp", (("r1/base", "r1/upper"),), POSE, STAMP)
    assert (relay.writers, refusals) == ((), {})
    assert relay.publish("rsp", (("base", "upper"), *ODOMETRY), POSE.repeat(2, axis=0), STAMP)
    assert relay.writers == ("rsp",)


def test_a_silent_writer_is_closed_and_opened_again_with_its_next_sample(relay, sessions):
    assert relay.publish("ekf", ODOMETRY, POSE, STAMP)
    relay.remove_silent(3600.0)
    assert names(sessions[1]) == {"ekf"}
    relay.remove_silent(0.0)
    until(lambda: names(sessions[1]) == set())
    assert relay.publish("ekf", ODOMETRY, POSE, STAMP + 1)
    assert names(sessions[1]) == {"ekf"}


def test_edges_of_another_owner_are_refused_until_it_has_left(relay, refusals, sessions):
    with (
        TransformListener(sessions[1], "r1") as listener,
        TransformPublisher(sessions[1], "r1", "slam") as slam,
    ):
        slam.publish([Transform("odom", "world", (5.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))], STAMP)
        assert not relay.publish("ekf", ODOMETRY, POSE, STAMP)
        assert not relay.publish("ekf", ODOMETRY, POSE, STAMP + 1)
        assert relay.publish("ekf", (("odom", "ball"),), POSE, STAMP)
        assert refusals == {"second writer": 2}
        slam.close()
        stamps = iter(range(STAMP + 2, STAMP + 1_000_000))
        until(lambda: relay.publish("ekf", ODOMETRY, POSE, next(stamps)))
        until(lambda: listener.buffer.lookup("odom", "world").translation[0] == 1.0)


def test_bad_numbers_refuse_only_their_own_sample(relay, refusals):
    assert not relay.publish("ekf", ODOMETRY, POSE * np.nan, STAMP)
    assert relay.publish("ekf", ODOMETRY, POSE, STAMP + 1)
    assert refusals == {"bad numbers": 1}


def test_nothing_is_published_after_close(relay):
    relay.close()
    with pytest.raises(Closed):
        relay.publish("ekf", ODOMETRY, POSE, STAMP)
