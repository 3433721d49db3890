"""A process with one buffer, measured by ``bench.micro.lookup`` over pipes. Standard library only."""

from __future__ import annotations

import array
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

CHUNK = 50


class MotionFile:
    """A motion written by ``RecordedMotion.write``, read without numpy."""

    def __init__(self, path: str) -> None:
        self.path = Path(path)
        head = json.loads(self.path.with_suffix(".json").read_text())
        self.target, self.source = head["target"], head["source"]
        self.first, self.step, self.count = head["first"], head["step"], head["count"]
        self.edges = [(parent, child) for parent, child in head["edges"]]
        self.statics = [(parent, child, pose) for parent, child, pose in head["statics"]]

    @property
    def stamps(self) -> list[int]:
        return [self.first + n * self.step for n in range(self.count)]

    def doubles(self, kind: str) -> Any:
        """All positions, or all poses of the moving edges, as one array."""
        numbers = array.array("d")
        numbers.frombytes(self.path.with_suffix(f".{kind}").read_bytes())
        return numbers


def resident_mb() -> float:
    """Resident memory of this process [MB]."""
    with open("/proc/self/statm") as statm:  # noqa: PTH123 - as short as it gets
        return int(statm.read().split()[1]) * resource.getpagesize() / 1e6


def call_times_us(call: Any, arguments: list[Any]) -> list[float]:
    """Thread CPU time per call [us], as means over chunks: one call is shorter than reading the clock."""
    times = []
    for start in range(0, len(arguments), CHUNK):
        chunk = arguments[start : start + CHUNK]
        before = time.thread_time_ns()
        for argument in chunk:
            call(argument)
        times.append((time.thread_time_ns() - before) * 1e-3 / len(chunk))
    return times


def serve(system: Any) -> None:
    """Serves requests until the input ends.

    ``system`` has ``read(recorded) -> samples``, ``fill(recorded, samples) -> state``, and for each case a
    method of that name, which takes the state and a list of stamps and returns a callable and the list of
    its arguments.
    """
    state, used_mb = None, 0.0
    for line in sys.stdin:
        request = json.loads(line)
        case = getattr(system, request["case"], None)
        try:
            if state is None:
                recorded = MotionFile(request["motion"])
                samples = system.read(recorded)
                before = resident_mb()
                state = system.fill(recorded, samples)
                used_mb = resident_mb() - before
            if request["case"] == "memory":
                reply: Any = [used_mb]
            else:
                reply = call_times_us(*case(state, request["stamps"])) if case else []
        except Exception as error:
            reply = str(error)
        print(json.dumps(reply), flush=True)
