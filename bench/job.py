"""Job: everything the process of a writer or a reader must know, as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import Any


@dataclass(frozen=True)
class Job:
    """One run of one subject, as each of its processes is told.

    ``rows`` are joint positions [rad] or [m] in the order of ``joints``: a smooth motion that the writer
    goes through again and again. ``base`` and ``tip`` are the ends of the question that readers answer,
    ``links`` all links of the robot. ``rate_hz`` is 0 for as fast as possible.

    ``robots`` are all robots on the network, by name; a writer process writes those in ``mine``, one
    ``Writer`` each. ``load`` is "none", "busy" (a thread of the reader holds the GIL) or "slow" (the
    reader sleeps 10 ms after each answer).

    ``ports`` are free ones on loopback, for this run alone; ``folder`` is an empty one that goes with it.
    """

    subject: str
    urdf: str
    joints: tuple[str, ...]
    base: str
    tip: str
    links: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]
    rate_hz: float
    robots: tuple[str, ...] = ("robot",)
    mine: tuple[str, ...] = ("robot",)
    readers: int = 1
    load: str = "none"
    ports: tuple[int, ...] = ()
    folder: str = ""
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def robot(self) -> str:
        """The robot this writer writes; the only one, but in a fleet."""
        return self.mine[0]

    def of(self, *mine: str) -> Job:
        """The same, for who writes these robots."""
        return replace(self, mine=mine)

    def to_json(self) -> str:
        """On one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Job:
        """What ``to_json`` wrote."""
        read = json.loads(text)
        rows = tuple(tuple(row) for row in read.pop("rows"))
        lists = {name: tuple(value) for name, value in read.items() if isinstance(value, list)}
        return cls(**{**read, **lists, "rows": rows})
