"""What a robot of a fleet costs: discovery, joining, CPU and memory, for a small fleet and a large one.

    python -m bench.micro.fleet [--robots 100 1000] [--rate 10] [--robot a1] [--seconds 10]

Four processes publish the robots through one router, each over one link; another follows all of them. All
processes are new for each number of robots. Memory is the growth of the resident memory, divided by the
number of robots: of publishers and router until all robots are open, of the reader from before it opens until
the end. A cost that grows faster than the fleet has a larger value for the large one.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from bench.micro.processes import running_command, running_process
from bench.process import free_ports
from zstate import SineSource, StatePublisher, TransformListener, connect, discover, load_model
from zstate.net.session import Session

PROCESSES = 4
JOIN_WITHIN_S = 120.0


def main() -> None:
    """Print the table, or run one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--robot", default="a1")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--role", choices=("publish", "read"), help=argparse.SUPPRESS)
    parser.add_argument("--share", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role == "publish":
        publish(options)
    elif options.role == "read":
        print(json.dumps(read(options)))
    else:
        print_table([measure(options, count) for count in options.robots])


def measure(options: argparse.Namespace, robots: int) -> dict[str, Any]:
    """The figures of one fleet."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    task = ("--robots", str(robots), "--rate", str(options.rate), "--robot", options.robot)
    task = (*task, "--seconds", str(options.seconds), "--endpoint", endpoint)
    program = (sys.executable, "-m", "bench.micro.fleet", *task, "--role")
    with ExitStack() as opened:
        router, _ = opened.enter_context(running_command("router", "--listen", endpoint))
        before_kb, start_s = resident_kb(router), time.monotonic()
        grown_kb = 0.0
        for share in range(PROCESSES):
            _, line = opened.enter_context(running_process(*program, "publish", "--share", str(share)))
            grown_kb += float(line)
        opening_s = time.monotonic() - start_s
        router_kb = resident_kb(router) - before_kb
        ls = (sys.executable, "-m", "zstate", "ls", "--connect", endpoint)
        start_s = time.monotonic()
        subprocess.run(ls, stdout=subprocess.DEVNULL, check=True)
        ls_s = time.monotonic() - start_s
        output = subprocess.run((*program, "read"), stdout=subprocess.PIPE, check=True, text=True).stdout
        return {
            "robots": robots,
            "opening, ms a robot": opening_s / robots * 1e3,
            "publisher, kB a robot": grown_kb / robots,
            "router, kB a robot": router_kb / robots,
            "zstate ls, s": ls_s,
            **json.loads(output),
        }


def publish(options: argparse.Namespace) -> None:
    """Publish a share of the robots until the process is terminated; prints its growth [kB]."""
    model = load_model(options.robot)
    source, (robots,) = SineSource(model), options.robots
    rows = [source.read(n * 10_000_000).positions for n in range(600)]
    with connect(mode="client", endpoints=options.endpoint) as session:
        StatePublisher(session, model, f"first{options.share}").close()  # imports and tables of the model
        before_kb = resident_kb("self")
        mine = range(options.share, robots, PROCESSES)
        publishers = [StatePublisher(session, model, f"robot{number}") for number in mine]
        print(resident_kb("self") - before_kb, flush=True)
        start_s, tick = time.monotonic(), 0
        while True:
            for publisher in publishers:
                publisher.publish(rows[tick % len(rows)])
            tick += 1
            time.sleep(max(0.0, start_s + tick / options.rate - time.monotonic()))


def read(options: argparse.Namespace) -> dict[str, float]:
    """Discover and follow all robots."""
    (robots,) = options.robots
    model = load_model(options.robot)
    with connect(mode="client", endpoints=options.endpoint) as session:
        start_s = time.monotonic()
        assert len(discover(session)) == robots, "not all robots were discovered"
        discovery_s = time.monotonic() - start_s
        return {"discover, s": discovery_s, **follow(session, [model.root, model.links[-1]], robots, options)}


def follow(
    session: Session, ends: Sequence[str], robots: int, options: argparse.Namespace
) -> dict[str, float]:
    """The costs of a listener: until it can look up every robot, and for some seconds after that."""
    before_kb, start_s = resident_kb("self"), time.monotonic()
    with TransformListener(session) as listener:
        buffer = listener.buffer
        pairs = [tuple(f"robot{number}/{end}" for end in ends) for number in range(robots)]
        while not all(buffer.can_lookup(*pair) for pair in pairs):
            assert time.monotonic() < start_s + JOIN_WITHIN_S, "not all robots were received"
            time.sleep(0.02)
        joining_s = time.monotonic() - start_s
        time.sleep(options.seconds)  # until clock offsets and history are through
        counted, cpu_s, start_s = listener.stats, time.process_time(), time.monotonic()
        time.sleep(options.seconds)
        seconds, cpu_s, stats = time.monotonic() - start_s, time.process_time() - cpu_s, listener.stats
        received = stats.received - counted.received
        return {
            "joining, s": joining_s,
            "reader, kB a robot": (resident_kb("self") - before_kb) / robots,
            "reader, % of a core": 100.0 * cpu_s / seconds,
            "reader, us a sample": 1e6 * cpu_s / max(1, received),
            "samples/s received": received / seconds,
            "lost while running": stats.dropped + stats.missed - counted.dropped - counted.missed,
            "lost while joining": counted.dropped + counted.missed,
        }


def resident_kb(pid: int | str) -> int:
    """Resident memory of a process [kB]."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))


def print_table(columns: Sequence[dict[str, Any]]) -> None:
    """One row for each figure, one column for each fleet."""
    for name in columns[0]:
        print(f"{name:24}", *(f"{column[name]:12.2f}" for column in columns))


if __name__ == "__main__":
    main()
