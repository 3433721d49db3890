"""Cost of recording and lateness of replay.

For each robot another process publishes a sine at 100 Hz, all streams. First two plain subscriptions receive
the samples, then a recorder: CPU of this process per tick, which is a joint state and the transforms of all
moving edges, written as ROS 2 messages, compressed, flushed twice a second. Then the recording is replayed.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from bench.micro.form import Row, use_own_rendezvous
from bench.process import running_command
from zstate import connect
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.recording.player import Player
from zstate.recording.recorder import Recorder

RATE_HZ = 100.0
SETTLE_S = 1.0


def measure(robots: tuple[str, ...] = ("panda", "talos"), seconds: float = 10.0) -> Iterator[Row]:
    """Rows of each robot."""
    use_own_rendezvous()
    for robot in robots:
        yield from rows(robot, seconds)


def rows(robot: str, seconds: float) -> Iterator[Row]:
    """Rows of one robot."""
    with tempfile.TemporaryDirectory() as folder, connect() as session:
        path = Path(folder) / "run.mcap"
        with running_command("publish", robot, "--source", "sine", "--rate", f"{RATE_HZ:g}"):
            plain = subscription_ms(session, robot, seconds)
            with Recorder(session, path) as recorder:
                cost = ms_per_tick(lambda: recorder.stats.messages.get((robot, "tf"), 0), seconds)
            stats = recorder.stats
        yield Row(f"{robot}: CPU of two plain subscriptions", "ms a tick", [plain])
        yield Row(f"{robot}: CPU of a recorder", "ms a tick", [cost], [plain])
        yield Row(f"{robot}: file", "B a tick", [stats.bytes / stats.messages[robot, "tf"]])
        lost = stats.missed + stats.dropped + sum(stats.refused.values())
        yield Row(f"{robot}: missed, dropped or refused", "", [lost])
        with Player(session, path) as replayer:
            report = replayer.run()
        for name in ("p50", "p99", "max"):
            late_ns = getattr(report, f"lateness_{name}")
            yield Row(f"{robot}: lateness of a replay, {name}", "ms", [late_ns * 1e-6])


def subscription_ms(session: Session, robot: str, seconds: float) -> float:
    """CPU [ms] per tick of two subscriptions that only receive the bytes."""
    counts = {"joint_states": 0, "tf": 0}

    def count(stream: str) -> StreamSubscriber:
        def on_samples(arrivals: list[object]) -> None:
            counts[stream] += len(arrivals)

        return StreamSubscriber(session, f"zstate/{robot}/{stream}", on_samples)

    with count("joint_states"), count("tf"):
        return ms_per_tick(lambda: counts["tf"], seconds)


def ms_per_tick(ticks: Callable[[], int], seconds: float) -> float:
    """CPU [ms] of this process per tick, over ``seconds``."""
    time.sleep(SETTLE_S)
    began, before = time.process_time(), ticks()
    time.sleep(seconds)
    return 1e3 * (time.process_time() - began) / (ticks() - before)
