"""Lookups in zstate's buffer and other transform buffers, filled with the same motion.

    pip install transform-tree==0.0.9
    apt-get install -y --no-install-recommends python3-tf2 python3-tf2-ros

**arm**: panda, link0 to a finger, 10 edges; 10 s of history at 100 Hz, lookups at random stamps.
**humanoid**: g1, left foot to right hand. **1 kHz**: the arm with 1, 10 and 100 s of history.

zstate receives joint positions, the others the pose of each moving edge, computed from them; static edges
are static in all. Others are called through their fastest documented function. Under tf2, *by name* is
tf2_ros.Buffer, *plan* its bare core. Each buffer is a process, and they take turns in each round with the
same stamps, each looked up once: with a long history caches are cold, as in a program that also does other
work. Figures are us of thread CPU time, of means over 50 calls; the text of an error is not read.

Bias for zstate: a robot's joints are one track, so one search serves a whole path; poses inserted edge by
edge do not have this advantage. Bias against tf2: from C++ a lookup costs a third or less.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.micro.form import Row, chain_urdf
from bench.process import Process, RunFailed, running
from bench.robot import write_motion
from zstate import RobotModel, load_model

FIRST = 1_790_000_000_000_000_000
STAMPS = 5000
WITHIN_S = 120.0
SYSTEMS = {"zstate": sys.executable, "transform-tree": sys.executable, "tf2": "/usr/bin/python3"}


@dataclass(frozen=True)
class Motion:
    """A moving robot, and the pair of frames of the lookups."""

    model: RobotModel
    target: str
    source: str
    rate_hz: int = 100
    seconds: int = 10

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.rate_hz * self.seconds

    @property
    def step(self) -> int:
        """The time between two samples [ns]."""
        return 10**9 // self.rate_hz

    def write(self, path: Path) -> None:
        """Writes the files of a ``MotionFile``, of joints on independent sines."""
        width = self.model.position_count
        sines = np.random.default_rng(7).uniform((0.3, 0.5, 0.0), (1.0, 3.0, 6.0), (width, 3))
        amplitude, speed, phase = sines.T
        positions = amplitude * np.sin(speed * np.arange(self.count)[:, None] / self.rate_hz + phase)
        ends = {"target": self.target, "source": self.source}
        write_motion(path, self.model, positions, first=FIRST, step=self.step, **ends)


class Case(NamedTuple):
    """One line of the table: what each buffer does with which stamps of a motion."""

    what: str
    motion: Motion
    case: str
    stamps: str = "anywhere"
    per_call: int = 1


def cases() -> list[Case]:
    """All lines."""
    panda, g1 = load_model("panda"), load_model("g1")
    ends = ("panda_link0", "panda_leftfinger")
    arm, humanoid = Motion(panda, *ends), Motion(g1, "left_ankle_roll_link", "right_rubber_hand")
    edges = Motion(chain(40), "link0", "link20", 1000)
    return [
        Case("arm, by name", arm, "name"),
        Case("arm, by name, at samples", arm, "name", "samples"),
        Case("arm, by name, the newest sample", arm, "name", "newest"),
        Case("arm, plan", arm, "plan"),
        Case("arm, batch of 1000", arm, "batch", per_call=1000),
        Case("humanoid limb to limb, by name", humanoid, "name"),
        Case("humanoid limb to limb, plan", humanoid, "plan"),
        *(Case(f"1 kHz, {s} s, plan", Motion(panda, *ends, 1000, s), "plan") for s in (1, 10, 100)),
        *(
            Case(f"{n} moving edges, plan", Motion(chain(n), "link0", f"link{n}"), "plan")
            for n in (5, 20, 100)
        ),
        Case("error: in the future", arm, "future"),
        Case("insert 40 edges", edges, "insert"),
        Case("memory of 40 edges, 10 s at 1 kHz", edges, "memory"),
    ]


def chain(joints: int) -> RobotModel:
    """A chain of joints with an offset each."""
    return load_model(chain_urdf(joints, origin='<origin xyz="0.1 0 0.05" rpy="0.3 0 0"/>'))


def measure(only: str = "", rounds: int = 7) -> Iterator[Row]:
    """Rows of each case whose text contains ``only``, compared with zstate."""
    for case in cases():
        if only in case.what:
            unit = "MB" if case.case == "memory" else "us"
            times = measure_case(case, rounds)
            for name, values in times.items():
                if values:
                    than = None if name == "zstate" else times["zstate"]
                    yield Row(f"{case.what}: {name}", unit, values, than)


def measure_case(case: Case, rounds: int) -> dict[str, list[float]]:
    """The times of each buffer; of those that refuse or are not installed the reason is printed."""
    times: dict[str, list[float]] = {}
    rng = np.random.default_rng(11)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as opened:
        path = Path(folder) / "motion"
        case.motion.write(path)
        buffers: dict[str, Process] = {}
        for name, python in SYSTEMS.items():
            command = (python, "-m", "bench.micro.lookup_buffers", name, str(path))
            buffers[name] = opened.enter_context(running(name, *command))
        for name, buffer in list(buffers.items()):
            try:
                filled = buffer.wait_for_event("filled", WITHIN_S)
            except RunFailed as reason:
                print(f"{case.what}: {name} has none, {str(reason).rpartition(' / ')[2]}")
                del buffers[name]
            else:
                times[name] = [filled["memory_mb"]] if case.case == "memory" else []
        for number in range(0 if case.case == "memory" else rounds + 1):
            stamps = stamps_of(case, rng)
            for name, buffer in buffers.items():
                buffer.send_command(case=case.case, stamps=stamps)
                found: list[Any] = buffer.wait_for_event("times", WITHIN_S)["times"]
                times[name] += [one / case.per_call for one in found] if number else []  # the first warms up
    return times


def stamps_of(case: Case, rng: np.random.Generator) -> list[int]:
    """The stamps to look up."""
    motion = case.motion
    newest = FIRST + (motion.count - 1) * motion.step
    if case.stamps == "newest":
        return [newest] * STAMPS
    if case.stamps == "samples":
        return (FIRST + rng.integers(0, motion.count, STAMPS) * motion.step).tolist()
    return rng.integers(FIRST, newest, STAMPS).tolist()
