"""What a process costs, seen from outside: CPU time, memory, bytes on loopback. Linux only.

CPU time is read from each process's own clock, as ``clock_getcpuclockid(3)`` gives it: nanoseconds, of all
its threads, also of those that have ended. Bytes and packets are those of the interface ``lo`` as a whole,
with the heads of IP and TCP; what goes through shared memory is not seen.
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
    """CPU time of a process since it began [ns]. Raises OSError when it is not there."""
    return time.clock_gettime_ns((~pid << 3) | _SCHEDULED)


def peak_memory_kb(pid: int) -> int:
    """The most memory that was resident at once [kB]; 0 when the process is gone."""
    try:
        lines = (PROC / str(pid) / "status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)


def family(pid: int) -> list[int]:
    """A process and all that descend from it, as of now."""
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
    except OSError:  # it has ended meanwhile
        return 0


@dataclass(frozen=True)
class Traffic:
    """What loopback has carried since the machine started."""

    bytes: int
    packets: int

    @classmethod
    def now(cls) -> Traffic:
        """What the interface has counted."""
        lines = (PROC / "net" / "dev").read_text().splitlines()
        numbers = next(line.partition(":")[2].split() for line in lines if line.strip().startswith("lo:"))
        return cls(int(numbers[0]), int(numbers[1]))


class Costs:
    """CPU and traffic between ``begin()`` and ``end()``; ``roles`` are the processes by what they do."""

    def __init__(self, roles: dict[str, list[int]]) -> None:
        # Who a service starts counts as that service.
        self._roles = {
            role: [one for pid in pids for one in family(pid)] for role, pids in sorted(roles.items())
        }

    def begin(self) -> None:
        """The window begins."""
        self._began = self._reading()

    def end(self) -> None:
        """The window ends."""
        self._ended = self._reading()
        # Now: by the time anybody asks, some of them are gone.
        self._peaks_kb = {pid: peak_memory_kb(pid) for pid in self._pids()}

    def _reading(self) -> tuple[float, dict[int, int], Traffic, float]:
        cpu = {pid: cpu_ns(pid) for pid in self._pids()}
        return time.monotonic(), cpu, Traffic.now(), _machine_busy_s()

    def _pids(self) -> Iterable[int]:
        return (pid for pids in self._roles.values() for pid in pids)

    def figures(self) -> dict[str, object]:
        """CPU of each role [% of a core], of everybody else on the machine, traffic a second, memory [MB]."""
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
    """CPU seconds that all cores together have spent on anything, in steps of 10 ms."""
    numbers = (PROC / "stat").read_text().split("\n", 1)[0].split()[1:9]
    user, nice, system, _idle, _io, irq, soft_irq, _steal = map(int, numbers)
    return (user + nice + system + irq + soft_irq) / os.sysconf("SC_CLK_TCK")
