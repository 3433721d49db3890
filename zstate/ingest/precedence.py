"""Which of several writers counts for a listener, if two publish the same.

Publishers of the native wire avoid that: a second writer is refused before it publishes, or ends
(``zstate.net.ownership``). A listener decides about what arrives all the same: from ROS, from networks that
are joined later, by mistake.

- Edges exclude each other if they give a frame a second parent or form a loop: the first ``EdgePrecedence``
  is accepted (``frame_ownership``). An announced writer keeps the frames that it places: another edge for
  one of them is a mistake. Whether an edge is accepted depends on all edges that may form a loop with it, so
  edges are compared by such groups, and only where one has changed.
- Of drivers with a joint in common the first ``JointPrecedence`` moves it (``joint_parts``). A driver that
  starts counts at once, as does a new writer of a whole stream (``writer_sessions``): it replaces one that
  hangs. A driver is accepted with all of its joints or not at all.

What is refused is kept, and accepted once nothing excludes it any more. The result depends on the writers,
not on the order in which their messages and tokens arrive. ``JointStateMerger`` has no tokens: with it a
writer keeps its joints until it has been silent for a while.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Rank(IntEnum):
    """What an edge is to the robot that owns its child frame."""

    MODEL = 0  # of the robot's own model
    OWN = 1  # of a writer of that robot; or of any, if the frame has no owner
    OTHERS = 2  # of a writer of another robot, which may place the root only
    CALLER = 3  # inserted by the buffer's user: no claim, and never withdrawn for one


class EdgePrecedence(NamedTuple):
    """Sort key of edges that exclude each other: the first is accepted."""

    rank: Rank
    places_root: bool
    """An edge that places the root of a model yields to one that does not: it would close the loop."""
    is_departed: bool
    """The writer has left, or moves the edge without being announced."""
    is_replaced: bool
    """Another one took its place: the accepted one of the departed stays, as it was the last to leave."""
    is_static: bool
    order: int
    """The edge that was published first stays."""


class Presence(IntEnum):
    """Whether the writer of some joints is there."""

    ANNOUNCED = 0
    DEPARTED = 1  # its samples stay; or its first ones have arrived before its token
    NONE = 2


class JointPrecedence(NamedTuple):
    """Sort key of sets of joints: the first moves a joint that is in several."""

    presence: Presence
    age: int
    """Minus the start of an announced writer [ns], or minus the moment when another appeared or left."""
    session: int
    fewer: int
    """Minus the number of joints: of a writer's own sets the largest."""
    joints: tuple[str, ...]
