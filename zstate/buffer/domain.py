"""Domain: whose time the stamps of a buffer are."""

from __future__ import annotations

from zstate.locks import new_lock


class Domain:
    """Stamps of two clocks that say nothing of each other must not meet in one buffer.

    Which time it is is decided by the clock that the buffer was given, else by the first robot that
    says whose time it keeps.
    """

    def __init__(self, given: str | None = None) -> None:
        self._given = given
        self._kept: dict[str, str] = {}
        self._lock = new_lock()

    @property
    def name(self) -> str | None:
        """Its name: "system", or that of a simulated time; None while it is open."""
        return self._given or self._first()[1] or None

    def _first(self) -> tuple[str, str]:
        """A robot that decides, and the time it keeps; both empty without one."""
        told = ((robot, kept) for robot, kept in list(self._kept.items()) if kept)
        return next(told, ("", ""))

    def of(self, robot: str) -> str | None:
        """The time that ``robot`` keeps: empty where its wire does not tell, None before its description."""
        return self._kept.get(robot)

    def decide(self, domain: str) -> None:
        """Be of this time from now on, whatever robots say."""
        self._given = domain

    def objection(self, robot: str, domain: str) -> str:
        """Why stamps of ``robot``, which keeps the time ``domain``, may not come in; empty when they may.

        A robot whose wire does not tell its time, ``domain=""``, is taken to keep the same.
        """
        with self._lock:
            self._kept.pop(robot, None)
            held, holder = self.name, self._first()[0]
            if not domain or held in (None, domain):
                self._kept[robot] = domain
                return ""
        if self._given is None:
            other = f"{holder!r}, which is in the same buffer, keeps {held!r} time"
        else:
            other = f"the clock here tells {held!r} time"
        return (
            f"{robot!r} keeps {domain!r} time, but {other}; stamps of the two cannot be compared: "
            "give them buffers of their own, or all of them one clock"
        )
