"""Resource usage of a process from /proc, and its growth."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

COLUMNS = ("seconds", "rss_kb", "threads", "fds", "cpu_s")
_POINT_S = 30.0


def usage(pid: int) -> list[float]:
    """Resident kB, threads, file descriptors, CPU seconds."""
    process = Path(f"/proc/{pid}")
    lines = (process / "status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    times = (process / "stat").read_text().rpartition(")")[2].split()
    cpu_s = (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")
    return [
        int(status["VmRSS"].split()[0]),
        int(status["Threads"]),
        len(list((process / "fd").iterdir())),
        cpu_s,
    ]


def growth(samples: Sequence[Sequence[float]], warm_up_s: float) -> dict[str, Any]:
    """Growth of ``samples`` (rows of ``COLUMNS``) after the warm-up, which is at most half of the time."""
    rows = np.array(samples)
    steady = rows[rows[:, 0] >= min(warm_up_s, rows[-1, 0] / 2)]
    first, last = steady[0], steady[-1]
    slope, error = _line(steady[:, 0], steady[:, 1])
    return {
        "rss_mb_first_last": [round(float(one[1]) / 1024, 1) for one in (first, last)],
        "rss_slope_kb_per_minute": slope,
        "rss_slope_error": error,
        "threads_first_last": [int(first[2]), int(last[2])],
        "fds_first_last": [int(first[3]), int(last[3])],
        "cpu_percent": round(float((last[4] - first[4]) / (last[0] - first[0]) * 100.0), 1),
    }


def _line(seconds: np.ndarray, kb: np.ndarray) -> tuple[float, float | None]:
    """Slope of the line through the means of half minutes [kB/min], and its standard error.

    Means are used because successive samples are correlated: with single samples the standard error would
    be too small.
    """
    points = (seconds - seconds[0]) // _POINT_S
    mean = [(seconds[points == n].mean() / 60.0, kb[points == n].mean()) for n in np.unique(points)]
    x, y = np.array(mean).T
    if len(x) < 4:
        x, y = seconds / 60.0, kb
    (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
    return round(float(slope), 1), round(float(covariance[0, 0] ** 0.5), 1)
