"""SampleNames: what the numbers in the samples of one robot are called."""

from __future__ import annotations

from dataclasses import dataclass

from zstate.wire.messages import Edges


@dataclass(frozen=True, slots=True)
class SampleNames:
    """The names behind the numbers of a writer's samples, for wires that name each of them.

    ``coordinates`` names each number of a position vector; ``velocity_slots`` says under which of them
    each number of a velocity or effort vector stands; ``moving_edges`` is the order of poses.
    """

    coordinates: tuple[str, ...] = ()
    velocity_slots: tuple[int, ...] = ()
    moving_edges: Edges = ()
