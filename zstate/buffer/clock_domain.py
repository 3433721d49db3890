"""Clock domain of each robot in a buffer: the clock that its samples are stamped by."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from zstate._util.bounded import BoundedDict
from zstate._util.fork_safe import fork_safe_lock


class ClockDomain:
    """The clock domain of each robot. Robots of different domains may share one buffer.

    Stamps of two domains cannot be compared, so a path across both has no answer. ``name`` is the domain to
    use where one has to be chosen: that of the clock given by the user, else that of most robots. The newest
    4096 robots and frames are remembered.
    """

    def __init__(self, given: str | None = None) -> None:
        self.given = given
        """The domain of the user's clock, None without one."""
        self._by_robot: BoundedDict[str, str] = BoundedDict()
        self._measured: BoundedDict[str, str] = BoundedDict()
        self._ahead_ns: dict[str, int] = {}
        self._present: dict[str, None] = {}
        self._robot_by_child: BoundedDict[str, str] = BoundedDict()
        self._lock = fork_safe_lock()

    @property
    def name(self) -> str | None:
        """That of the user's clock, else of the majority of robots that have samples and have not left.

        None while no such robot is known; the first of two equally common domains.
        """
        if self.given:
            return self.given
        with self._lock:
            counts = Counter(domain for robot in self._present if (domain := self._by_robot.get(robot)))
        return next((domain for domain, _ in counts.most_common(1)), None)

    def domain_of(self, robot: str) -> str | None:
        """The domain of ``robot``: empty if its wire format has none, None before its description."""
        return self._by_robot.get(robot)

    def comparable(self, robot: str) -> str | None:
        """The domain within which stamps of ``robot`` can be compared: its own, unless it was measured."""
        return self._measured.get(robot) or self._by_robot.get(robot)

    def ahead_ns(self, domain: str) -> int | None:
        """How far a measured ``domain`` is ahead of the clock of this host; None for any other."""
        return self._ahead_ns.get(domain)

    def set_measured(self, robot: str, domain: str, ahead_ns: int = 0) -> bool:
        """Set that ``robot`` has a clock of its own, called ``domain``, ``ahead_ns`` ahead of this host's.

        Empty if its clock is that of its domain. Returns whether that is a change.
        """
        with self._lock:
            before = self._measured.pop(robot, "")
            if domain:
                self._measured[robot], self._ahead_ns[domain] = domain, ahead_ns
        return before != domain

    def robot_placing(self, child: str) -> str:
        """The robot whose writer places the frame ``child``: that of its name, unless another one does."""
        return self._robot_by_child.get(child) or child.partition("/")[0]

    def set(self, robot: str, domain: str) -> bool:
        """Set the domain of ``robot``, as its description gives it. Returns whether that is a change."""
        with self._lock:
            before = self._by_robot.get(robot)
            self._by_robot[robot] = domain
        return before != domain

    def assign(self, robot: str, children: Iterable[str]) -> None:
        """Record that writers of ``robot`` place the frames ``children``."""
        with self._lock:
            for child in children:
                if child.partition("/")[0] == robot:
                    self._robot_by_child.pop(child, None)
                else:
                    self._robot_by_child[child] = robot

    def join(self, robot: str) -> None:
        """Count ``robot`` for the majority: it has samples."""
        with self._lock:
            self._present[robot] = None

    def leave(self, robot: str) -> None:
        """Count ``robot`` no more: its writer has left. Samples it sent stay in its domain."""
        with self._lock:
            self._present.pop(robot, None)
