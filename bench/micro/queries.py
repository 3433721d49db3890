"""Network queries: history on join, one lookup, clock offset, metrics.

A publisher process at 1 kHz and a router process; this process is a client of the router. The true offset of
the clocks is 0, since they are the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from urllib.request import urlopen

from bench.micro.form import Row, use_own_rendezvous
from bench.process import free_ports, running_command
from zstate import TransformListener, connect, load_model
from zstate.metrics.collectors import Collector, add_listeners
from zstate.metrics.endpoint import MetricsEndpoint
from zstate.net.clock_offset import measure_offsets
from zstate.net.session import Session

CACHE_S = 2.0
LOOK_BACK_NS = 1_000_000_000
GIVE_UP_S = 10.0


def measure(robot: str = "panda", times: int = 50) -> Iterator[Row]:
    """Rows of each query."""
    use_own_rendezvous()
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    publish = ("publish", robot, "--source", "sine", "--rate", "1000", "--connect", endpoint)
    with running_command("router", "--listen", endpoint), running_command(*publish):
        time.sleep(CACHE_S)
        with connect(mode="client", endpoints=endpoint) as session:
            yield from rows(session, robot, times)


def rows(session: Session, robot: str, times: int) -> Iterator[Row]:
    """Measures through ``session``."""
    model = load_model(robot)
    ends = model.root, model.links[-1]
    selector = f"zstate/{robot}/lookup?target={ends[0]};source={ends[1]}"

    def join() -> None:
        """Open a listener until it has history; the cache holds 1 s more than is looked up."""
        begin, stamp = time.monotonic(), time.time_ns() - LOOK_BACK_NS
        with TransformListener(session, robot) as listener:
            listener.buffer.wait(*ends, timeout_s=10.0)
            while not listener.buffer.can_lookup(*ends, stamp):
                if time.monotonic() > begin + GIVE_UP_S:
                    raise SystemExit(
                        f"no history from 1 s back within {GIVE_UP_S:g} s: the machine is too busy"
                    )
                time.sleep(0.0005)

    def query() -> None:
        assert [reply.ok.payload for reply in session.zenoh.get(selector)]

    yield Row("listener opened to an answer 1 s back", "ms", [elapsed_ms(join) for _ in range(times)])
    yield Row("lookup by one query", "ms", [elapsed_ms(query) for _ in range(times)])
    offsets = [measure_offsets(session, robot)[0] for _ in range(times)]
    yield Row("error of the clock offset", "us", [abs(one.offset_ns) * 1e-3 for one in offsets])
    yield Row("its reported uncertainty", "us", [one.uncertainty_ns * 1e-3 for one in offsets])
    with (
        TransformListener(session, robot) as listener,
        MetricsEndpoint([Collector(lambda families: add_listeners(families, [listener]))]) as endpoint,
    ):
        scrape = [elapsed_ms(lambda: urlopen(endpoint.url).read()) for _ in range(times)]
        yield Row("scrape of a listener's metrics", "ms", scrape)


def elapsed_ms(action: Callable[[], object]) -> float:
    """Duration of a call [ms]."""
    begin = time.monotonic()
    action()
    return (time.monotonic() - begin) * 1e3
