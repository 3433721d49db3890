"""CPU time and memory of processes and bytes on loopback, measured from outside. Linux only.

CPU time is read from the clock of each process (``clock_getcpuclockid(3)``): nanoseconds of all its threads,
ended threads included. Bytes are those of the interface ``lo`` as a whole, with IP and TCP headers; shared
memory is not counted.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

PROC = Path("/proc")
# CPUCLOCK_SCHED in linux/posix-timers.h: the clock that counts all threads of a process.
_SCHEDULED = 2
_POINT_S = 30.0


def cpu_ns(pid: int) -> int:
    """CPU time of a process since its start [ns]. Raises OSError if it does not exist."""
    return time.clock_gettime_ns((~pid << 3) | _SCHEDULED)


def status(pid: int | str) -> dict[str, int]:
    """The numbers of a process: ``VmHWM`` and ``VmRSS`` [kB], ``Threads``; empty if it has ended."""
    try:
        lines = (PROC / str(pid) / "status").read_text().splitlines()
    except OSError:
        return {}
    pairs = (line.split(":", 1) for line in lines)
    return {name: int(text.split()[0]) for name, text in pairs if name in ("VmHWM", "VmRSS", "Threads")}


def process_tree(pid: int) -> list[int]:
    """A process and its current descendants."""
    children: dict[int, list[int]] = {}
    for entry in PROC.iterdir():
        if entry.name.isdigit():
            children.setdefault(_parent(entry), []).append(int(entry.name))
    found = [pid]
    for one in found:
        found.extend(children.get(one, ()))
    return found


def _parent(entry: Path) -> int:
    try:
        return int((entry / "stat").read_text().rpartition(")")[2].split()[1])
    except OSError:  # the process has ended since
        return 0


def loopback_bytes() -> int:
    """Bytes received on the interface ``lo`` since the machine started."""
    lines = (PROC / "net" / "dev").read_text().splitlines()
    return int(next(line.partition(":")[2].split()[0] for line in lines if line.strip().startswith("lo:")))


class Costs:
    """CPU and traffic between ``start()`` and ``stop()``; ``roles`` are process ids by role."""

    def __init__(self, roles: Mapping[str, Sequence[int]]) -> None:
        # Processes started by a service count as that service.
        self._roles = {
            role: [one for pid in pids for one in process_tree(pid)] for role, pids in sorted(roles.items())
        }

    def start(self) -> None:
        """Starts the measured window."""
        self._began = self._reading()

    def stop(self) -> None:
        """Ends the measured window."""
        self._ended = self._reading()
        # Read now: some processes have ended when figures() is called.
        self._peaks_kb = {pid: status(pid).get("VmHWM", 0) for pid in self._pids()}

    def _reading(self) -> tuple[float, dict[int, int], int, float]:
        cpu = {pid: cpu_ns(pid) for pid in self._pids()}
        return time.monotonic(), cpu, loopback_bytes(), _machine_busy_s()

    def _pids(self) -> Iterable[int]:
        return (pid for pids in self._roles.values() for pid in pids)

    def figures(self) -> dict[str, object]:
        """CPU per role and of the rest of the machine [% of a core], traffic per second, peak memory [MB]."""
        seconds = self._ended[0] - self._began[0]
        used = {pid: (after - self._began[1][pid]) * 1e-9 for pid, after in self._ended[1].items()}
        others_s = max(0.0, self._ended[3] - self._began[3] - sum(used.values()))
        return {
            "cpu_percent": {
                role: round(100.0 * sum(used[pid] for pid in pids) / seconds, 2)
                for role, pids in self._roles.items()
            },
            "others_cpu_percent": round(100.0 * others_s / seconds, 1),
            "bytes_per_s": round((self._ended[2] - self._began[2]) / seconds),
            "peak_memory_mb": {
                role: round(sum(self._peaks_kb[pid] for pid in pids) / 1024, 1)
                for role, pids in self._roles.items()
            },
        }


def _machine_busy_s() -> float:
    """CPU seconds spent by all cores together, in steps of 10 ms."""
    numbers = (PROC / "stat").read_text().split("\n", 1)[0].split()[1:9]
    user, nice, system, _idle, _io, irq, soft_irq, _steal = map(int, numbers)
    return (user + nice + system + irq + soft_irq) / os.sysconf("SC_CLK_TCK")


def usage(pid: int) -> tuple[float, int, int, int]:
    """Now [s], and of a process its resident memory [kB], threads and file descriptors."""
    numbers = status(pid)
    return (
        time.monotonic(),
        numbers["VmRSS"],
        numbers["Threads"],
        len(list((PROC / str(pid) / "fd").iterdir())),
    )


def growth(samples: Sequence[tuple[float, int, int, int]]) -> dict[str, object]:
    """Growth of a process, from its ``usage`` in the last four fifths of the time.

    The slope of its memory [kB/min] is that of a line through the means of half minutes, with its standard
    error: successive samples are correlated, and with them the error would be too small.
    """
    rows = np.array(samples)
    rows = rows[rows[:, 0] >= rows[0, 0] + 0.2 * (rows[-1, 0] - rows[0, 0])]
    minutes = (rows[:, 0] - rows[0, 0]) / 60.0
    points = minutes * 60.0 // _POINT_S
    means = np.array([(minutes[points == n].mean(), rows[points == n, 1].mean()) for n in np.unique(points)])
    x, y = means.T if len(means) >= 4 else (minutes, rows[:, 1])
    (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
    return {
        "memory_mb": [round(float(one) / 1024, 1) for one in rows[[0, -1], 1]],
        "slope_kb_per_minute": [round(float(slope), 1), round(float(covariance[0, 0]) ** 0.5, 1)],
        "threads": rows[[0, -1], 2].astype(int).tolist(),
        "descriptors": rows[[0, -1], 3].astype(int).tolist(),
    }
