"""kill -9 and restart under load: once each, and twenty times in a soak, which shows what a round leaks."""

from __future__ import annotations

import time
from collections.abc import Sequence

import pytest
from helpers.fault_processes import (
    RECOVERED_WITHIN_S,
    FaultProcess,
    Start,
    assert_no_growth,
    client,
    print_figures,
)
from helpers.processes import find_free_port

pytestmark = pytest.mark.processes

KILLS = pytest.mark.parametrize(
    "kills", [pytest.param(1, id="once"), pytest.param(20, id="twenty times", marks=pytest.mark.soak)]
)
RATE_HZ = 200.0
SETTLED = 2


def since(process: FaultProcess, received_at: int | None) -> float:
    """Seconds from the readiness of a process to the first lookup of the reader."""
    assert received_at is not None
    return max(0.0, (received_at - process.ready_at) * 1e-9)


def assert_settled(before: list[dict[str, int]], processes: Sequence[FaultProcess]) -> None:
    """Asserts that no kill after the first two has cost the other processes anything; one shows nothing."""
    for was, process in zip(before, processes if before else (), strict=True):
        assert_no_growth(was, process.query("census"))


def killed(process: FaultProcess) -> int:
    """Kills the process; returns the time [ns]."""
    process.kill()
    return time.time_ns()


@KILLS
def test_killed_publisher_is_received_again(start: Start, endpoint: str, kills: int):
    def publisher(mark: float) -> FaultProcess:
        return start(
            "publisher", robot="r1", session=client(endpoint), rate_hz=RATE_HZ, mark=mark, wait=False
        )

    router = start("router", listen=endpoint)
    reader = start("reader", session=client(endpoint))
    publishing = publisher(0.0).wait_ready()
    assert reader.query("after", "r1", 0)
    before, answered, latched, silent = [], [], [], []
    for mark in range(1, kills + 1):
        killed_at = killed(publishing)
        publishing = publisher(mark)
        publishing.wait_ready()
        silent.append((reader.query("after", "r1", killed_at) - killed_at) * 1e-9)
        answered.append(since(publishing, reader.query("after", "r1", publishing.ready_at)))
        latched.append(since(publishing, reader.query("mark", "r1", mark)))
        if mark == SETTLED:
            before = [reader.query("census"), router.query("census")]
    assert_settled(before, (reader, router))
    print_figures("publisher killed: silent, with the time to start another", silent)
    print_figures("publisher killed: answers again after the new one is ready", answered)
    print_figures("publisher killed: new latched value after", latched)
    assert max(answered) < RECOVERED_WITHIN_S
    assert max(latched) < RECOVERED_WITHIN_S
    assert reader.query("stats")["refused"] == {}


@KILLS
def test_killed_router_loses_no_latched_value_changed_during_the_outage(
    start: Start, endpoint: str, kills: int
):
    router = start("router", listen=endpoint)
    publisher = start("publisher", robot="r1", session=client(endpoint), rate_hz=RATE_HZ)
    reader = start("reader", session=client(endpoint))
    assert reader.query("after", "r1", 0)
    before, answered, latched, silent = [], [], [], []
    for mark in range(1, kills + 1):
        killed_at = killed(router)
        publisher.query("mark", mark)  # no router forwards it now
        router = start("router", listen=endpoint)
        silent.append((reader.query("after", "r1", killed_at) - killed_at) * 1e-9)
        answered.append(since(router, reader.query("after", "r1", router.ready_at)))
        latched.append(since(router, reader.query("mark", "r1", mark)))
        if mark == SETTLED:
            before = [reader.query("census"), publisher.query("census")]
    assert_settled(before, (reader, publisher))
    late = start("reader", session=client(endpoint))
    assert late.query("after", "r1", late.ready_at) and late.query("mark", "r1", kills)
    print_figures("router killed: silent, with the time to start another", silent)
    print_figures("router killed: answers again after the new one is ready", answered)
    print_figures("router killed: latched value changed during the outage after", latched)
    assert max(answered) < RECOVERED_WITHIN_S
    assert max(latched) < RECOVERED_WITHIN_S


@KILLS
def test_killed_listener_has_all_data_again(start: Start, endpoint: str, kills: int):
    router = start("router", listen=endpoint)
    publisher = start("publisher", robot="r1", session=client(endpoint), rate_hz=RATE_HZ, mark=7.0)
    witness = start("reader", session=client(endpoint))
    before, answered, latched = [], [], []
    for number in range(1, kills + 1):
        reader = start("reader", session=client(endpoint))
        answered.append(since(reader, reader.query("after", "r1", reader.ready_at)))
        latched.append(since(reader, reader.query("mark", "r1", 7.0)))
        reader.kill()
        if number == SETTLED:
            before = [process.query("census") for process in (publisher, router, witness)]
    assert_settled(before, (publisher, router, witness))
    stats = witness.query("stats")
    assert (stats["missed"], stats["dropped"], stats["refused"]) == (0, 0, {})
    print_figures("listener killed: answers again after", answered)
    print_figures("listener killed: latched value after", latched)
    assert max(answered) < RECOVERED_WITHIN_S
    assert max(latched) < RECOVERED_WITHIN_S


def test_clients_of_a_killed_router_continue_with_the_next(start: Start):
    first, second = (f"tcp/127.0.0.1:{find_free_port()}" for _ in range(2))
    both = client(first, second)
    dying = start("router", listen=first)
    left = start("router", listen=second, connect_to=[first])
    publisher = start("publisher", robot="r1", session=both, rate_hz=RATE_HZ)
    reader = start("reader", session=both)
    assert reader.query("after", "r1", 0)
    assert publisher.query("routers") == [dying.query("zid")]
    reader.query("watch", "r1")
    killed_at = reader.query("newest", "r1")
    dying.kill()
    publisher.query("mark", 5.0)
    assert reader.query("after", "r1", killed_at + 200_000_000)
    assert reader.query("mark", "r1", 5.0)
    assert publisher.query("routers") == [left.query("zid")]
    watched = reader.query("watched", "r1")
    print(f"router fail-over: a gap of {watched['gap_ns'] * 1e-9:.3f} s")
    assert watched["went_back"] == 0
    assert watched["gap_ns"] * 1e-9 < RECOVERED_WITHIN_S
