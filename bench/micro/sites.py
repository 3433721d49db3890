"""What the robots of a site cost on its uplink: bytes, CPU and memory of both routers, discovery.

Four processes publish the robots of one site through its router; one process at headquarters follows all of
them through the uplink, which passes their joint states thinned. Programs use socket files, so that all that
is on the loopback interface is the uplink, in both directions, with the headers of TCP and IP. Run it in a
network of its own: ``unshare -n sh -c "ip link set lo up; python -m bench.micro sites"``.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from bench.measure import cpu_ns, loopback_bytes, status
from bench.micro.fleet import JOIN_WITHIN_S, PROCESSES, publish
from bench.micro.form import Row, result_of, running_role, send_event
from bench.process import running_command
from zstate import TransformListener, connect, discover
from zstate.net.sites import discover_sites

_HEADQUARTERS = "tcp/127.0.0.1:7447"


def measure(
    robots: tuple[int, ...] = (30, 100, 300),
    rate: float = 50.0,
    thin: float = 5.0,
    robot: str = "a1",
    seconds: float = 4.0,
) -> Iterator[Row]:
    """Rows of each number of robots."""
    for count in robots:
        with ExitStack() as opened:
            folder = Path(opened.enter_context(tempfile.TemporaryDirectory()))
            site, desk = (f"unixsock-stream/{folder / name}" for name in ("site", "desk"))
            names = folder / "robots.txt"
            names.write_text("\n".join(f"robot{number}" for number in range(count)))
            hq, _ = opened.enter_context(
                running_command("router", "--listen", _HEADQUARTERS, "--listen", desk, text="listens")
            )
            link = ("--site", "plant1", "--uplink", _HEADQUARTERS, "--thin", f"joint_states={thin}")
            options = (*link, "--robot-file", str(names), "--listen", site)
            router, _ = opened.enter_context(running_command("router", *options, text="leave for"))
            before_kb = [status(one)["VmRSS"] for one in (router, hq)]
            task = {"robot": robot, "robots": count, "endpoint": site}
            shares = [running_role(publish, rate=rate, share=n, **task) for n in range(PROCESSES)]
            for one in [opened.enter_context(share) for share in shares]:
                one.wait_for_event("open", JOIN_WITHIN_S)
            reader = opened.enter_context(running_role(follow, robots=count, endpoint=desk, seconds=seconds))
            reader.wait_for_event("joined", JOIN_WITHIN_S)
            time.sleep(seconds)  # until models and clock offsets are through
            routers = (router, hq)
            cpu, sent, begin = [*map(cpu_ns, routers)], loopback_bytes(), time.monotonic()
            time.sleep(seconds)
            lasted = time.monotonic() - begin
            sent_s = (loopback_bytes() - sent) / lasted
            busy = [(cpu_ns(one) - was) * 1e-9 / lasted for one, was in zip(routers, cpu, strict=True)]
            grown_kb = [status(one)["VmRSS"] - was for one, was in zip(routers, before_kb, strict=True)]
            rows = result_of(reader, JOIN_WITHIN_S)
        yield Row(f"{count} robots: uplink", "kB/s", [1e-3 * sent_s])
        yield Row(f"{count} robots: uplink for a robot", "B/s", [sent_s / count])
        for name, share, memory in zip(("site", "headquarters"), busy, grown_kb, strict=True):
            yield Row(f"{count} robots: router of the {name}: CPU", "% of a core", [100.0 * share])
            yield Row(f"{count} robots: router of the {name}: memory of a robot", "kB", [memory / count])
        for what, unit, value in rows:
            yield Row(f"{count} robots: {what}", unit, [value])


def follow(robots: int, endpoint: str, seconds: float) -> list[tuple[str, str, float]]:
    """Discovers, then follows, the robots at headquarters."""
    with connect(mode="client", endpoints=endpoint) as session:
        send_event("ready")
        begin = time.monotonic()
        assert len(discover(session)) == robots, "not all robots were discovered"
        discovery_s, begin = time.monotonic() - begin, time.monotonic()
        sites = discover_sites(session)
        site_s, begin = time.monotonic() - begin, time.monotonic()
        assert len(sites.robots["plant1"]) == robots, "the site does not announce all robots"
        with TransformListener(session, history_on_join=False) as listener:
            while len(listener.robots()) < robots or listener.stats.received < 3 * robots:
                assert time.monotonic() < begin + JOIN_WITHIN_S, "not all robots were received"
                time.sleep(0.02)
            joining_s = time.monotonic() - begin
            send_event("joined")
            time.sleep(seconds)
            counted, cpu_s, begin = listener.stats, time.process_time(), time.monotonic()
            time.sleep(seconds)
            lasted, cpu_s, stats = time.monotonic() - begin, time.process_time() - cpu_s, listener.stats
            return [
                ("discover", "s", discovery_s),
                ("discover the site", "s", site_s),
                ("reader: opening until each has three samples", "s", joining_s),
                ("reader: CPU", "% of a core", 100.0 * cpu_s / lasted),
                ("reader: samples of a robot", "1/s", (stats.received - counted.received) / lasted / robots),
            ]
