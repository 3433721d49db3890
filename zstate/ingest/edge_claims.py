"""Edges that writers publish, and whether they are accepted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from zstate.errors import InsertRefused
from zstate.transform import Transform
from zstate.wire.keys import EdgeNames

CONTESTED = ("second parent", "second writer", "loop")
"""The refusal reasons of edges that exclude each other."""

# A static edge this close to the model's [m, or the sine of an angle] was computed from the same URDF.
_SAME_POSE = 1e-6


def is_same_pose(one: Transform, other: Transform) -> bool:
    """Whether two poses of one frame differ by rounding only."""
    return bool(np.allclose(one.matrix, other.matrix, rtol=0.0, atol=_SAME_POSE))


@dataclass(eq=False, slots=True)
class EdgeClaim:
    """An edge that one source publishes. ``pose`` is None for a moving one."""

    source: EdgeSource
    parent: str
    child: str
    order: int
    published: int = 0
    pose: Transform | None = None
    is_accepted: bool = False
    refusal: InsertRefused | None = None

    @property
    def names(self) -> EdgeNames:
        """(parent, child)."""
        return self.parent, self.child


@dataclass(eq=False, slots=True)
class EdgeSource:
    """A writer of edges: the ``robot`` whose key they arrive on, and the ``session`` in its messages.

    ``name`` is only printed, no rule depends on it. ``is_model`` marks the edges of the robot's model.
    """

    robot: str
    name: str
    session: int = 0
    is_model: bool = False
    claims: dict[EdgeNames, EdgeClaim] = field(default_factory=dict[EdgeNames, EdgeClaim])


class Admitted(NamedTuple):
    """The ``rows`` of a sample that may be inserted, None for all, and the refusal of another row."""

    rows: tuple[int, ...] | None = None
    refusal: InsertRefused | None = None
