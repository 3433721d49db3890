"""The protocol between the harness and a system under test; standard library only.

A module has ``SUBJECTS`` and no heavy import at module level: the runner imports all of them, even if the
system is not installed. Imports of the system itself belong in ``load``.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeAlias

from bench.job import Job

HOME = os.environ.get("ZSTATE_BENCH_HOME", ".bench")
ENVIRONMENTS = Path(__file__).parents[2] / HOME
"""The environments of other systems."""

Answered: TypeAlias = "Callable[..., None]"
"""``answered(stamp)``, or ``answered(stamp, robot)`` in a fleet: see ``Reader``."""


class Writer(Protocol):
    """Publishes one robot's joint positions.

    ``Writer(job)`` connects as ``job.robot`` and converts the rows beforehand, as a program could that keeps
    its numbers in the best shape for this system.
    """

    def send(self, row: int, stamp: int) -> None:
        """Sends ``job.rows[row]``, stamped ``stamp`` [ns] of system time."""

    def close(self) -> None:
        """Leaves the network."""


class Reader(Protocol):
    """A reader's own buffer, filled from the network.

    ``Reader(job, answered)`` connects, and calls ``answered(stamp)`` in any thread, once per sample, as soon
    as its own buffer has returned the pose of ``job.tip`` in ``job.base`` at that stamp. It is woken on
    arrival, by the fastest mechanism that the system documents. In a fleet it calls ``answered(stamp, n)``
    with the index of the robot in ``job.robots``.

    Of a subject that soaks, a writer also has ``latch(number)``, which publishes a value that late joiners
    receive, and a reader ``latched(number)``, how many robots have that value.
    """

    def pose(self, stamp: int, robot: int = 0) -> Sequence[float] | None:
        """The pose of tip in base at a stamp: x y z qx qy qz qw. None if the system computes no poses.

        Raises the errors of the system. Called after the run, for comparison with independent kinematics.
        """

    def has_tree(self) -> bool:
        """Whether each of ``job.links`` of every robot has a pose in its base."""

    def close(self) -> None:
        """Leaves the network."""


Roles: TypeAlias = "tuple[Callable[[Job], Writer], Callable[[Job, Answered], Reader]]"


@dataclass(frozen=True)
class Service:
    """A process that a run needs besides writers and readers; its CPU is counted under ``role``.

    It is ready when it has printed a line with ``ready_text`` (on standard output or error), loopback
    ``port`` accepts connections, and the command ``probe`` exits with 0; only the given conditions count.
    The probe is repeated for up to ``within_s``.
    """

    role: str
    command: tuple[str, ...]
    ready_text: str = ""
    port: int = 0
    probe: tuple[str, ...] = ()
    within_s: float = 20.0


@dataclass(frozen=True)
class Subject:
    """One system under test.

    - ``settings``: its settings and how it is read, one sentence each, for the report;
    - ``python``: the interpreter of its workers; None if it is not installed;
    - ``install``: the commands that install it, as typed in the checkout;
    - ``versions``: of the measured packages, by name; called only if installed;
    - ``load``: imports the system, in the worker's process, and returns its Writer and Reader;
    - ``services(job)``: started in this order, before writers and readers; ``environment(job)`` is added to
      the environment of all of them. Both may use ``job.ports`` (six of them) and write into ``job.folder``;
    - ``fleet``: whether one reader can follow many robots, and soak. ``floor``: it computes no poses.
    """

    name: str
    title: str
    settings: tuple[str, ...]
    install: tuple[str, ...]
    python: Callable[[], str | None]
    versions: Callable[[], dict[str, str]]
    load: Callable[[], Roles]
    services: Callable[[Job], Sequence[Service]] = field(default=lambda job: ())
    environment: Callable[[Job], Mapping[str, str]] = field(default=lambda job: {})
    fleet: bool = False
    floor: bool = False


def environment_path(name: str) -> str:
    """The path of the environment ``name``, quoted for a command that is run in the checkout."""
    return shlex.quote(f"{HOME}/{name}")


def venv_python(name: str) -> str | None:
    """The interpreter of the environment ``name``, as made by ``python -m bench setup``; None if absent."""
    python = ENVIRONMENTS / name / "bin" / "python"
    return str(python) if python.exists() else None


def versions_there(python: str | None, *packages: str) -> dict[str, str]:
    """The versions of ``packages`` in the environment of the interpreter ``python``."""
    code = f"from importlib.metadata import version\nfor one in {packages}: print(one, version(one))"
    done = subprocess.run([str(python), "-c", code], check=True, capture_output=True, text=True)
    return dict(line.split() for line in done.stdout.splitlines())
