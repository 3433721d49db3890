"""The programs of several sites and of headquarters, each in the network namespace of its host.

Run as ``python -c CODE ROLE NAMESPACE ARGUMENTS``. ROLE is "router", whose arguments are those of `zstate
router`, "robots" or "headquarters", or "flood" and "counter" for a link that is full. All but the first
reply to queries, JSON on standard input, line by line.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zenoh
from helpers.fault_programs import ShiftedClock, enter_namespace
from helpers.robots import RRBOT

from zstate import StatePublisher, TransformListener, connect
from zstate.errors import LookupFailed
from zstate.net.clock_offset import measure_offsets
from zstate.net.security.credentials import Credentials
from zstate.net.sites import discover_sites

TESTS = str(Path(__file__).parents[1])
CODE = f"import sys; sys.path.insert(0, {TESTS!r}); from helpers import site_programs; site_programs.main()"

RATE_HZ = 50.0
MAX_AGE_S = 0.8
"""Above four times the interval of 5 Hz."""


def main() -> None:
    role, namespace, *arguments = sys.argv[1:]
    enter_namespace(namespace)
    if role == "router":
        from zstate.cli.main import main as command

        sys.argv = ["zstate", "router", *arguments]
        command()
    else:
        {"robots": robots, "headquarters": headquarters, "flood": flood, "counter": counter}[role](*arguments)


def serve(**answers: Any) -> None:
    print("ready", flush=True)
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        print(json.dumps(answers[name](*arguments)), flush=True)


def robots(endpoint: str, names: str, shift_s: str) -> None:
    """Publishes robots at ``RATE_HZ``, and reads the first of them as a program of the site does."""
    clock, stop = ShiftedClock(), threading.Event()
    clock.shift_ns = round(float(shift_s) * 1e9)
    with connect(mode="client", endpoints=endpoint) as session, ExitStack() as opened:
        publishers = [
            opened.enter_context(StatePublisher(session, RRBOT, name, clock=clock, cache_s=10.0))
            for name in names.split(",")
        ]
        reading = opened.enter_context(connect(mode="client", endpoints=endpoint))
        near = opened.enter_context(TransformListener(reading, publishers[0].robot))

        def run() -> None:
            begin, tick = time.monotonic(), 0
            while not stop.wait(max(0.0, begin + tick / RATE_HZ - time.monotonic())):
                for publisher in publishers:
                    publisher.publish([0.3 * ((tick * 7919) % 11), 0.1 * (tick % 5)])
                tick += 1

        threading.Thread(target=run, daemon=True).start()
        serve(
            received=lambda: (near.stats.received, near.stats.missed),
            pose=lambda at: near.buffer.wait("base", "lower", at, 5.0).to_dict(),
            latest=lambda: near.buffer.latest("base", "lower"),
        )


def headquarters(endpoint: str, certs: str, names: str) -> None:
    """Follows all robots, as the identity "desk"."""
    everyone = names.split(",")
    credentials = Credentials.from_folder(certs, "desk")
    with (
        connect(mode="client", endpoints=endpoint, credentials=credentials) as session,
        TransformListener(session, "*", history_on_join=False) as listener,
    ):

        def is_fresh(robot: str) -> bool:
            """Whether the newest pose is not too old by its stamp."""
            try:
                listener.buffer.lookup(f"{robot}/base", f"{robot}/lower", max_age_s=MAX_AGE_S)
            except LookupFailed:
                return False
            return True

        def fresh() -> list[str]:
            return [robot for robot in everyone if is_fresh(robot)]

        def when(wanted: list[str], timeout_s: float) -> float | None:
            """How long until exactly ``wanted`` are fresh [s]."""
            began = time.monotonic()
            while sorted(fresh()) != sorted(wanted):
                if time.monotonic() > began + timeout_s:
                    return None
                time.sleep(0.005)
            return time.monotonic() - began

        def rates(seconds: float) -> dict[str, float]:
            """Samples a second of each robot."""
            before = {robot: listener.stats_of(robot).received for robot in everyone}
            time.sleep(seconds)
            return {
                robot: (listener.stats_of(robot).received - before[robot]) / seconds for robot in everyone
            }

        serve(
            fresh=fresh,
            when=when,
            rates=rates,
            sites=lambda: {site: sorted(of) for site, of in discover_sites(session).robots.items()},
            exact=lambda robot, at: listener.lookup(
                f"{robot}/base", f"{robot}/lower", at, exact=True, timeout_s=5.0
            ).to_dict(),
            refused=lambda: dict(listener.stats.refused),
            offsets=lambda: {one.robot: one.offset_ns * 1e-9 for one in measure_offsets(session, "*")},
        )


def counter(endpoint: str, certs: str = "") -> None:
    """Counts what arrives of a flood, as the identity "desk" if there are certificates."""
    arrived: list[int] = []
    credentials = Credentials.from_folder(certs, "desk") if certs else None
    with connect(mode="client", endpoints=endpoint, credentials=credentials) as session:
        session.zenoh.declare_subscriber("zstate/r1/status/*", lambda _: arrived.append(1))
        serve(arrived=lambda: len(arrived))


def flood(endpoint: str) -> None:
    """Publishes 6 Mbit/s that wait for room on a link, and receives them on the same host."""
    ages_s: list[float] = []
    with (
        connect(mode="client", endpoints=endpoint) as writer,
        connect(mode="client", endpoints=endpoint) as reader,
    ):
        reader.zenoh.declare_subscriber(
            "zstate/r1/status/*",
            lambda one: ages_s.append(time.monotonic() - float(one.payload.to_string()[:20])),
        )
        block = zenoh.CongestionControl.BLOCK
        keys = [
            writer.zenoh.declare_publisher(f"zstate/r1/status/{n}", congestion_control=block)
            for n in range(50)
        ]

        def run(seconds: float) -> dict[str, float]:
            begin, ticks = time.monotonic(), round(seconds * RATE_HZ)
            for tick in range(ticks):
                for key in keys:
                    key.put(f"{time.monotonic():020.9f}{'x' * 280}")
                time.sleep(max(0.0, begin + (tick + 1) / RATE_HZ - time.monotonic()))
            return {"sent": ticks * len(keys), "received": len(ages_s), "oldest_s": max(ages_s)}

        serve(run=run)
