"""What is asked over the network: history on join, one lookup, the time of another clock, metrics.

    python -m bench.micro.questions [--robot panda] [--times 50]

A publisher process at 1 kHz and a router process; this process is a client of the router. Measured in turn:
from the opening of a listener to an answer 1.9 s in the past; one query on ``zstate/<robot>/lookup``; how
far the measured offset of the publisher's clock is from the truth, which is 0 since it is the same clock,
beside the uncertainty that is told; one scrape of the metrics of a listener.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from urllib.request import urlopen

import numpy as np

from bench.micro.others import free_port, meet_nobody_else, running
from zstate import TransformListener, connect, load_model
from zstate.metrics.collectors import ListenerMetrics
from zstate.metrics.endpoint import MetricsEndpoint
from zstate.model.robot import RobotModel
from zstate.net.clock_offset import measure_offsets
from zstate.net.session import Session

RATE_HZ = 1000
REMEMBERED_S = 2.0
BACK_NS = 1_900_000_000


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--times", type=int, default=50)
    options = parser.parse_args()
    meet_nobody_else()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    publish = ("publish", options.robot, "--source", "sine", "--rate", str(RATE_HZ), "--connect", endpoint)
    with running("router", "--listen", endpoint), running(*publish):
        time.sleep(REMEMBERED_S)
        with connect(mode="client", endpoints=endpoint) as session:
            for what, unit, values in measured(session, load_model(options.robot), options.times):
                p50, most = np.median(values), max(values)
                print(f"{what:<52} p50 {p50:9.1f} {unit}, at most {most:9.1f} {unit}", flush=True)


def measured(session: Session, model: RobotModel, times: int) -> Iterator[tuple[str, str, list[float]]]:
    """The rows: what, its unit, the values."""
    robot, tip = model.name, model.links[-1]
    yield (
        "listener opened to an answer 1.9 s back",
        "ms",
        [joining_s(session, model) * 1e3 for _ in range(times)],
    )
    question = f"zstate/{robot}/lookup?target={model.root};source={tip}"

    def ask() -> object:
        return [reply.ok.payload for reply in session.zenoh.get(question)]

    yield "lookup by one query", "ms", [spent_s(ask) * 1e3 for _ in range(times)]
    offsets = [measure_offsets(session, robot)[0] for _ in range(times)]
    yield "clock offset, of which the truth is 0", "us", [abs(one.offset_ns) * 1e-3 for one in offsets]
    yield "the uncertainty told with it", "us", [one.uncertainty_ns * 1e-3 for one in offsets]
    with (
        TransformListener(session, robot) as listener,
        MetricsEndpoint([ListenerMetrics(lambda: [listener])]) as endpoint,
    ):
        spent = [spent_s(lambda: urlopen(endpoint.url).read()) for _ in range(times)]
        yield "scrape of a listener's metrics", "ms", [seconds * 1e3 for seconds in spent]


def joining_s(session: Session, model: RobotModel) -> float:
    """How long a new listener takes to know what was said before it came."""
    began, stamp = time.monotonic(), time.time_ns() - BACK_NS
    with TransformListener(session, model.name) as listener:
        listener.buffer.wait(model.root, model.links[-1], timeout_s=10.0)
        while not listener.buffer.can_lookup(model.root, model.links[-1], stamp):
            time.sleep(0.0005)
        return time.monotonic() - began


def spent_s(action: Callable[[], object]) -> float:
    """How long it takes."""
    began = time.monotonic()
    action()
    return time.monotonic() - began


if __name__ == "__main__":
    main()
