"""What a robot of a fleet costs: discovery, joining, CPU and memory, for a small fleet and a large one.

Four processes publish the robots through one router, each over one link; another follows all of them. All
processes are new for each number of robots. Memory is the growth of the resident memory, divided by the
number of robots: of publishers and router until all robots are open, of the reader from before it opens until
the end. A cost that grows faster than the fleet has a larger value for the large one.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack

from bench.measure import status
from bench.micro.form import Row, end_of_input, result_of, running_role, send_event
from bench.process import free_ports, running_command
from zstate import SineSource, StatePublisher, TransformListener, connect, discover, load_model
from zstate.net.session import Session

PROCESSES = 4
JOIN_WITHIN_S = 120.0


def measure(
    robots: tuple[int, ...] = (100, 1000), rate: float = 10.0, robot: str = "a1", seconds: float = 10.0
) -> Iterator[Row]:
    """Rows of each fleet."""
    for count in robots:
        endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
        task = {"robot": robot, "robots": count, "endpoint": endpoint}
        with ExitStack() as opened:
            router, _ = opened.enter_context(running_command("router", "--listen", endpoint, text="listens"))
            before_kb, begin = status(router)["VmRSS"], time.monotonic()
            shares = [running_role(publish, rate=rate, share=n, **task) for n in range(PROCESSES)]
            publishers = [opened.enter_context(share) for share in shares]
            grown_kb = sum(one.wait_for_event("open", JOIN_WITHIN_S)["grown_kb"] for one in publishers)
            opening_s = time.monotonic() - begin
            router_kb = status(router)["VmRSS"] - before_kb
            begin = time.monotonic()
            ls = (sys.executable, "-m", "zstate", "ls", "--connect", endpoint)
            subprocess.run(ls, stdout=subprocess.DEVNULL, check=True)
            ls_s = time.monotonic() - begin
            reader = opened.enter_context(running_role(read, seconds=seconds, **task))
            read_rows = result_of(reader, JOIN_WITHIN_S + 2.0 * seconds)
        own = [
            ("publisher: opening a robot", "ms", 1e3 * opening_s / count),
            ("publisher: memory of a robot", "kB", grown_kb / count),
            ("router: memory of a robot", "kB", router_kb / count),
            ("zstate ls", "s", ls_s),
        ]
        for what, unit, value in (*own, *read_rows):
            yield Row(f"{count} robots: {what}", unit, [value])


def publish(robot: str, robots: int, endpoint: str, rate: float, share: int) -> None:
    """Publishes a share of the robots, and reports its growth [kB]."""
    ended, model = end_of_input(), load_model(robot)
    source = SineSource(model)
    rows = [source.read(n * 10_000_000).positions for n in range(600)]
    with connect(mode="client", endpoints=endpoint) as session:
        StatePublisher(session, model, f"first{share}").close()  # imports and tables of the model
        send_event("ready")
        before_kb = status("self")["VmRSS"]
        names = [f"robot{number}" for number in range(share, robots, PROCESSES)]
        publishers = [StatePublisher(session, model, name) for name in names]
        send_event("open", grown_kb=status("self")["VmRSS"] - before_kb)
        begin, tick = time.monotonic(), 0
        while not ended.wait(max(0.0, begin + tick / rate - time.monotonic())):
            for publisher in publishers:
                publisher.publish(rows[tick % len(rows)])
            tick += 1


def read(robot: str, robots: int, endpoint: str, seconds: float) -> list[tuple[str, str, float]]:
    """Discovers and follows all robots."""
    model = load_model(robot)
    with connect(mode="client", endpoints=endpoint) as session:
        send_event("ready")
        begin = time.monotonic()
        assert len(discover(session)) == robots, "not all robots were discovered"
        discovery = ("discover", "s", time.monotonic() - begin)
        return [discovery, *follow(session, [model.root, model.links[-1]], robots, seconds)]


def follow(
    session: Session, ends: Sequence[str], robots: int, seconds: float
) -> list[tuple[str, str, float]]:
    """The costs of a listener: until it can look up every robot, and for some seconds after that."""
    before_kb, begin = status("self")["VmRSS"], time.monotonic()
    with TransformListener(session) as listener:
        buffer = listener.buffer
        pairs = [tuple(f"robot{number}/{end}" for end in ends) for number in range(robots)]
        while not all(buffer.can_lookup(*pair) for pair in pairs):
            assert time.monotonic() < begin + JOIN_WITHIN_S, "not all robots were received"
            time.sleep(0.02)
        joining_s = time.monotonic() - begin
        time.sleep(seconds)  # until clock offsets and history are through
        counted, cpu_s, begin = listener.stats, time.process_time(), time.monotonic()
        time.sleep(seconds)
        lasted, cpu_s, stats = time.monotonic() - begin, time.process_time() - cpu_s, listener.stats
        received = stats.received - counted.received
        return [
            ("reader: opening until each can be looked up", "s", joining_s),
            ("reader: memory of a robot", "kB", (status("self")["VmRSS"] - before_kb) / robots),
            ("reader: CPU", "% of a core", 100.0 * cpu_s / lasted),
            ("reader: CPU of a sample", "us", 1e6 * cpu_s / max(1, received)),
            ("samples received", "1/s", received / lasted),
            ("lost while running", "", stats.dropped + stats.missed - counted.dropped - counted.missed),
            ("lost while joining", "", counted.dropped + counted.missed),
        ]
