"""Network queries: history on join, one lookup, clock offset, metrics.

    python -m bench.micro.queries [--robot panda] [--times 50]

A publisher process at 1 kHz and a router process; this process is a client of the router. Measured in turn:
from opening a listener to an answer 1.9 s in the past; one query on ``zstate/<robot>/lookup``; the error of
the measured offset of the publisher's clock (the true offset is 0, since it is the same clock) and the
reported uncertainty; one scrape of a listener's metrics.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from urllib.request import urlopen

import numpy as np

from bench.micro.processes import running_command, use_own_rendezvous
from bench.process import free_ports
from zstate import TransformListener, connect, load_model
from zstate.metrics.collectors import Collector, add_listeners
from zstate.metrics.endpoint import MetricsEndpoint
from zstate.model.robot import RobotModel
from zstate.net.clock_offset import measure_offsets
from zstate.net.session import Session

RATE_HZ = 1000
CACHE_S = 2.0
LOOK_BACK_NS = 1_900_000_000
GIVE_UP_S = 10.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--times", type=int, default=50)
    options = parser.parse_args()
    use_own_rendezvous()
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    publish = ("publish", options.robot, "--source", "sine", "--rate", str(RATE_HZ), "--connect", endpoint)
    with running_command("router", "--listen", endpoint), running_command(*publish):
        time.sleep(CACHE_S)
        with connect(mode="client", endpoints=endpoint) as session:
            for what, unit, values in measure(session, load_model(options.robot), options.times):
                p50, most = np.median(values), max(values)
                print(f"{what:<52} p50 {p50:9.1f} {unit}, at most {most:9.1f} {unit}", flush=True)


def measure(session: Session, model: RobotModel, times: int) -> Iterator[tuple[str, str, list[float]]]:
    """The rows: title, unit, values."""
    robot, tip = model.name, model.links[-1]
    yield (
        "listener opened to an answer 1.9 s back",
        "ms",
        [join_time_s(session, model) * 1e3 for _ in range(times)],
    )
    selector = f"zstate/{robot}/lookup?target={model.root};source={tip}"

    def query() -> object:
        return [reply.ok.payload for reply in session.zenoh.get(selector)]

    yield "lookup by one query", "ms", [elapsed_s(query) * 1e3 for _ in range(times)]
    offsets = [measure_offsets(session, robot)[0] for _ in range(times)]
    yield "error of the clock offset", "us", [abs(one.offset_ns) * 1e-3 for one in offsets]
    yield "reported uncertainty of the clock offset", "us", [one.uncertainty_ns * 1e-3 for one in offsets]
    with (
        TransformListener(session, robot) as listener,
        MetricsEndpoint([Collector(lambda families: add_listeners(families, [listener]))]) as endpoint,
    ):
        spent = [elapsed_s(lambda: urlopen(endpoint.url).read()) for _ in range(times)]
        yield "scrape of a listener's metrics", "ms", [seconds * 1e3 for seconds in spent]


def join_time_s(session: Session, model: RobotModel) -> float:
    """Time [s] from opening a listener until it has the history of ``LOOK_BACK_NS``."""
    began, stamp = time.monotonic(), time.time_ns() - LOOK_BACK_NS
    with TransformListener(session, model.name) as listener:
        listener.buffer.wait(model.root, model.links[-1], timeout_s=10.0)
        while not listener.buffer.can_lookup(model.root, model.links[-1], stamp):
            # The cache holds 0.1 s more; on a busy machine it may have dropped the sample before the request.
            if time.monotonic() - began > GIVE_UP_S:
                raise SystemExit(
                    f"no history from 1.9 s back within {GIVE_UP_S:g} s: the machine is too busy"
                )
            time.sleep(0.0005)
        return time.monotonic() - began


def elapsed_s(action: Callable[[], object]) -> float:
    """Duration of a call [s]."""
    began = time.monotonic()
    action()
    return time.monotonic() - began


if __name__ == "__main__":
    main()
