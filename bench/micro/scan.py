"""Scans of a moving robot, placed in another process: how long after the pose that they need, and how many.

One process publishes a robot that drives and turns, at 100 Hz, and its laser: 1081 rays, 30 scans a second,
each ray with its own stamp. A scan is published at the instant of its last ray, so that its reader needs
the next sample of the transforms. This process iterates over a ScanListener. A latency is from the stamp of
that sample, which is the time immediately before it is published, to the moment at which the placed scan is
returned. ``lost`` scans are gaps in the stamps, ticks that a busy writer skips included.
"""

from __future__ import annotations

import math
import threading
import time
from bisect import bisect_left
from collections.abc import Iterator

import numpy as np

from bench.micro.form import Row, end_of_input, running_role, send_event, use_own_rendezvous
from zstate import Transform, TransformListener, TransformPublisher, connect
from zstate.scans import ScanListener, ScanPublisher

ROBOT = "rover"
RAYS = 1081
SCAN_HZ, POSE_HZ = 30.0, 100.0
POSE_NS = round(1e9 / POSE_HZ)
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
    """Publishes both."""
    turn = {"angle_min": -2.356, "angle_increment": 4.712 / (RAYS - 1), "range_min": 0.1, "range_max": 10.0}
    ended = end_of_input()
    with (
        connect() as session,
        TransformPublisher(session, ROBOT, "odometry") as poses,
        ScanPublisher(session, ROBOT, "laser", ray_ns=round(1e9 / SCAN_HZ / 1440), **turn) as scans,
    ):
        threading.Thread(target=lambda: poses.run(Drive(), POSE_HZ), daemon=True).start()
        threading.Thread(target=lambda: scans.run(Room(), SCAN_HZ), daemon=True).start()
        send_event("ready")
        ended.wait()


def measure(seconds: float = 10.0) -> Iterator[Row]:
    """Rows of the latencies and of what is lost."""
    use_own_rendezvous()
    placed: list[tuple[int, int, int, int]] = []
    """Stamps of the first ray, the last ray and the sample; the time when the scan was returned."""
    inserted: list[int] = []
    with (
        running_role(write),
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
            # The scan needs the first of several samples since the last ray.
            placed.append((one.stamp, end, newest - (newest - end) // POSE_NS * POSE_NS, now))
            if now > start + seconds * 1e9:
                break
        dropped = sum(scans.dropped.values())
    first, last, needed, returned = np.array(placed).T
    at = np.array([inserted[bisect_left(inserted, stamp)] for stamp in needed.tolist()])
    yield Row("placed after the sample is inserted", "ms", (returned - at) * 1e-6)
    yield Row("placed after the sample's stamp", "ms", (returned - needed) * 1e-6)
    yield Row("placed after the last ray", "ms", (returned - last) * 1e-6)
    gaps = np.round(np.diff(first) * 1e-9 * SCAN_HZ) - 1
    yield Row(f"lost of {len(placed)} scans", "", [float(np.maximum(gaps, 0).sum())])
    yield Row("dropped", "", [dropped])
