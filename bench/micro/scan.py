"""Scans of a moving robot, placed in another process: how long after the pose that they need, and how many.

    python -m bench.micro.scan [SECONDS]

One process publishes a robot that drives and turns, at 100 Hz, and its laser: 1081 rays, 30 scans a second,
each ray with its own stamp. A scan is published at the instant of its last ray, so that its reader needs the
next sample of the transforms. This process iterates over a ScanListener.

A latency is from the stamp of that sample, which is the time immediately before it is published, to the
moment at which the placed scan is returned: sample, waiting thread, 1081 points, reading thread. The first
line counts from the insertion of the sample into the reader's buffer. ``lost`` scans are gaps in the stamps,
ticks that a busy writer skips included; ``dropped`` ones are those of ``ScanListener.dropped``.
"""

from __future__ import annotations

import math
import platform
import sys
import threading
import time
from bisect import bisect_left

import numpy as np

import zstate
from bench.micro.processes import running_process, use_own_rendezvous
from zstate import Transform, TransformListener, TransformPublisher, connect
from zstate.scans import ScanListener, ScanPublisher

ROBOT = "rover"
RAYS = 1081
SCAN_HZ, POSE_HZ = 30.0, 100.0
POSE_NS = round(1e9 / POSE_HZ)
RAY_NS = round(1e9 / SCAN_HZ / 1440)
SECONDS = 10.0
WARM_UP_S = 1.0


class Drive:
    """A source of the poses of a laser that drives and turns."""

    def read(self, stamp: int) -> list[Transform]:
        """The pose at ``stamp``, 1.5 rad/s at most."""
        t = (stamp % 10**12) * 1e-9
        xyz = [math.sin(t), math.cos(0.7 * t), 0.0]
        return [Transform.from_rpy("odom", "laser", xyz, [0.0, 0.0, 1.5 * math.sin(t)], stamp)]


class Room:
    """A source of ranges without a sensor."""

    ranges = np.random.default_rng(1).uniform(0.5, 9.5, RAYS).astype(np.float32)

    def read(self, _: int) -> np.ndarray:
        """The same ranges at every stamp."""
        return self.ranges


def write() -> None:
    """Publish both until the process is ended."""
    geometry = {
        "angle_min": -2.356,
        "angle_increment": 4.712 / (RAYS - 1),
        "range_min": 0.1,
        "range_max": 10.0,
    }
    with (
        connect() as session,
        TransformPublisher(session, ROBOT, "odometry") as poses,
        ScanPublisher(session, ROBOT, "laser", ray_ns=RAY_NS, **geometry) as scans,
    ):
        threading.Thread(target=lambda: poses.run(Drive(), POSE_HZ), daemon=True).start()
        print("publishing", flush=True)
        scans.run(Room(), SCAN_HZ)


def read(seconds: float) -> None:
    """Receive for ``seconds`` and print the figures."""
    placed: list[tuple[int, int, int, int]] = []
    """Stamps of the first ray, the last ray and the sample; the time when the scan was returned."""
    inserted: list[int] = []
    with (
        connect() as session,
        TransformListener(session, ROBOT) as listener,
        ScanListener(session, ROBOT, "odom", buffer=listener.buffer) as scans,
    ):
        listener.add_observer(lambda: inserted.append(time.time_ns()))
        start = time.time_ns() + round(WARM_UP_S * 1e9)
        for one in scans:
            now = time.time_ns()
            if one.stamp < start:
                scans.dropped.clear()  # while the listener had no transforms yet
                continue
            end, newest = one.scan.end_stamp, scans.buffer.latest("odom", "laser")
            # Of several samples since the last ray, the scan needs the first.
            needed = newest - (newest - end) // POSE_NS * POSE_NS
            placed.append((one.stamp, end, needed, now))
            if now > start + seconds * 1e9:
                break
        dropped = dict(scans.dropped)
    latencies = np.array([now - needed for *_, needed, now in placed]) * 1e-6
    arrivals = [inserted[bisect_left(inserted, needed)] for *_, needed, _ in placed]
    handled = np.array([now - at for (*_, now), at in zip(placed, arrivals, strict=True)]) * 1e-6
    waits = np.array([now - end for _, end, _, now in placed]) * 1e-6
    gaps = np.diff([first for first, *_ in placed]) * 1e-9 * SCAN_HZ
    lost = int(np.maximum(np.round(gaps) - 1, 0).sum())
    print(f"zstate {zstate.__version__} ({zstate.kernel}), Python {platform.python_version()}, ", end="")
    print(f"{platform.machine()}; {len(placed)} scans of {RAYS} rays in {seconds:g} s")
    for what, values in (
        ("after the sample is inserted", handled),
        ("after the sample's stamp", latencies),
        ("after the last ray", waits),
    ):
        p50, p90, p99 = np.percentile(values, (50, 90, 99))
        print(f"placed {what:<30} p50 {p50:6.3f} ms  p90 {p90:6.3f} ms  p99 {p99:6.3f} ms")
    print(f"lost {lost}, dropped {dropped or 0}")


def main() -> None:
    """Print the figures."""
    if sys.argv[1:] == ["--write"]:
        write()
        return
    use_own_rendezvous()
    with running_process(sys.executable, "-m", "bench.micro.scan", "--write"):
        read(float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS)


if __name__ == "__main__":
    main()
