"""Lookups in zstate's buffer and other transform buffers, filled with the same motion.

    python -m bench.micro.lookup [ROW...]

Each buffer is a separate process; they are interleaved, so that a slow moment of the machine affects all.
Figures are us of thread CPU time for each call, median and 99th percentile over rounds of means of 50 calls.
See bench/README.md.
"""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

import zstate
from bench.micro.lookup.motions import FIRST, RecordedMotion, recorded_motions

HERE = Path(__file__).parent
MISSING = "missing"
ROUNDS = 7
STAMPS = 5000


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    what: str
    motion: str
    case: str
    stamps: str = "anywhere"
    per_call: int = 1


ROWS = (
    Row("arm, by name", "arm", "name"),
    Row("arm, by name, at samples", "arm", "name", "samples"),
    Row("arm, by name, the newest sample", "arm", "name", "newest"),
    Row("arm, plan", "arm", "plan"),
    Row("arm, batch of 1000", "arm", "batch", per_call=1000),
    Row("humanoid limb to limb, by name", "humanoid", "name"),
    Row("humanoid limb to limb, plan", "humanoid", "plan"),
    *(Row(f"1 kHz, {seconds} s, plan", f"history {seconds} s", "plan") for seconds in (1, 10, 100)),
    *(Row(f"{depth} moving edges, plan", f"depth {depth}", "plan") for depth in (5, 20, 100)),
    Row("error: in the future", "arm", "future"),
    Row("insert 40 edges", "40 edges", "insert"),
    Row("memory of 40 edges, 10 s at 1 kHz [MB]", "40 edges", "memory"),
)

SYSTEMS = {
    "zstate": ([sys.executable, "-m", "bench.micro.lookup.zstate_buffer"], "pip install -e ."),
    "transform-tree": (
        [sys.executable, "-m", "bench.micro.lookup.transform_tree_buffer"],
        "pip install transform-tree==0.0.9",
    ),
    "tf2": (
        ["/usr/bin/python3", str(HERE / "tf2_buffer.py")],
        "apt-get install -y --no-install-recommends python3-tf2 python3-tf2-ros",
    ),
}


class Worker:
    """The process of one buffer."""

    def __init__(self, command: Sequence[str]) -> None:
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )

    def measure(self, motion: Path, case: str, stamps: list[int]) -> list[float] | str:
        """Times of a round [us], or the reason if there are none."""
        assert self._process.stdin and self._process.stdout
        try:
            self._process.stdin.write(
                json.dumps({"motion": str(motion), "case": case, "stamps": stamps}) + "\n"
            )
            self._process.stdin.flush()
        except BrokenPipeError:
            return MISSING
        line = self._process.stdout.readline()
        return json.loads(line) if line else MISSING

    def close(self) -> None:
        """Kills the process."""
        assert self._process.stdin
        self._process.kill()
        self._process.wait()


def stamps_of(row: Row, motion: RecordedMotion, rng: np.random.Generator) -> list[int]:
    """The stamps to look up."""
    if row.stamps == "newest":
        return [motion.end] * STAMPS
    if row.stamps == "samples":
        return (FIRST + rng.integers(0, motion.count, STAMPS) * motion.step).tolist()
    return rng.integers(FIRST, motion.end, STAMPS).tolist()


def measure(
    row: Row, motion: RecordedMotion, path: Path, workers: dict[str, Worker]
) -> dict[str, list[float] | str]:
    """Times of all rounds of each buffer [us]."""
    rng = np.random.default_rng(11)
    times: dict[str, list[float] | str] = {name: [] for name in workers}
    for number in range(1 if row.case == "memory" else ROUNDS + 1):
        stamps = stamps_of(row, motion, rng)
        for name, worker in workers.items():
            earlier = times[name]
            if isinstance(earlier, str):
                continue
            round_ = worker.measure(path, row.case, stamps)
            if isinstance(round_, str):
                times[name] = round_
            elif number or row.case == "memory":  # the first round warms up
                earlier.extend(value / row.per_call for value in round_)
    return times


def cell(times: list[float] | str, ours: list[float] | str) -> str:
    """Median, 99th percentile and the ratio of the median to that of zstate."""
    if isinstance(times, str):
        return MISSING if times == MISSING else "refused"
    if not times:
        return "-"
    median, p99 = np.percentile(times, (50, 99))
    ratio = "" if times is ours else f"{median / np.median(ours):6.1f}x"
    return f"{median:9.3f} {p99:9.3f}{ratio:>8}"


def main() -> None:
    """Print the table."""
    chosen = [row for row in ROWS if not sys.argv[1:] or any(word in row.what for word in sys.argv[1:])]
    motions = recorded_motions()
    print(f"zstate {zstate.__version__} ({zstate.kernel}), Python {platform.python_version()}, ", end="")
    print(f"numpy {version('numpy')}, {platform.machine()}; median and p99 in us, ratio to zstate")
    print(f"{'':<40}" + "".join(f"{name:>28}" for name in SYSTEMS))
    missing: set[str] = set()
    with tempfile.TemporaryDirectory() as folder:
        for row in chosen:
            motion = motions[row.motion]
            path = motion.write(Path(folder))
            workers = {name: Worker(command) for name, (command, _) in SYSTEMS.items()}
            times = measure(row, motion, path, workers)
            for worker in workers.values():
                worker.close()
            missing |= {name for name, values in times.items() if values == MISSING}
            print(
                f"{row.what:<40}" + "".join(f"{cell(times[n], times['zstate']):>28}" for n in SYSTEMS),
                flush=True,
            )
    for name in sorted(missing):
        print(f"{name} is missing: {SYSTEMS[name][1]}")


if __name__ == "__main__":
    main()
