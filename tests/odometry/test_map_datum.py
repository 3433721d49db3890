"""One datum a map: it is published, robots of a shared map take it, and contradictions are told."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

import pytest
from helpers.cli_runner import run_cli
from helpers.processes import repeated, until

from zstate import TransformBuffer
from zstate.errors import InvalidInput
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.odometry import (
    BaseEstimator,
    Datum,
    DatumPublisher,
    FixNoise,
    FixPublisher,
    ImuNoise,
    MapEstimator,
    OdometryNode,
)
from zstate.odometry.messages import MapDatum
from zstate.transform import Transform
from zstate.wire.registry import get_wire

SHARED = "site/map"
HERE, THERE = Datum(48.1, 11.5, 560.0), Datum(48.1009, 11.5, 560.0)  # 100 m to the north


@contextmanager
def node_of(
    session: Session, robot: str, map: str = SHARED, datum: Datum | None = None
) -> Generator[tuple[OdometryNode, MapEstimator]]:
    """A node with a receiver, without data of any other sensor."""
    buffer = TransformBuffer()
    base, imu, antenna = (f"{robot}/{name}" for name in ("base", "imu", "antenna"))
    for frame in (imu, antenna):
        buffer.insert_static(Transform(base, frame, (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
    noise = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
    odometry = BaseEstimator(odom=f"{robot}/odom", base=base, imu=imu, buffer=buffer, imu_noise=noise)
    in_map = MapEstimator(odometry, map=map, buffer=buffer, datum=datum)
    with OdometryNode(
        session, robot, odometry, sensors=[("gps", FixNoise(sigma=1.0))], in_map=in_map
    ) as node:
        yield node, in_map


def fixed_until(session: Session, robot: str, place: Datum, condition: Callable[[], object]) -> None:
    """Publish fixes at ``place`` until the condition is true."""
    with (
        FixPublisher(session, robot, "gps", frame="antenna") as gps,
        repeated(lambda: gps.publish(place.latitude, place.longitude, place.altitude)),
    ):
        until(condition)


@contextmanager
def datums_in(session: Session) -> Generator[dict[str, MapDatum]]:
    """Those that are published, by robot, as they arrive."""
    found: dict[str, MapDatum] = {}

    def on_messages(received: list[Received]) -> None:
        for robot, _, message in received:
            assert isinstance(message, MapDatum)
            found[robot] = message

    with subscribe(session, get_wire("native"), "*", "datum", on_messages):
        yield found


def sentence(node: OdometryNode) -> str:
    return " ".join(one.sentence for one in node.health())


def test_first_fix_is_the_datum_which_listeners_receive_whenever_they_join(sessions):
    robot, reading = sessions
    with node_of(robot, "r1", map="r1/map") as (_, in_map):
        fixed_until(robot, "r1", HERE, lambda: in_map.datum)
        for _ in range(2):
            with datums_in(reading) as found:
                until(lambda found=found: found)
                assert (found["r1"].frame, found["r1"].datum) == ("r1/map", HERE)


def test_a_second_robot_in_a_shared_map_takes_the_datum_of_the_first_before_its_own_first_fix(sessions):
    first, second = sessions
    with (
        node_of(first, "r1", datum=HERE),
        node_of(second, "r2") as (node, in_map),
        datums_in(second) as found,
    ):
        assert in_map.datum == HERE
        fixed_until(second, "r2", THERE, lambda: "gps" in [one.name for one in node.health()])
        until(lambda: len(found) == 2)
        assert in_map.datum == found["r2"].datum == HERE
        assert "datum" not in sentence(node)


def test_a_robot_that_waits_for_its_first_fix_takes_a_datum_that_is_published_meanwhile(sessions):
    first, second = sessions
    with node_of(second, "r2") as (_, in_map), DatumPublisher(first, "r1", SHARED) as publisher:
        assert in_map.datum is None
        publisher.set(HERE)
        until(lambda: in_map.datum == HERE)


def test_a_second_robot_with_another_datum_for_a_shared_map_is_refused_with_both_and_their_distance(sessions):
    first, second = sessions
    both = r"'site/map' is 48.1009000 11.5000000 560.00 here and 48.1000000 .* of 'r1', 100.\d\d m away"
    with node_of(first, "r1", datum=HERE):
        with pytest.raises(InvalidInput, match=both), node_of(second, "r2", datum=THERE):
            pass
        with node_of(second, "r2", datum=Datum(48.1, 11.50000001, 560.0)) as (_, in_map):  # 0.7 mm
            assert in_map.datum != HERE


def test_robots_that_start_at_once_with_two_datums_are_told_in_their_health_until_one_ends(sessions):
    first, second = sessions
    with node_of(second, "r2", datum=THERE) as (node, _):
        fixed_until(second, "r2", THERE, node.health)
        with DatumPublisher(first, "r1", SHARED) as publisher:
            publisher.set(HERE)
            until(lambda: "of 'r1', 100." in sentence(node))
            publisher.set(THERE)
            until(lambda: "of 'r1'" not in sentence(node))
            publisher.set(HERE)
            until(lambda: "of 'r1', 100." in sentence(node))
        until(lambda: "of 'r1'" not in sentence(node))


def test_maps_of_their_own_may_have_different_datums(sessions):
    first, second = sessions
    with (
        node_of(first, "r1", map="r1/map", datum=HERE),
        node_of(second, "r2", map="r2/map", datum=THERE) as (node, _),
        datums_in(second) as found,
    ):
        fixed_until(second, "r2", THERE, node.health)
        until(lambda: len(found) == 2)
        assert "datum" not in sentence(node)


def test_echo_and_doctor_tell_the_datum_of_a_map_and_that_robots_disagree(sessions):
    first, second = sessions
    with DatumPublisher(first, "r1", SHARED) as one, DatumPublisher(second, "r2", SHARED) as other:
        one.set(HERE)
        other.set(HERE)
        document = run_cli("echo", "r1", "--stream", "datum", "--once", "--json").stdout
        assert '"frame": "site/map", "latitude": 48.1, "longitude": 11.5, "altitude": 560.0' in document
        assert "the origin of 'site/map' is at 48.1000000 11.5000000 560.00" in diagnosis()
        other.set(THERE)
        assert "48.1000000 11.5000000 560.00, and by 'r2' at 48.1009000" in diagnosis()


def diagnosis() -> str:
    return " ".join(run_cli("doctor", "r1").stdout.split())
