"""Corrections of drifting odometry, against a base whose true pose in the map is known."""

from __future__ import annotations

import re
import threading
import time
from contextlib import ExitStack

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until

from zstate.errors import InvalidInput, LookupFailed
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.odometry import MapCorrection, OdometryPublisher
from zstate.transform import Transform

MS = 1_000_000
PERIOD = 20 * MS
STILL = ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
DRIFT = Transform.from_rpy("map", "odom", (3.0, -2.0, 0.1), (0.0, 0.0, 0.7))
"""The true map_from_odom."""

COVARIANCE = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-3


class Base:
    """A base that moves at 1 m/s along x of the map, and its odometry."""

    def __init__(self, session: Session, opened: ExitStack, program: str = "wheels") -> None:
        self.odometry = opened.enter_context(OdometryPublisher(session, "r1", program=program))
        self.start = time.time_ns()
        self.stamp = self.start - PERIOD

    def pose(self, stamp: int) -> Transform:
        """The true map_from_base."""
        return Transform.from_rpy(
            "map", "base_link", ((stamp - self.start) * 1e-9, 0.0, 0.0), (0.0, 0.0, 0.3)
        )

    def drive(self, samples: int, drift: Transform = DRIFT) -> None:
        for _ in range(samples):
            self.stamp += PERIOD
            odom_from_base = drift.inverse() @ self.pose(self.stamp)
            self.odometry.publish(odom_from_base.with_covariance(COVARIANCE), *STILL, self.stamp)


@pytest.fixture
def opened():
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def base(sessions: tuple[Session, Session], opened: ExitStack) -> Base:
    return Base(sessions[0], opened)


@pytest.fixture
def correction(sessions: tuple[Session, Session], opened: ExitStack) -> MapCorrection:
    return opened.enter_context(MapCorrection(sessions[0], "r1"))


@pytest.fixture
def listener(sessions: tuple[Session, Session], opened: ExitStack) -> TransformListener:
    return opened.enter_context(TransformListener(sessions[1], "r1"))


def assert_equal(found: Transform, expected: Transform) -> None:
    np.testing.assert_allclose(found.matrix, expected.matrix, atol=1e-9)


def test_correction_that_is_late_has_no_error(
    base: Base, correction: MapCorrection, listener: TransformListener
):
    """The pose was measured 200 ms before the newest odometry sample, between two samples."""
    base.drive(21)
    measured = base.stamp - 200 * MS - PERIOD // 3
    correction.set(base.pose(measured), measured, timeout_s=DEADLINE_S)
    listener.buffer.wait("map", "base_link", base.stamp, timeout_s=DEADLINE_S)
    for at in (measured, base.stamp - 50 * MS, None):
        assert_equal(listener.buffer.lookup("map", "odom", at), DRIFT)
    now = listener.buffer.lookup("map", "base_link")
    assert (now.stamp, now.kind) == (base.stamp, "exact")
    assert_equal(now, base.pose(base.stamp))
    # With the odometry of the present, as robot_localization has it, the base is 0.2 m of the way behind.
    odom_from_base = listener.buffer.lookup("odom", "base_link")
    two_instants = base.pose(measured) @ odom_from_base.inverse()
    behind = (two_instants @ odom_from_base).translation - base.pose(base.stamp).translation
    np.testing.assert_allclose(behind, [-(base.stamp - measured) * 1e-9, 0.0, 0.0], atol=1e-9)


def test_correction_follows_the_odometry_until_the_next(
    base: Base, correction: MapCorrection, listener: TransformListener
):
    base.drive(2)
    correction.set(base.pose(base.stamp), base.stamp, timeout_s=DEADLINE_S)
    for _ in range(5):
        base.drive(1)
        found = listener.buffer.wait("map", "base_link", base.stamp, timeout_s=DEADLINE_S)
        assert_equal(found, base.pose(base.stamp))
        assert found.kind == "exact"
    before = base.stamp
    drifted = DRIFT @ Transform.from_rpy("odom", "odom", (0.5, 0.0, 0.0), (0.0, 0.0, 0.1))
    base.drive(2, drifted)
    listener.buffer.wait("map", "base_link", base.stamp, timeout_s=DEADLINE_S)
    correction.set(base.pose(base.stamp), base.stamp, timeout_s=DEADLINE_S)
    base.drive(1, drifted)
    assert_equal(listener.buffer.wait("map", "odom", base.stamp, timeout_s=DEADLINE_S), drifted)
    assert_equal(listener.buffer.lookup("map", "odom", before), DRIFT)
    with pytest.raises(InvalidInput, match=r"measured 20\.0 ms before the one that holds"):
        correction.set(base.pose(before), base.stamp - 2 * PERIOD)


def test_correction_waits_for_the_odometry_at_its_stamp(base: Base, correction: MapCorrection):
    base.drive(2)
    due = base.stamp + PERIOD // 2
    thread = threading.Thread(
        target=correction.set, args=(base.pose(due), due), kwargs={"timeout_s": DEADLINE_S}
    )
    thread.start()
    base.drive(1)
    thread.join()
    assert re.search("the newest at", repr(correction))
    with pytest.raises(TimeoutError):
        correction.set(base.pose(base.stamp), base.stamp + PERIOD, timeout_s=0.05)
    with pytest.raises(LookupFailed):
        correction.set(base.pose(base.stamp), base.start - 1, timeout_s=0.05)


def test_covariance_of_the_base_in_the_map_is_at_most_those_of_measurement_and_odometry(
    base: Base, correction: MapCorrection, listener: TransformListener
):
    """At the measured instant: the correction is carried to odom and back, and the odometry's is added."""
    base.drive(2)
    measured = Transform.from_pose7("map", "base_link", base.pose(base.stamp).pose7, base.stamp)
    correction.set(measured, timeout_s=DEADLINE_S)
    listener.buffer.wait("map", "base_link", base.stamp, timeout_s=DEADLINE_S)
    assert listener.buffer.lookup("map", "base_link").covariance is None
    correction.set(measured, covariance=COVARIANCE)
    until(lambda: listener.buffer.lookup("map", "base_link", base.stamp).covariance is not None)
    turn = np.kron(np.eye(2), DRIFT.matrix[:3, :3])
    found = listener.buffer.lookup("map", "base_link", base.stamp).covariance
    np.testing.assert_allclose(found, COVARIANCE + turn @ COVARIANCE @ turn.T, atol=1e-12)


def test_correction_ends_with_the_odometry_that_it_belongs_to(
    sessions: tuple[Session, Session],
    correction: MapCorrection,
    listener: TransformListener,
    opened: ExitStack,
):
    with ExitStack() as first:
        base = Base(sessions[0], first)
        base.drive(2)
        correction.set(base.pose(base.stamp), base.stamp, timeout_s=DEADLINE_S)
        last = base.stamp
    restarted = Base(sessions[0], opened, program="restarted")
    restarted.drive(2)
    until(lambda: "was restarted" in correction.stats.warning)
    restarted.drive(2)
    listener.buffer.wait("odom", "base_link", restarted.stamp, timeout_s=DEADLINE_S)
    assert listener.buffer.latest("map", "odom") == last
    correction.set(restarted.pose(restarted.stamp), restarted.stamp, timeout_s=DEADLINE_S)
    found = listener.buffer.wait("map", "base_link", restarted.stamp, timeout_s=DEADLINE_S)
    assert_equal(found, restarted.pose(restarted.stamp))
    assert correction.stats.warning == ""


@pytest.mark.parametrize(
    ("target", "stamp", "match"),
    [("world", 1, r"a pose in 'r1/map'; got one in 'r1/world'"), ("map", None, "has no stamp")],
)
def test_pose_without_the_facts_of_a_correction_is_refused(
    correction: MapCorrection, target: str, stamp: int | None, match: str
):
    with pytest.raises(InvalidInput, match=match):
        correction.set(Transform(target, "base_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp))
