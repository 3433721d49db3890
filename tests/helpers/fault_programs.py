"""The processes of the fault suite: each runs one role and replies to queries on its standard input.

A query is a line of JSON, ``[name, *arguments]``; so is the reply.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from helpers.fault_queries import MAX_AGE_S, ArmMotion, JointsMotion, OdometryMotion, ReaderQueries

from zstate import (
    SineSource,
    StatePublisher,
    StaticPublisher,
    TransformListener,
    ZStateError,
    connect,
    load_model,
)
from zstate.clock import SystemClock
from zstate.fleet.acl import AclRoles, access_control
from zstate.fleet.router_config import RouterConfig
from zstate.ingest.base import StreamIngest
from zstate.net import streams
from zstate.net.security.credentials import Credentials
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.recording.recorder import Recorder
from zstate.sources.joint_source import JointReading
from zstate.transform import Transform

CLONE_NEWNET = 0x40000000
REACH = 2.0
"""Of rrbot, at most [m]."""

Session = dict[str, Any]
Answer = Callable[..., Any]


def main() -> None:
    role, options = sys.argv[1], json.loads(sys.argv[2])
    namespace = options.pop("namespace", None)
    if namespace:
        enter_namespace(namespace)
    roles: dict[str, Answer] = {
        "publisher": publisher,
        "odometry": odometry,
        "driver": driver,
        "claimant": claimant,
        "reader": reader,
        "recorder": recorder,
        "router": router,
    }
    roles[role](**options)


def enter_namespace(namespace: str) -> None:
    """Enters the namespace before any thread exists: a network namespace is a property of each thread."""
    libc = ctypes.CDLL(None, use_errno=True)
    with Path(f"/run/netns/{namespace}").open() as file:
        if libc.setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")


def _serve_queries(**answers: Answer) -> None:
    print("ready", flush=True)
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        print(json.dumps({"census": resource_counts, **answers}[name](*arguments)), flush=True)


def resource_counts() -> dict[str, int]:
    """Counts that must not grow. Threads include those of Zenoh."""
    status = Path("/proc/self/status").read_text()
    resident = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return {
        "threads": len(list(Path("/proc/self/task").iterdir())),
        "fds": len(list(Path("/proc/self/fd").iterdir())),
        "rss_kb": int(resident.split()[1]),
    }


class ShiftedClock(SystemClock):
    """The system clock with an error of ``shift_ns``."""

    shift_ns = 0

    def now(self) -> int:
        return super().now() + self.shift_ns

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        return super().wait_until(stamp - self.shift_ns, stop)


def join(session: Session) -> Any:
    """Connects with the options of ``session``; "certificates" is a folder and a name in it."""
    options = session.copy()
    certificates = options.pop("certificates", None)
    credentials = Credentials.from_folder(*certificates) if certificates else None
    return connect(credentials=credentials, **options)


class PausableSource:
    """A source that keeps its last stamp, and returns nothing after ``pause``. ``read`` is of the source."""

    def __init__(self, read: Callable[[int], Any], *, paused: bool = False) -> None:
        self._read = read
        self._last = 0
        self._paused = paused

    def read(self, stamp: int) -> Any:
        if self._paused:
            return None
        self._last = stamp
        return self._read(stamp)

    def pause(self) -> int:
        self._paused = True
        return self._last

    def resume(self) -> None:
        self._paused = False


def publisher(
    robot: str, session: Session, rate_hz: float = 100.0, mark: float = 0.0, takeover: bool = False
) -> None:
    """Publishes a moving robot and one extra static edge, whose length is the mark."""
    model, clock = load_model("rrbot"), ShiftedClock()
    source = PausableSource(SineSource(model).read)

    def shift(shift_ns: int) -> int:
        clock.shift_ns = shift_ns
        return clock.now()

    def leave() -> float:
        began = time.monotonic()
        opened.close()
        return time.monotonic() - began

    with (
        join(session) as opened,
        StatePublisher(opened, model, robot, clock=clock, takeover=takeover) as writing,
        StaticPublisher(opened, robot, f"mark.{os.getpid()}", takeover=takeover) as statics,
    ):

        def put_mark(value: float) -> None:
            statics.set(Transform.from_rpy("world", "mark", (value, 0.0, 0.0), (0.0, 0.0, 0.0)))

        def routers() -> list[str]:
            return [str(zid) for zid in opened.zenoh.info.routers_zid()]

        put_mark(mark)
        running = threading.Thread(target=writing.run, args=(source, rate_hz), daemon=True)
        running.start()
        _serve_queries(mark=put_mark, shift=shift, pause=source.pause, routers=routers, leave=leave)


def odometry(
    robot: str,
    session: Session,
    writer: str | None = None,
    rate_hz: float = 100.0,
    lane: int = 0,
    *,
    paused: bool = False,
) -> None:
    """Publishes ``OdometryMotion`` until an error ends it; if ``paused``, from the query "resume" on."""
    motion, clock, errors = OdometryMotion(lane), ShiftedClock(), list[str]()
    source = PausableSource(lambda stamp: [motion.pose(stamp)], paused=paused)

    def shift(shift_ns: int) -> int:
        clock.shift_ns = shift_ns
        return clock.now()

    def run() -> None:
        try:
            writing.run(source, rate_hz)
        except ZStateError as error:
            errors.append(f"{type(error).__name__}: {error}")

    with (
        join(session) as opened,
        TransformPublisher(opened, robot, writer, clock=clock, cache_s=60.0) as writing,
    ):
        threading.Thread(target=run, daemon=True).start()
        _serve_queries(
            sent=lambda: writing.stats.sent,
            errors=lambda: errors,
            shift=shift,
            pause=source.pause,
            resume=source.resume,
        )


def driver(
    robot: str, session: Session, joint: str, writer: str | None = None, rate_hz: float = 100.0
) -> None:
    """Publishes one joint of ``JointsMotion``."""
    model, motion = load_model("rrbot"), JointsMotion()
    column = model.joint_names.index(joint)
    source = PausableSource(lambda stamp: JointReading(np.array([motion.positions(stamp)[column]])))
    with (
        join(session) as opened,
        PartialStatePublisher(opened, model, [joint], robot, writer=writer, cache_s=60.0) as writing,
    ):
        threading.Thread(target=writing.run, args=(source, rate_hz), daemon=True).start()
        _serve_queries(sent=lambda: writing.stats.sent, pause=source.pause)


def claimant(robot: str, session: Session, joint: str) -> None:
    """Claims a joint at the time [ns] of the query "claim", until the query "release"."""
    model, claims = load_model("rrbot"), list[PartialStatePublisher]()

    def claim(at: int) -> str:
        """The error, or an empty string."""
        while time.time_ns() < at:
            pass
        try:
            claims.append(PartialStatePublisher(opened, model, [joint], robot))
            claims[-1].publish([0.0])
        except ZStateError as error:
            return f"{type(error).__name__}: {error}"
        return ""

    def release() -> None:
        while claims:
            claims.pop().close()

    with join(session) as opened:
        _serve_queries(claim=claim, release=release)


def recorder(session: Session, path: str) -> None:
    with join(session) as opened, Recorder(opened, path, ["r1"]) as recording:

        def ended() -> str | None:
            return f"{type(recording.failure).__name__}: {recording.failure}" if recording.wait(0.0) else None

        _serve_queries(ended=ended, written=lambda: sum(recording.stats.messages.values()))


def router(
    listen: str,
    connect_to: list[str] | None = None,
    certificates: tuple[str, str] | None = None,
    roles: dict[str, list[str]] | None = None,
) -> None:
    """A router; with ``roles`` it has access control, the arguments of ``AclRoles``."""
    if roles is None:
        opening = connect(mode="router", listen=listen, endpoints=connect_to or ())
    else:
        assert certificates is not None
        access = access_control(AclRoles(**{role: tuple(names) for role, names in roles.items()}))
        credentials = Credentials.from_folder(*certificates)
        opening = connect(RouterConfig((listen,), credentials=credentials, access_control=access).settings())
    with opening as opened:
        _serve_queries(zid=lambda: opened.zid)


def reader(session: Session, robot: str = "*", follow: str = "joint_states", busy_ms: float = 0.0) -> None:
    """Listens to robots; with ``busy_ms`` each sample blocks the process for that long, and few samples wait.

    Replies to the queries of ``ReaderQueries`` about the arm, as ``odometry NAME`` about the odometry, and as
    ``joints NAME``, ``shoulder NAME`` and ``elbow NAME`` about ``JointsMotion``, all of it and of one joint.
    """
    # Merged readings are of one instant, some of their positions up to the age limit older.
    if busy_ms:
        streams.CAPACITY = 64
        _slow_down_live_samples(busy_ms)
    tolerance = 1e-9 if follow == "joint_states" else sum(map(abs, JointsMotion.RATES)) * MAX_AGE_S * REACH
    with (
        join(session) as opened,
        TransformListener(opened, robot, follow=follow, history_s=60.0, on_event=lambda _: None) as listener,
    ):
        answers = {
            "": ReaderQueries(listener, ArmMotion()),
            "odometry ": ReaderQueries(listener, OdometryMotion()),
            "joints ": ReaderQueries(listener, JointsMotion(tolerance=tolerance)),
            "shoulder ": ReaderQueries(listener, JointsMotion("world", "upper")),
            "elbow ": ReaderQueries(listener, JointsMotion("upper", "lower")),
        }
        names = (
            "after",
            "newest",
            "near",
            "mark",
            "stats",
            "watch",
            "watched",
            "latencies",
            "count",
            "wrong",
            "problem",
            "lane",
            "events",
        )
        _serve_queries(
            **{f"{motion}{name}": getattr(one, name) for motion, one in answers.items() for name in names}
        )


def _slow_down_live_samples(busy_ms: float) -> None:
    insert = StreamIngest.insert_sample

    def slowly(*arguments: Any, **options: Any) -> None:
        until = time.perf_counter() + busy_ms * 1e-3
        while time.perf_counter() < until:
            pass
        insert(*arguments, **options)

    StreamIngest.insert_sample = slowly  # type: ignore[method-assign]
    StreamIngest.insert_next = lambda *_: False  # type: ignore[method-assign]  # its inserts are not slow
