"""Network cuts shorter and longer than the timeout of a connection."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest
from helpers.fault_processes import SLACK, FaultProcess, Start, assert_no_growth, client
from helpers.fault_queries import MAX_AGE_S
from helpers.network_namespaces import REASON, NamespaceHosts, can_create_namespaces
from helpers.processes import until

pytestmark = [
    pytest.mark.processes,
    pytest.mark.netns,
    pytest.mark.skipif(not can_create_namespaces(), reason=REASON),
]

RATE_HZ = 100.0
BOUND_S = 1.0
CUT_READERS = ("swallowed5", "swallowed15", "unplugged5", "unplugged15")
"""How a host is cut off, and for how many seconds."""


class Watched(NamedTuple):
    """Who looks at which robot across a cut, and how that cut is made and mended."""

    party: FaultProcess
    robot: str
    cut: Callable[[], None]
    heal: Callable[[], None]
    seconds: float


@pytest.fixture
def hosts() -> Iterator[NamespaceHosts]:
    with NamespaceHosts("robot", "writer", *CUT_READERS) as hosts:
        yield hosts


def test_recovery_from_cuts_of_5_and_15_s_within_a_second_without_old_samples_as_new(
    start: Start, hosts: NamespaceHosts
):
    at_home, away = client("tcp/127.0.0.1:7447"), client(f"tcp/{hosts.address('robot')}:7447")
    home = hosts.namespace("robot")
    router = start("router", listen="tcp/0.0.0.0:7447", namespace=home)
    writer = start("publisher", robot="r1", session=at_home, rate_hz=RATE_HZ, namespace=home)
    cut_writer = start(
        "publisher", robot="r2", session=away, rate_hz=RATE_HZ, namespace=hosts.namespace("writer")
    )
    witness = start("reader", session=at_home, namespace=home)
    watching = {"writer": Watched(witness, "r2", *swallowing(hosts, "writer"), 15.0)}
    for name in CUT_READERS:
        reader = start("reader", session=away, namespace=hosts.namespace(name))
        way = swallowing(hosts, name) if name.startswith("swallowed") else unplugging(hosts, name)
        watching[name] = Watched(reader, "r1", *way, 15.0 if name.endswith("15") else 5.0)
    for one in watching.values():
        assert one.party.query("after", "r1", 0)
        assert one.party.query("after", "r2", 0)
        one.party.query("watch", one.robot)
    before = [one.party.query("census") for one in watching.values()], router.query("census")

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
        one.party.send("after", one.robot, healed[name])
        one.party.send("mark", one.robot, 1.0)

    for name, one in watching.items():
        check_recovery(name, one, healed[name])
    stats = witness.query("stats")
    assert stats["refused"] == {}
    for was, one in zip(before[0], watching.values(), strict=True):
        assert_no_growth(was, one.party.query("census"))
    assert_no_growth(before[1], router.query("census"))


def swallowing(hosts: NamespaceHosts, name: str) -> tuple[Callable[[], None], Callable[[], None]]:
    return lambda: hosts.drop_packets(name), lambda: hosts.pass_packets(name)


def unplugging(hosts: NamespaceHosts, name: str) -> tuple[Callable[[], None], Callable[[], None]]:
    return lambda: hosts.unplug(name), lambda: hosts.plug(name)


def check_recovery(name: str, one: Watched, healed_at: int) -> None:
    heard_at, latched_at = one.party.receive(), one.party.receive()
    assert heard_at, name
    assert latched_at, name
    one.party.query("after", one.robot, heard_at)  # so that the watch has seen the end of the gap, too
    watched, stats = one.party.query("watched", one.robot), one.party.query("stats")
    heard_s, latched_s = ((at - healed_at) * 1e-9 for at in (heard_at, latched_at))
    print(
        f"{name}: answers again {heard_s:.3f} s after the heal, latched value after {latched_s:.3f} s; "
        f"missed {stats['missed']}, late {stats['late']}, looks found stale {watched['stale']}"
    )
    assert (watched["went_back"], watched["old_as_fresh"]) == (0, 0), name
    assert watched["gap_ns"] > (one.seconds - MAX_AGE_S) * 1e9, name
    assert watched["stale"] > 0, name
    # What was lost is counted: all that was said while nothing came through, but for what waited.
    assert stats["missed"] > (one.seconds - 4.0) * RATE_HZ / 2, name
    assert heard_s < BOUND_S * SLACK, name
    assert latched_s < BOUND_S * SLACK, name
