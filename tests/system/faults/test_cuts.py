"""Network cuts shorter and longer than the timeout of a connection."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest
from helpers.fault_processes import RECOVERED_WITHIN_S, FaultProcess, Start, assert_no_growth, client
from helpers.fault_queries import MAX_AGE_S
from helpers.network_namespaces import NamespaceHosts
from helpers.processes import until

pytestmark = [
    pytest.mark.processes,
    pytest.mark.netns,
]

RATE_HZ = 100.0
CUT_READERS = ("swallowed5", "swallowed15", "unplugged5", "unplugged15")
"""Hosts of readers, named for the kind of their cut and its length [s]."""


class Watched(NamedTuple):
    """A reader that monitors ``robot`` across a cut, and the functions that make and end the cut."""

    process: FaultProcess
    robot: str
    cut: Callable[[], None]
    heal: Callable[[], None]
    seconds: float


@pytest.fixture
def hosts() -> Iterator[NamespaceHosts]:
    with NamespaceHosts("robot", "writer", *CUT_READERS) as hosts:
        yield hosts


def test_recovery_from_cuts_of_5_and_15_s_takes_no_old_sample_as_new(start: Start, hosts: NamespaceHosts):
    at_home, away = client("tcp/127.0.0.1:7447"), client(f"tcp/{hosts.address('robot')}:7447")
    home = hosts.namespace("robot")
    router = start("router", listen="tcp/0.0.0.0:7447", namespace=home)
    writer = start("publisher", robot="r1", session=at_home, rate_hz=RATE_HZ, namespace=home)
    cut_writer = start(
        "publisher", robot="r2", session=away, rate_hz=RATE_HZ, namespace=hosts.namespace("writer")
    )
    for robot, session, host in (("r1", at_home, home), ("r2", away, hosts.namespace("writer"))):
        start("odometry", robot=robot, session=session, rate_hz=RATE_HZ, namespace=host)
    witness = start("reader", session=at_home, namespace=home)
    watching = {"writer": Watched(witness, "r2", *swallowing(hosts, "writer"), 15.0)}
    for name in CUT_READERS:
        reader = start("reader", session=away, namespace=hosts.namespace(name))
        way = swallowing(hosts, name) if name.startswith("swallowed") else unplugging(hosts, name)
        watching[name] = Watched(reader, "r1", *way, 15.0 if name.endswith("15") else 5.0)
    for one in watching.values():
        assert one.process.query("after", "r1", 0)
        assert one.process.query("after", "r2", 0)
        for motion in ("", "odometry "):
            assert one.process.query(f"{motion}after", one.robot, 0)
            one.process.query(f"{motion}watch", one.robot)
    before = [one.process.query("census") for one in watching.values()], router.query("census")

    began = time.monotonic()
    for one in watching.values():
        one.cut()
    writer.query("mark", 1.0)  # latched values that change during the cut
    cut_writer.query("mark", 1.0)
    healed = {}
    for name, one in sorted(watching.items(), key=lambda named: named[1].seconds):
        until(lambda one=one: time.monotonic() >= began + one.seconds, timeout_s=20.0)
        one.heal()
        healed[name] = time.time_ns()
        one.process.send("after", one.robot, healed[name])
        one.process.send("mark", one.robot, 1.0)

    for name, one in watching.items():
        check_recovery(name, one, healed[name])
    stats = witness.query("stats")
    assert stats["refused"] == {}
    for was, one in zip(before[0], watching.values(), strict=True):
        assert_no_growth(was, one.process.query("census"))
    assert_no_growth(before[1], router.query("census"))


def swallowing(hosts: NamespaceHosts, name: str) -> tuple[Callable[[], None], Callable[[], None]]:
    return lambda: hosts.drop_packets(name), lambda: hosts.pass_packets(name)


def unplugging(hosts: NamespaceHosts, name: str) -> tuple[Callable[[], None], Callable[[], None]]:
    return lambda: hosts.unplug(name), lambda: hosts.plug(name)


def check_recovery(name: str, one: Watched, healed_at: int) -> None:
    received_at, latched_at = one.process.receive(), one.process.receive()
    assert received_at, name
    assert latched_at, name
    for motion in ("", "odometry "):
        one.process.query(f"{motion}after", one.robot, received_at)  # the monitor sees the end of the gap
    watched, stats = one.process.query("watched", one.robot), one.process.query("stats")
    moved = one.process.query("odometry watched", one.robot)
    received_s, latched_s = ((at - healed_at) * 1e-9 for at in (received_at, latched_at))
    print(
        f"{name}: answers again {received_s:.3f} s after the heal, latched value after {latched_s:.3f} s; "
        f"missed {stats['missed']}, late {stats['late']}, stale lookups {watched['stale']}"
    )
    for seen in (watched, moved):
        assert (seen["went_back"], seen["old_as_fresh"], seen["wrong"]) == (0, 0, 0), name
    assert moved["stale"] > 0, name
    assert watched["gap_ns"] > (one.seconds - MAX_AGE_S) * 1e9, name
    assert watched["stale"] > 0, name
    # Lost samples are counted: all that were published during the cut, except for queued ones.
    assert stats["missed"] > (one.seconds - 4.0) * RATE_HZ / 2, name
    assert received_s < RECOVERED_WITHIN_S, name
    assert latched_s < RECOVERED_WITHIN_S, name
