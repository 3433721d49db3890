"""Thread CPU time of calls, cases interleaved so that a slow moment of the machine affects all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np

Call: TypeAlias = Callable[[], object]


def call_times_us(
    cases: Mapping[str, Call], rounds: int, calls: int, *, pause_s: float = 0.0, warm_up: int = 1
) -> dict[str, list[float]]:
    """The time of each call [us] in ``rounds`` of ``calls`` for each case, after ``warm_up`` more rounds.

    Each call follows a pause of ``pause_s`` [s], as in a control loop; the pause is not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in cases}
    for number in range(-warm_up, rounds):
        for name, call in cases.items():
            for _ in range(calls):
                begin = time.thread_time_ns()
                call()
                if number >= 0:
                    times[name].append((time.thread_time_ns() - begin) * 1e-3)
                if pause_s:
                    time.sleep(pause_s)
    return times


def mean_times_us(cases: Mapping[str, Call], rounds: int, calls: int) -> dict[str, np.ndarray]:
    """The mean time of a call [us] in each round, without the cost of the clock; one more round warms up."""
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds + 1):
        for name, call in cases.items():
            begin = time.thread_time_ns()
            for _ in range(calls):
                call()
            times[name].append((time.thread_time_ns() - begin) / calls * 1e-3)
    return {name: np.array(values[1:]) for name, values in times.items()}
