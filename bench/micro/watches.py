"""Cost of watches per insert, and time to their first answers: a buffer without a network.

    python -m bench.micro.watches [--robot panda] [--robots 100]

- **an insert** of a robot's joints: with sleeping watches of other robots, and with watches of its own, which
  answer;
- **first answers**: robots are added one after the other, first the model and then a sample, to a buffer that
  already has a watch for each of them; from the first robot to the last answer.

Figures are CPU time of the thread: the median of means over 200 inserts, and one run for the first answers.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from zstate import Transform, TransformBuffer, load_model
from zstate.model.robot import RobotModel

ROUNDS = 25
INSERTS = 200
STEP_NS = 1_000_000


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--robots", type=int, default=100)
    options = parser.parse_args()
    model = load_model(options.robot)
    for others, own in ((0, 0), (1, 0), (30, 0), (100, 0), (0, 1), (0, 30)):
        what = f"an insert with {others} watches of other robots and {own} of its own"
        print(f"{what:<60}{insert_us(model, others, own):10.2f} us", flush=True)
    what = f"first answers of {options.robots} robots with a watch each"
    print(f"{what:<60}{first_answers_ms(model, options.robots):10.1f} ms")


def insert_us(model: RobotModel, others: int, own: int) -> float:
    """Median CPU time [us] of an insert for one robot, with watches of ``others`` and its ``own``."""
    buffer = TransformBuffer()
    names = [f"robot{number}" for number in range(others + 1)]
    tracks = [buffer.add_robot(model, name) for name in names]
    rest = np.zeros(model.position_count)
    for track in tracks:
        buffer.insert_joints(track, 0, rest)
    for name in [names[0]] * own + names[1:]:
        buffer.watch(f"{name}/{model.root}", f"{name}/{model.links[-1]}", _ignore)

    def insert(round_: int) -> None:
        for number in range(round_ * INSERTS, (round_ + 1) * INSERTS):
            buffer.insert_joints(tracks[0], number * STEP_NS, rest)

    spent = [_cpu_ns(lambda round_=round_: insert(round_)) for round_ in range(ROUNDS)]
    return float(np.median(spent)) * 1e-3 / INSERTS


def first_answers_ms(model: RobotModel, robots: int) -> float:
    """CPU time [ms] from the first robot's model to the answer of the last watch."""
    buffer, answered = TransformBuffer(), set[str]()
    names = [f"robot{number}" for number in range(robots)]
    for name in names:
        buffer.watch(f"{name}/{model.root}", f"{name}/{model.links[-1]}", lambda t: answered.add(t.target))
    rest = np.zeros(model.position_count)

    def add_robots() -> None:
        for name in names:
            buffer.insert_joints(buffer.add_robot(model, name), 0, rest)

    spent = _cpu_ns(add_robots)
    assert len(answered) == robots
    return spent * 1e-6


def _ignore(_: Transform) -> None:
    pass


def _cpu_ns(call: Callable[[], None]) -> int:
    begin = time.thread_time_ns()
    call()
    return time.thread_time_ns() - begin


if __name__ == "__main__":
    main()
