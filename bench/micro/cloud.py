"""Clouds of a lidar of 128 x 1016 points: placed each at its own instant, and compressed.

The lidar turns once in 0.1 s in a room of flat walls, with noise of 1 cm, on a base that turns at 2 rad/s
with poses at 100 Hz. Placing includes the view of the message and the instants of the points, whose order is
that of the measurement (a column of all lasers after the other), by laser, or none. Compression is of the
message with intensity, ring and time (22 bytes a point); errors are of x, y and z.

``--points`` is a file of numpy with the points of a real sweep, a structured array as for ``CloudPublisher``;
they are placed in their order only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bench.micro.form import Call, Row, call_times_us, compared
from zstate import Transform, TransformBuffer
from zstate.clouds import Cloud, SimulatedLidar
from zstate.clouds.cloud import cloud_from_message, cloud_to_message, message_points
from zstate.clouds.messages import PointCloud

TURNING = 2.0
MS = 10**6
START = 300 * MS
CALLS = 3


def measure(rounds: int = 15, points: str = "") -> Iterator[Row]:
    """Rows of placing, then of each compression."""
    cloud = Cloud(START, "lidar", np.load(points)) if points else simulated()
    buffer = TransformBuffer()
    for stamp in range(0, 600 * MS, 10 * MS):
        buffer.insert(pose_at(stamp))
    cases = {"in their order": np.arange(len(cloud))} if points else orders(len(cloud))
    if not cloud.is_rigid:
        yield from compared("placed", "us", call_times_us(place_cases(cloud, cases, buffer), rounds, CALLS))
    messages = compressed(cloud)
    yield from compared("to a message", "us", call_times_us(encode_cases(cloud), rounds, CALLS))
    reading = {name: lambda one=one: message_points(one) for name, one in messages.items()}
    yield from compared("from a message", "us", call_times_us(reading, rounds, CALLS))
    yield from compared("size", "kB", {name: [len(one.data) / 1e3] for name, one in messages.items()})
    for name, one in messages.items():
        error = np.nanmax(abs(cloud_from_message(one, "r1").xyz.astype(float) - cloud.xyz))
        yield Row(f"largest error: {name}", "mm", [1e3 * float(error)])


def simulated() -> Cloud:
    """A sweep of a lidar that turns with its base."""
    lidar = SimulatedLidar(noise_m=0.01, seed=1)
    return lidar.cloud(START, [pose_at(int(stamp)).pose7 for stamp in lidar.stamps(START)])


def pose_at(stamp: int) -> Transform:
    """The lidar on its base, half a metre from the axis."""
    angle = TURNING * stamp * 1e-9
    rotation = (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))
    return Transform(
        "r1/map", "r1/lidar", (0.5 * math.cos(angle), 0.5 * math.sin(angle), 1.2), rotation, stamp
    )


def orders(count: int) -> dict[str, NDArray[np.intp]]:
    """Orders of the points of a simulated sweep."""
    return {
        "in the order of measurement": np.arange(count),
        "laser by laser": np.arange(count).reshape(-1, 128).T.ravel(),
        "in no order": np.random.default_rng(1).permutation(count),
    }


def place_cases(cloud: Cloud, cases: dict[str, NDArray[np.intp]], buffer: TransformBuffer) -> dict[str, Call]:
    """Clouds of the same points in another order."""
    messages = {
        name: cloud_to_message(Cloud(cloud.stamp, cloud.frame, cloud.points.ravel()[order]), is_dense=True)
        for name, order in cases.items()
    }

    def place(message: PointCloud) -> None:
        one = cloud_from_message(message, "r1")
        assert one.stamps is not None
        buffer.place(one.xyz, one.stamps, one.frame, "r1/map")

    return {name: lambda message=message: place(message) for name, message in messages.items()}


def compressed(cloud: Cloud) -> dict[str, PointCloud]:
    """The messages of ``cloud``, by the compression and the resolution."""
    return {
        "none": cloud_to_message(cloud, True),
        **{
            f"{compression}, {resolution * 1000:g} mm"
            if resolution
            else f"{compression}, exact": cloud_to_message(cloud, True, compression, resolution)
            for compression, resolution in product(("lz4", "zstd"), (0.0, 0.001, 0.01))
        },
    }


def encode_cases(cloud: Cloud) -> dict[str, Call]:
    """What makes these messages."""
    return {
        name: lambda one=one: cloud_to_message(cloud, True, one.compression, one.resolution)
        for name, one in compressed(cloud).items()
    }
