"""Domain: which clock stamps the samples of each robot in a buffer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from zstate.buffer.edge import Edge
from zstate.locks import new_lock

# So many robots and frames are remembered; of more, the oldest are forgotten.
_MOST = 4096


class Domain:
    """The clock domain of each robot. Robots of different domains may share one buffer.

    Stamps of two domains cannot be compared, so a path across both has no answer. ``name`` is the domain to
    use where one has to be chosen: that of the clock given by the user, else that of most robots.
    """

    def __init__(self, given: str | None = None) -> None:
        self.given = given
        """The domain of the clock that the user gave, None without one."""
        self._kept: dict[str, str] = {}
        self._present: dict[str, None] = {}
        self._placed: dict[str, str] = {}
        self._lock = new_lock()

    @property
    def name(self) -> str | None:
        """That of the user's clock, else of the majority of robots that have samples and have not left.

        None while no such robot is known; the first of two equally common domains.
        """
        return self.given or self._most_common()

    def _most_common(self) -> str | None:
        with self._lock:
            counts = Counter(kept for robot in self._present if (kept := self._kept.get(robot)))
        return next((domain for domain, _ in counts.most_common(1)), None)

    def of(self, robot: str) -> str | None:
        """The domain of ``robot``: empty if its wire does not carry it, None before its description."""
        return self._kept.get(robot)

    def of_edge(self, edge: Edge) -> str | None:
        """The domain of the samples of a moving edge: that of the robot whose writer places it."""
        return self._kept.get(self.robot_of(edge))

    def robot_of(self, edge: Edge) -> str:
        """The robot whose writer places ``edge``."""
        if edge.robot is not None:
            return edge.robot.prefix
        return self.robot_placing(edge.child)

    def robot_placing(self, child: str) -> str:
        """The robot whose writer places the frame ``child``: that of its name, unless another one does."""
        return self._placed.get(child) or child.partition("/")[0]

    def set(self, robot: str, domain: str) -> bool:
        """Set the domain of ``robot``, as its description gives it. Returns whether that is a change."""
        with self._lock:
            before = self._kept.get(robot)
            _remember(self._kept, robot, domain)
        return before != domain

    def place(self, robot: str, children: Iterable[str]) -> None:
        """Record that writers of ``robot`` place the frames ``children``."""
        for child in children:
            if child.partition("/")[0] == robot:
                self._placed.pop(child, None)
            else:
                _remember(self._placed, child, robot)

    def join(self, robot: str) -> None:
        """Count ``robot`` for the majority: it has samples."""
        with self._lock:
            self._present[robot] = None

    def leave(self, robot: str) -> None:
        """Count ``robot`` no more: its writer has left. Samples it sent stay in its domain."""
        with self._lock:
            self._present.pop(robot, None)


def _remember(known: dict[str, str], key: str, value: str) -> None:
    known.pop(key, None)
    known[key] = value
    while len(known) > _MOST:
        del known[next(iter(known))]
