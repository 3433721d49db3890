"""Cost of recording and lateness of replay.

    python -m bench.micro.recording [--robots panda talos] [--seconds 10]

For each robot another process publishes a sine at 100 Hz, all streams. First two plain subscriptions receive
the samples, then a recorder: CPU of this process per tick, which is a joint state and the transforms of all
moving edges, written as ROS 2 messages, compressed, flushed twice a second. Then the recording is replayed at
its rate: lateness of the samples by the recording's clock, compared with a loop that only sleeps until the
next sample is due.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.micro.processes import running_command, use_own_rendezvous
from zstate import connect
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.recording.player import Player
from zstate.recording.reader import RecordingReader
from zstate.recording.recorder import Recorder

RATE_HZ = 100.0
SETTLE_S = 1.0


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=["panda", "talos"])
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    use_own_rendezvous()
    for robot in options.robots:
        measure(robot, options.seconds)


def measure(robot: str, seconds: float) -> None:
    """Prints the lines of one robot."""
    with tempfile.TemporaryDirectory() as folder, connect() as session:
        path = Path(folder) / "run.mcap"
        with running_command("publish", robot, "--source", "sine", "--rate", f"{RATE_HZ:g}"):
            subscription_ms = subscription_cost(session, robot, seconds)
            recorder_ms, size = recorder_cost(session, robot, path, seconds)
        print(f"{robot}, {RATE_HZ:g} Hz: recorder {recorder_ms:.3f} ms CPU a tick, {size:.0f} bytes a tick")
        print(f"  two plain subscriptions: {subscription_ms:.3f} ms CPU a tick")
        with Player(session, path) as replayer:
            report = replayer.run()
        print(
            lateness_line("replay", np.array([report.lateness_p50, report.lateness_p99, report.lateness_max]))
        )
        print(lateness_line("a sleep loop", np.quantile(sleep_lateness(path), (0.5, 0.99, 1.0))), flush=True)


def subscription_cost(session: Session, robot: str, seconds: float) -> float:
    """CPU [ms] per tick of two subscriptions that only receive the bytes."""
    counts = {"joint_states": 0, "tf": 0}

    def count(stream: str) -> StreamSubscriber:
        def on_samples(arrivals: list[object]) -> None:
            counts[stream] += len(arrivals)

        return StreamSubscriber(session, f"zstate/{robot}/{stream}", on_samples)

    with count("joint_states"), count("tf"):
        return cpu_per_tick(lambda: counts["tf"], seconds)


def recorder_cost(session: Session, robot: str, path: Path, seconds: float) -> tuple[float, float]:
    """CPU [ms] and bytes per tick of a recorder."""
    with Recorder(session, path) as recorder:
        cost = cpu_per_tick(lambda: recorder.stats.messages.get((robot, "tf"), 0), seconds)
    stats = recorder.stats
    if stats.missed or stats.dropped or stats.refused:
        print(f"  missed {stats.missed}, dropped {stats.dropped}, refused {dict(stats.refused)}")
    return cost, stats.bytes / stats.messages[robot, "tf"]


def cpu_per_tick(ticks: Callable[[], int], seconds: float) -> float:
    """CPU [ms] of this process per tick, over ``seconds``."""
    time.sleep(SETTLE_S)
    began, before = time.process_time(), ticks()
    time.sleep(seconds)
    return 1e3 * (time.process_time() - began) / (ticks() - before)


def sleep_lateness(path: Path) -> np.ndarray:
    """Lateness [ns] of each joint state in a loop that sleeps until it is due."""
    with RecordingReader(path) as reader:
        due = np.array([record.log_time for record in reader.records(["/joint_states"])])
    lateness = np.empty(len(due), dtype=np.int64)
    behind = time.time_ns() - int(due[0])
    for number, stamp in enumerate(due.tolist()):
        time.sleep(max(0.0, (stamp + behind - time.time_ns()) * 1e-9))
        lateness[number] = time.time_ns() - behind - stamp
    return lateness


def lateness_line(what: str, quantiles_ns: np.ndarray) -> str:
    """One line of the table."""
    p50, p99, most = quantiles_ns * 1e-6
    return f"  {what} at 1x is late by {p50:.2f} ms median, {p99:.2f} p99, {most:.2f} at most"


if __name__ == "__main__":
    main()
