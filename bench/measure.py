"""CPU time and memory of processes and bytes on loopback, measured from outside. Linux only.

CPU time is read from the clock of each process (``clock_getcpuclockid(3)``): nanoseconds of all its threads,
ended threads included. Bytes and packets are those of the interface ``lo`` as a whole,
with IP and TCP headers; shared memory is not counted.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
# CPUCLOCK_SCHED in linux/posix-timers.h: the clock that counts all threads of a process.
_SCHEDULED = 2


def cpu_ns(pid: int) -> int:
    """CPU time of a process since its start [ns]. Raises OSError if it does not exist."""
    return time.clock_gettime_ns((~pid << 3) | _SCHEDULED)


def peak_memory_kb(pid: int) -> int:
    """Peak resident memory [kB]; 0 if the process has ended."""
    try:
        lines = (PROC / str(pid) / "status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)


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


@dataclass(frozen=True)
class Traffic:
    """Loopback traffic since the machine started."""

    bytes: int
    packets: int

    @classmethod
    def now(cls) -> Traffic:
        """The current counters of the interface ``lo``."""
        lines = (PROC / "net" / "dev").read_text().splitlines()
        numbers = next(line.partition(":")[2].split() for line in lines if line.strip().startswith("lo:"))
        return cls(int(numbers[0]), int(numbers[1]))


class Costs:
    """CPU and traffic between ``start()`` and ``stop()``; ``roles`` are process ids by role."""

    def __init__(self, roles: dict[str, list[int]]) -> None:
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
        self._peaks_kb = {pid: peak_memory_kb(pid) for pid in self._pids()}

    def _reading(self) -> tuple[float, dict[int, int], Traffic, float]:
        cpu = {pid: cpu_ns(pid) for pid in self._pids()}
        return time.monotonic(), cpu, Traffic.now(), _machine_busy_s()

    def _pids(self) -> Iterable[int]:
        return (pid for pids in self._roles.values() for pid in pids)

    def figures(self) -> dict[str, object]:
        """CPU per role and of the rest of the machine [% of a core], traffic per second, peak memory [MB]."""
        seconds = self._ended[0] - self._began[0]
        used = {pid: (after - self._began[1][pid]) * 1e-9 for pid, after in self._ended[1].items()}
        before, after = self._began[2], self._ended[2]
        others_s = max(0.0, self._ended[3] - self._began[3] - sum(used.values()))
        return {
            "cpu_percent": {
                role: round(100.0 * sum(used[pid] for pid in pids) / seconds, 2)
                for role, pids in self._roles.items()
            },
            "others_cpu_percent": round(100.0 * others_s / seconds, 1),
            "bytes_per_s": round((after.bytes - before.bytes) / seconds),
            "packets_per_s": round((after.packets - before.packets) / seconds),
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
