"""The protocol between the harness and a system under test; nothing but the standard library.

One file per system, with a ``SUBJECT`` at module level and no heavy import there: the runner reads every
one of them, whether or not the system is installed. What needs the system is imported in ``load``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

from bench.job import Job

Answered: TypeAlias = "Callable[..., None]"
"""``answered(stamp)``, or ``answered(stamp, robot)`` in a fleet: see ``Reader``."""


class Writer(Protocol):
    """One robot's joint positions on their way out.

    ``Writer(job)`` connects, as ``job.robot``, and converts the rows beforehand, as far as a program
    could that has its numbers in the shape this system likes best.
    """

    def send(self, row: int, stamp: int) -> None:
        """Send ``job.rows[row]``, stamped ``stamp`` [ns] of system time."""

    def close(self) -> None:
        """Leave the network."""


class Reader(Protocol):
    """A reader's own buffer, filled from the network.

    ``Reader(job, answered)`` connects, and calls ``answered(stamp)`` in whatever thread, once for each
    sample, as soon as its own buffer has given the pose of ``job.tip`` in ``job.base`` at that stamp. It is
    woken on arrival, by the quickest way that the system documents. In a fleet it calls
    ``answered(stamp, n)`` with the place of the robot in ``job.robots``.

    Under the load "slow" ``answered`` sleeps: a system that fills its buffer in a thread of its own then
    calls it from another one, which takes the newest sample, answers and calls, as its user's loop would.
    """

    def pose(self, stamp: int, robot: int = 0) -> Sequence[float] | None:
        """The pose of tip in base at a stamp: x y z qx qy qz qw. None where the system has no answers.

        Raises whatever the system raises. Asked after the run, to compare with kinematics computed apart.
        """

    def has_tree(self) -> bool:
        """Whether each of ``job.links`` of every robot can be placed in its base by now."""

    def close(self) -> None:
        """Leave the network."""


Roles: TypeAlias = "tuple[Callable[[Job], Writer], Callable[[Job, Answered], Reader]]"


@dataclass(frozen=True)
class Service:
    """A process that a run needs besides writers and readers; its CPU is counted under ``role``.

    It is ready when it has said a line that contains ``says`` (on standard output or error), when
    ``port`` of loopback takes connections, or when the command ``probe`` ends with 0; of those that are
    given all must hold. The probe is tried again and again, within ``within_s``.
    """

    role: str
    command: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)
    says: str = ""
    port: int = 0
    probe: tuple[str, ...] = ()
    within_s: float = 20.0


def nothing(job: Job) -> Sequence[Service]:
    """No services."""
    return ()


def no_environment(job: Job) -> Mapping[str, str]:
    """Nothing but what the runner's own environment says."""
    return {}


@dataclass(frozen=True)
class Subject:
    """One system under test.

    - ``settings``: what it was set to and how it is read, a sentence each, for the report;
    - ``python``: the path of the interpreter that runs its workers; None when it is not installed;
    - ``install``: the commands that install it, as a reader of the report would type them;
    - ``versions``: of what is measured, by name; called only when it is installed;
    - ``load``: imports the system, in the worker's process, and gives its Writer and Reader;
    - ``services(job)``: started in this order, before writers and readers; ``environment(job)`` is added to
      the environment of all of them. Both may use ``job.ports`` (six of them) and write into ``job.folder``;
    - ``fleet``: whether many robots can be heard by one reader. ``floor``: it does no work, for comparison.
    """

    name: str
    title: str
    settings: tuple[str, ...]
    install: tuple[str, ...]
    python: Callable[[], str | None]
    versions: Callable[[], dict[str, str]]
    load: Callable[[], Roles]
    services: Callable[[Job], Sequence[Service]] = nothing
    environment: Callable[[Job], Mapping[str, str]] = no_environment
    fleet: bool = False
    floor: bool = False
