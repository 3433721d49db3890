"""Programs that the commands of a test meet on the network, in the test's own process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from zstate import Transform, TransformPublisher, connect, load_model
from zstate.clock import SystemClock
from zstate.driving import DriverHost, Limits, SimulatedDriver
from zstate.fleet.acl import read_access_control
from zstate.fleet.router_config import RouterConfig
from zstate.net.security.credentials import Credentials
from zstate.rate import Rate
from zstate.scans import ScanPublisher
from zstate.scans.simulated_laser import (
    DUMMY_ANGLE_INCREMENT,
    DUMMY_ANGLE_MIN,
    DUMMY_RANGE_MAX,
    dummy_scan,
)


@contextmanager
def router(
    endpoint: str, *, ros2: bool = False, users: Path | None = None, acl: Path | None = None
) -> Iterator[str]:
    """The router of `zstate router` at ``endpoint``, with the same options."""
    credentials = None if users is None else Credentials(users=users)
    access = {} if acl is None else read_access_control(acl)
    config = RouterConfig((endpoint,), (), credentials, None, access, ros2)
    with connect(mode="router", config=config.settings()):
        yield endpoint


@contextmanager
def driver(robot: str = "rrbot", name: str | None = None, *, ttl_s: float = 10.0) -> Iterator[DriverHost]:
    """The driver of `zstate drive sim`, ready; commands are valid for 10 s, as a busy commander may pause."""
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


class _DummyLaser:
    def __init__(self, frame: str) -> None:
        self._frame = frame

    def read(self, stamp: int) -> Any:
        return dummy_scan(stamp, self._frame)


@contextmanager
def scanner(robot: str, frame: str, sensor: str = "scan", wire: str = "native") -> Iterator[None]:
    """The scans of `zstate scan --dummy`: 30 Hz, 1081 rays."""
    geometry = {
        **{"angle_min": DUMMY_ANGLE_MIN, "angle_increment": DUMMY_ANGLE_INCREMENT},
        **{"range_min": 0.0, "range_max": DUMMY_RANGE_MAX},
    }
    with (
        connect() as session,
        ScanPublisher(session, robot, sensor, wire, frame=frame, program="laser", **geometry) as publisher,
        _in_thread(lambda: publisher.run(_DummyLaser(publisher.frame)), publisher.close),
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
