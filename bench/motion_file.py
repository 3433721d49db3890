"""A robot's motion in files that workers with any Python can read; standard library only."""

from __future__ import annotations

import json
from array import array
from collections.abc import Sequence
from pathlib import Path


class MotionFile:
    """What ``bench.robot.write_motion`` has written at ``path``.

    ``edges`` are the moving ones, (parent, child); ``statics`` are (parent, child, pose7); ``facts`` are the
    writer's own.
    """

    def __init__(self, path: str) -> None:
        self.path = Path(path)
        self.facts = json.loads(self.path.with_suffix(".json").read_text())
        self.edges: list[tuple[str, str]] = [(parent, child) for parent, child in self.facts["edges"]]
        self.statics: list[tuple[str, str, list[float]]] = [tuple(one) for one in self.facts["statics"]]

    def rows(self, kind: str = "poses") -> list[Sequence[float]]:
        """The numbers of each row: its "positions", or the "poses" of the moving edges."""
        numbers = array("d")
        numbers.frombytes(self.path.with_suffix(f".{kind}").read_bytes())
        width = len(numbers) // self.facts["count"]
        return [numbers[at : at + width] for at in range(0, len(numbers), width)]
