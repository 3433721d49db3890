"""Edges that writers publish, and the rule of who may publish which."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from zstate.errors import InsertRefused
from zstate.transform import Transform

EdgeNames = tuple[str, str]
"""Parent and child, named in full."""

FOREIGN = "foreign frame"
"""The reason of refusals of edges that place another robot's frames."""

CONTESTED = ("second parent", "second writer", "loop")
"""The reasons of refusals of edges that exclude each other."""

# A static edge that is this near to a model's [m, or the sine of a turn] was computed from the same URDF.
_SAME = 1e-6


def are_same(one: Transform, other: Transform) -> bool:
    """Whether two poses of one frame are the same but for how they were computed."""
    return bool(np.allclose(one.matrix, other.matrix, rtol=0.0, atol=_SAME))


def robot_in(frame: str) -> str:
    """The first part of a full name: the robot whose frame that is, if there is such a robot."""
    return frame.partition("/")[0]


def foreign_objection(
    robot: str, edge: EdgeNames, robots: Collection[str], placers: Collection[str] | None = None
) -> str:
    """Why a writer of ``robot`` may not publish ``edge`` at all; empty where it may.

    ``robots`` are those on the network. Of those that place other robots' roots only ``placers`` count,
    unless that is None.
    """
    parent, child = edge
    owner, other = robot_in(child), robot_in(parent)
    if owner == robot or owner not in robots:
        return ""
    whose = f"{child!r} is a frame of robot {owner!r}, and the edge from {parent!r} came from robot {robot!r}"
    if placers is not None and robot not in placers:
        allowed = ", ".join(map(repr, sorted(placers))) or "no robot"
        return f"{whose}, which is not among the placers ({allowed}); publish it as robot {owner!r}"
    if other != robot and other in robots:
        return (
            f"{whose}, which may place the root of {owner!r} in frames of its own, and {parent!r} is a frame "
            f"of {other!r}; publish it as robot {owner!r} (--robot {owner})"
        )
    return ""


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
    """A writer of edges: the ``robot`` on whose key they come, and the ``session`` in its messages.

    ``name`` is for people, and decides nothing. ``is_model`` says that they are edges of the robot's model.
    """

    robot: str
    name: str
    session: int = 0
    is_model: bool = False
    claims: dict[EdgeNames, EdgeClaim] = field(default_factory=dict[EdgeNames, EdgeClaim])


class Admitted(NamedTuple):
    """The ``rows`` of a sample that may be inserted, None for all; and why one is refused."""

    rows: tuple[int, ...] | None = None
    refusal: InsertRefused | None = None
