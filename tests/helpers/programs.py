"""Programs that the commands of a test meet on the network, in the test's own process.

Those of plugins import them when they start: other tests run without their folders.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zstate import Transform, TransformPublisher, connect, load_model
from zstate.clock import SystemClock
from zstate.net.security.credentials import Credentials
from zstate.rate import Rate

if TYPE_CHECKING:
    from zstate.driving import DriverHost


@contextmanager
def router(
    endpoint: str, *, ros2: bool = False, users: Path | None = None, acl: Path | None = None
) -> Iterator[str]:
    """The router of `zstate router` at ``endpoint``, with the same options."""
    from zstate.fleet.acl import read_access_control
    from zstate.fleet.router_config import RouterConfig

    credentials = None if users is None else Credentials(users=users)
    access = {} if acl is None else read_access_control(acl)
    config = RouterConfig((endpoint,), (), credentials, None, access, ros2)
    with connect(mode="router", config=config.settings()):
        yield endpoint


@contextmanager
def driver(robot: str = "rrbot", name: str | None = None, *, ttl_s: float = 10.0) -> Iterator[DriverHost]:
    """The driver of `zstate drive sim`, ready; commands are valid for 10 s, as a busy commander may pause."""
    from zstate.driving import DriverHost, Limits, SimulatedDriver

    model = load_model(robot)
    with (
        connect() as session,
        DriverHost(
            *(session, SimulatedDriver(model), model, name or robot),
            rate_hz=100.0,
            ttl_s=ttl_s,
            limits=Limits.of(model),
        ) as host,
        _in_thread(host.run, host.close),
    ):
        yield host


@contextmanager
def moving_edge(
    robot: str,
    target: str,
    source: str,
    xyz: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    writer: str | None = None,
    rate_hz: float = 50.0,
    wire: str = "native",
) -> Iterator[None]:
    """A pose that is published all the time, as by `zstate transform`."""
    stop = threading.Event()
    with connect() as session, TransformPublisher(session, robot, writer, wire) as publisher:

        def publish() -> None:
            for stamp in Rate(rate_hz, SystemClock(), stop):
                publisher.publish([Transform(target, source, xyz, (0.0, 0.0, 0.0, 1.0), stamp)])

        with _in_thread(publish, stop.set):
            yield


@contextmanager
def scanner(robot: str, frame: str, sensor: str = "scan", wire: str = "native") -> Iterator[None]:
    """The scans of `zstate scan --dummy`: 30 Hz, 1081 rays."""
    from zstate.scans import ScanPublisher
    from zstate.scans import simulated_laser as laser

    class DummyLaser:
        def read(self, stamp: int) -> Any:
            return laser.dummy_scan(stamp, publisher.frame)

    geometry = {
        **{"angle_min": laser.DUMMY_ANGLE_MIN, "angle_increment": laser.DUMMY_ANGLE_INCREMENT},
        **{"range_min": 0.0, "range_max": laser.DUMMY_RANGE_MAX},
    }
    with (
        connect() as session,
        ScanPublisher(session, robot, sensor, wire, frame=frame, program="laser", **geometry) as publisher,
        _in_thread(lambda: publisher.run(DummyLaser()), publisher.close),
    ):
        yield


@contextmanager
def _in_thread(run: Callable[[], object], end: Callable[[], object]) -> Iterator[None]:
    """Runs ``run`` until ``end`` ends it; its exception is raised there."""
    failures: list[BaseException] = []

    def caught() -> None:
        try:
            run()
        except BaseException as failure:
            failures.append(failure)

    thread = threading.Thread(target=caught)
    thread.start()
    try:
        yield
    finally:
        end()
        thread.join()
    if failures:
        raise failures[0]
