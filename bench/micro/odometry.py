"""BaseEstimator: consistency in simulated runs, cost, and the time to rewind.

    python -m bench.micro.odometry [RUNS [SECONDS]]

A body moves in 3D with an IMU at 200 Hz on a turned mount, and a velocity of three axes at 50 Hz, from rest.
The mean NEES of position, attitude and velocity at the end stands with the band that has 95 % of such means
if errors are as large as their covariances; then once more with the velocities up to 0.3 s late and out of
order. The cost is CPU seconds of this process per simulated second. A rewind is
a velocity that is 100 samples of the IMU late. The recordings of a mower in the gtsam wheel, Plaza1 and
Plaza2, and of a Husky in tests/odometry/data have their error beside that of dead reckoning, and their mean
NEES of x and y, expected 2.
"""

from __future__ import annotations

import platform
import sys
import time
from itertools import product
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from helpers import plaza, recordings
from helpers.base_motion import IMU_HZ, stamp_at, tilted_mount
from odometry.test_estimator import SIGMA, calls_of, estimator, feed, late, squared_errors
from odometry.test_plaza import dead_reckoned, estimated, mean_nees

import zstate
from zstate.odometry.health import nis_band

RUNS, SECONDS = 100, 12.0


def consistency(runs: int, seconds: float) -> None:
    """Print the mean NEES of ``runs``, in order and with late velocities, and the error of position."""
    for name, is_late in (("in order", False), ("late and shuffled", True)):
        squares: list[tuple[float, float, float]] = []
        distances: list[float] = []
        for seed in range(runs):
            motion, calls = calls_of(seed, seconds)
            base = estimator(tilted_mount())
            feed(base, late(calls, "velocity", seed) if is_late else calls)
            state = base.state()
            squares.append(squared_errors(motion, state))
            truth = motion.coordinates(np.array([1e-9 * (state.stamp - stamp_at(0.0))]))[0, :3]
            distances.append(float(np.linalg.norm(state.odom_from_base.translation - truth)))
        means = ", ".join(f"{mean:.2f}" for mean in np.mean(squares, axis=0).tolist())
        low, high = nis_band(3, runs)
        rms = float(np.sqrt(np.mean(np.square(distances))))
        print(
            f"{name:<18} NEES of position, attitude, velocity {means} (band {low:.2f} to {high:.2f}), ",
            end="",
        )
        print(f"position {rms:.3f} m rms after {seconds:g} s, {runs} runs")


def cost(seconds: float) -> None:
    """Print the CPU time of runs in which a state is read with each velocity or sample, and that of a rewind.

    With a velocity, which is newer than the last sample of the IMU, its estimate is computed once more when
    the next sample arrives. OdometryNode reads the state at the stamps of samples.
    """
    _, calls = calls_of(0, seconds)
    for read_at, every in (("velocity", 1), ("imu", round(IMU_HZ / 50))):
        base = estimator(tilted_mount())
        count = 0
        start = time.process_time()
        for call in calls:
            feed(base, [call])
            if call[1] == read_at and call[0] > 1.0:
                count += 1
                if count % every == 0:
                    base.state()
        used = time.process_time() - start
        print(f"cost {100.0 * used / seconds:.2f} % of a core, with 50 states a second read with {read_at}")
    times: list[float] = []
    newest = calls[-1][0]
    for number in range(50):
        base.velocity(stamp_at(newest - 100 / IMU_HZ) + number, [0.0] * 3, sigma=[SIGMA * 100] * 3)
        start = time.process_time()
        base.state()
        times.append(1e3 * (time.process_time() - start))
    print(f"rewind of 100 samples: median {np.median(times):.2f} ms, p90 {np.percentile(times, 90):.2f} ms")


def mower() -> None:
    """Print the errors on the recordings of a mower, if gtsam is there."""
    folder = plaza.folder()
    for name in ("Plaza1", "Plaza2") if folder else ():
        assert folder is not None
        data = plaza.load(folder / f"{name}_.mat")
        points, covariances = estimated(data)
        error, by_increments = (
            plaza.aligned_error(path, data.truth[1:, 1:3]) for path in (points, dead_reckoned(data))
        )
        nees = mean_nees(points, covariances, data)
        print(f"{name} {error:.2f} m rms, dead reckoning {by_increments:.2f} m, mean NEES {nees:.2f}")


def husky() -> None:
    """Print the errors and the cost on the recording of a Husky, with velocities and with joints."""
    data = recordings.load("husky")
    reckoned = recordings.error_of(data, *recordings.dead_reckoned(data))
    for as_joints, has_compass in product((False, True), repeat=2):
        calls = recordings.calls_of(data, as_joints=as_joints, has_compass=has_compass)
        start = time.process_time()
        track = recordings.played(
            data, calls, wheels=recordings.WHEELS if as_joints else None, reads_live=True
        )
        share = 100.0 * (time.process_time() - start) / float(data.imu[-1, 0])
        found = recordings.score(data, track)
        name = f"husky, {'joints' if as_joints else 'velocity'}{', bad compass' if has_compass else ''}"
        print(f"{name:<30} {found.error:.2f} m rms, dead reckoning {reckoned:.2f} m, ", end="")
        print(f"mean NEES {found.nees:.2f}, end {found.end_sigmas:.1f} sigma, ", end="")
        print(f"longest jump {track.longest_jump:.2f} m, {share:.2f} % of a core")


def main() -> None:
    """Measure, and print."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else RUNS
    seconds = float(sys.argv[2]) if len(sys.argv) > 2 else SECONDS
    print(f"zstate {zstate.__version__}, Python {platform.python_version()}, {platform.machine()}")
    cost(seconds)
    consistency(runs, seconds)
    mower()
    husky()


if __name__ == "__main__":
    main()
