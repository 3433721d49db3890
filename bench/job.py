"""The job of a writer, reader or joiner process, as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace


@dataclass(frozen=True)
class Job:
    """One run of one subject, as sent to each of its processes.

    ``rows`` are joint positions [rad] or [m] in the order of ``joints``: a smooth motion that the writer
    repeats, with its transforms in the ``MotionFile`` at ``motion``. ``base`` and ``tip`` are the target and
    source of the readers' lookups, ``links`` all links of the robot.

    ``robots`` are all robots on the network, by name; a writer process publishes the robots in ``mine``, with
    one ``Writer`` each, which share one link if ``one_link``. Readers follow the first ``follows`` robots, or
    all if it is 0. ``routers`` is the number of routers in a row between writers and readers.

    If it ``soaks``, processes count samples in constant memory, and writers also publish a latched value.

    ``ports`` are free loopback ports reserved for this run; ``folder`` is an empty temporary folder.
    """

    subject: str
    urdf: str
    joints: tuple[str, ...]
    base: str
    tip: str
    links: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]
    rate_hz: float
    motion: str = ""
    robots: tuple[str, ...] = ("robot",)
    mine: tuple[str, ...] = ("robot",)
    follows: int = 0
    routers: int = 1
    one_link: bool = False
    soaks: bool = False
    ports: tuple[int, ...] = ()
    folder: str = ""

    @property
    def robot(self) -> str:
        """The first robot of this writer; the only one, except in a fleet."""
        return self.mine[0]

    @property
    def followed(self) -> tuple[str, ...]:
        """The robots that readers follow."""
        return self.robots[: self.follows or None]

    def router_port(self, role: str) -> int:
        """The port of the router that a "writer" or a "reader" connects to."""
        return self.ports[0 if role == "writer" else self.routers - 1]

    def for_robots(self, *mine: str) -> Job:
        """The same job for a writer of the robots ``mine``."""
        return replace(self, mine=mine)

    def to_json(self) -> str:
        """The job as one line of JSON."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Job:
        """The job written by ``to_json``."""
        read = json.loads(text)
        rows = tuple(tuple(row) for row in read.pop("rows"))
        lists = {name: tuple(value) for name, value in read.items() if isinstance(value, list)}
        return cls(**{**read, **lists, "rows": rows})
