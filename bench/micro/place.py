"""Points of a scan placed at their own stamps, compared with ways to do without ``TransformBuffer.place``.

    python -m bench.micro.place

A scan of 100 ms, in float32, while the robot turns at up to 1.5 rad/s. ``rover`` is a base with poses at
100 Hz and a laser on it, ``arm`` a hand behind the seven joints of a panda, also at 100 Hz. The stamps:
``each its own`` ascend; ``by beam`` are those of 1024 columns, repeated for each beam of a spinning lidar;
``shuffled`` are in no order. ``lookup_many`` is a pose for each stamp, applied in numpy. ``two poses`` is the
method of laser_geometry in numpy: the poses of the first and the last point, and lerp and slerp between them.

Figures are medians over rounds of thread CPU time, with the cases interleaved in each round; ratios to place
are medians over the rounds. Errors are the largest distance to one lookup for each of 500 points.

The last lines are of laser_geometry in C++, with the same motion of the rover in a tf2 buffer, if g++ and
Debian's liblaser-geometry-dev are installed. It makes points of ranges as well, so ``zstate`` is
``Scan.points`` and ``place`` there. Both return float32: errors of zstate are those of the format.
"""

from __future__ import annotations

import platform
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import zstate
from bench.micro import laser_geometry
from bench.micro.timing import mean_times_us
from zstate import Transform, TransformBuffer, load_model, scans
from zstate.se3 import ARRAYS, Pose, interpolate, rotate, unstack

FIRST = 1_790_000_000_000_000_000
STEP = 10_000_000
SCAN_NS = 100_000_000
COLUMNS = 1024
ROUNDS = 15
MEASURED = 500

Placed = NDArray[np.float32 | np.float64]


@dataclass(frozen=True)
class Scan:
    """Points of one frame with a stamp each, placed in another frame."""

    buffer: TransformBuffer
    source: str
    target: str
    points: NDArray[np.float32 | np.float64]
    stamps: NDArray[np.int64]

    def place(self) -> Placed:
        """``TransformBuffer.place``."""
        return self.buffer.place(self.points, self.stamps, source=self.source, target=self.target)[0]

    def by_lookup_many(self) -> Placed:
        """A pose for each stamp."""
        poses, _ = self.buffer.lookup_many(self.target, self.source, self.stamps)
        return applied(unstack(poses), self.points)

    def by_two_poses(self) -> Placed:
        """Poses interpolated between those of the first and the last point."""
        ends = np.array([self.stamps.min(), self.stamps.max()])
        first, last = self.buffer.lookup_many(self.target, self.source, ends)[0]
        ratios = (self.stamps - ends[0]) / (ends[1] - ends[0])
        return applied(interpolate(tuple(first), tuple(last), ratios, ARRAYS), self.points)

    def error_m(self, place: Callable[[], Placed]) -> float:
        """The largest distance to the place by a lookup for the point alone, of some points."""
        placed = place()
        chosen = np.linspace(0, len(self.points) - 1, min(MEASURED, len(self.points))).astype(int)
        looked_up = [
            self.buffer.lookup(self.target, self.source, int(self.stamps[n])).apply(self.points[n])
            for n in chosen
        ]
        return float(np.linalg.norm(placed[chosen] - looked_up, axis=1).max())


def applied(pose: Pose, points: NDArray[np.float32 | np.float64]) -> Placed:
    """Points by a pose for each, in numpy."""
    x, y, z = rotate(pose[3:], (points[:, 0], points[:, 1], points[:, 2]))
    return np.stack((pose[0] + x, pose[1] + y, pose[2] + z), axis=1)


MOUNT = Transform.from_rpy("base", "laser", [0.2, 0.0, 0.3], [0.0, 0.0, 0.1])


def drive() -> list[Transform]:
    """The poses of a base that drives and turns for two seconds."""
    poses: list[Transform] = []
    for n in range(200):
        t = n * STEP * 1e-9
        turn = [0.01 * np.sin(3.0 * t), 0.01 * np.cos(3.0 * t), 1.5 * np.sin(t)]
        poses.append(Transform.from_rpy("odom", "base", [0.5 * t, 0.1 * t, 0.0], turn, FIRST + n * STEP))
    return poses


def rover() -> tuple[TransformBuffer, str, str]:
    """That base, with a laser."""
    buffer = TransformBuffer()
    buffer.insert_static(MOUNT)
    for pose in drive():
        buffer.insert(pose)
    return buffer, "laser", "odom"


def arm() -> tuple[TransformBuffer, str, str]:
    """A moving arm for two seconds."""
    model, buffer = load_model("panda"), TransformBuffer()
    track = buffer.add_robot(model)
    phases = np.arange(model.position_count)
    for n in range(200):
        buffer.insert_joints(track, FIRST + n * STEP, np.sin(1.5 * n * STEP * 1e-9 + phases))
    return buffer, "panda_hand", "panda_link0"


def scan_stamps(count: int) -> dict[str, NDArray[np.int64]]:
    """The stamps of ``count`` points by their order."""
    stamps = FIRST + 10**9 + 3 + np.linspace(0, SCAN_NS, count, endpoint=False).astype(np.int64)
    columns = FIRST + 10**9 + 3 + np.linspace(0, SCAN_NS, COLUMNS, endpoint=False).astype(np.int64)
    return {
        "each its own": stamps,
        "by beam": np.resize(columns, count),
        "shuffled": np.random.default_rng(5).permutation(stamps),
    }


def main() -> None:
    """Print the table."""
    print(f"zstate {zstate.__version__} ({zstate.kernel}), Python {platform.python_version()}, ", end="")
    print(f"numpy {np.__version__}, {platform.machine()}; median of {ROUNDS} rounds, us of thread CPU time")
    print(
        f"{'robot':<7}{'points':>8}  {'stamps':<14}{'place':>9}{'lookup_many':>13}{'two poses':>11}", end=""
    )
    print(f"{'ratio':>8}{'ratio':>8}   error [m] of place, of two poses")
    for name, (buffer, source, target) in {"rover": rover(), "arm": arm()}.items():
        for count in (1081, 100_000):
            points = np.random.default_rng(3).uniform(-10.0, 10.0, (count, 3)).astype(np.float32)
            for order, stamps in scan_stamps(count).items():
                if count > COLUMNS * 2 or order != "by beam":
                    print_row(name, order, Scan(buffer, source, target, points, stamps))
    print_laser_geometry()


def print_row(name: str, order: str, scan: Scan) -> None:
    """Measure and print one line."""
    cases = {"place": scan.place, "many": scan.by_lookup_many, "two": scan.by_two_poses}
    times = mean_times_us(cases, ROUNDS, 1 + 2000 // len(scan.points))
    place, many, two = (times[case] for case in cases)
    print(
        f"{name:<7}{len(scan.points):>8}  {order:<14}{np.median(place):>9.0f}{np.median(many):>13.0f}", end=""
    )
    print(f"{np.median(two):>11.0f}{np.median(many / place):>7.1f}x{np.median(two / place):>7.1f}x", end="")
    exact = Scan(scan.buffer, scan.source, scan.target, scan.points.astype(np.float64), scan.stamps)
    print(f"   {exact.error_m(exact.place):.1e}, {exact.error_m(exact.by_two_poses):.1e}", flush=True)


def print_laser_geometry() -> None:
    """The lines of laser_geometry, or why they are missing."""
    version = laser_geometry.version()
    if version is None:
        print(f"laser_geometry: skipped; it needs g++ and Debian's {laser_geometry.PACKAGE}")
        return
    print(f"{'laser_geometry ' + version:<29}{'zstate':>9}{'laser_geometry':>16}{'ratio':>9}", end="")
    print("   error [m] of zstate, of laser_geometry")
    with tempfile.TemporaryDirectory() as folder:
        functions = laser_geometry.compile_library(Path(folder))
        for count in (1081, 100_000):
            with closing(laser_geometry.Projector(functions)) as projector:
                print_projection(count, projector)


def print_projection(count: int, projector: laser_geometry.Projector) -> None:
    """Measure and print one line of a scan of ``count`` rays, placed by laser_geometry too."""
    buffer, source, target = rover()
    projector.insert(MOUNT, is_static=True)
    for pose in drive():
        projector.insert(pose)
    ranges = np.random.default_rng(3).uniform(0.5, 9.5, count).astype(np.float32)
    begin, ray_ns = FIRST + 10**9 + 3, SCAN_NS // count
    sweep = scans.Scan(begin, -np.pi, 2.0 * np.pi / count, ray_ns, ranges, 0.0, 100.0, source)
    projector.set_scan(source, begin, ray_ns * (count - 1) * 1e-9, ranges)
    cases = {
        "zstate": lambda: buffer.place(sweep.points(), sweep.stamps(), source=source, target=target)[0],
        "theirs": lambda: projector.place(target),
    }
    times = mean_times_us(cases, ROUNDS, 1 + 2000 // count)
    exact = Scan(buffer, source, target, sweep.points(), sweep.stamps())
    errors = exact.error_m(cases["zstate"]), exact.error_m(lambda: projector.points(count))
    ours, theirs = times["zstate"], times["theirs"]
    print(
        f"{'rover':<7}{count:>8}  {'each its own':<12}{np.median(ours):>9.0f}{np.median(theirs):>16.0f}",
        end="",
    )
    print(f"{np.median(theirs / ours):>8.1f}x   {errors[0]:.1e}, {errors[1]:.1e}", flush=True)


if __name__ == "__main__":
    main()
