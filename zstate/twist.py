"""Twist: how fast a frame moves, seen from another."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.clock import stamp_text


class Twist:
    """How fast ``frame`` moves, seen from ``reference``: d/dt of ``reference_from_frame``.

    ``linear`` [m/s] is the velocity of the frame's origin, ``angular`` [rad/s] that of its axes;
    both are vectors in the axes of ``reference``. ``stamp`` is None where nothing can move.
    """

    __slots__ = ("angular", "frame", "linear", "reference", "stamp")

    def __init__(
        self, frame: str, reference: str, linear: ArrayLike, angular: ArrayLike, stamp: int | None
    ) -> None:
        self.frame = frame
        self.reference = reference
        self.linear = np.array(linear, dtype=np.float64)
        self.angular = np.array(angular, dtype=np.float64)
        self.stamp = stamp
        self.linear.flags.writeable = self.angular.flags.writeable = False

    @property
    def expressed_in(self) -> str:
        """The frame in whose axes both vectors stand."""
        return self.reference

    @property
    def about(self) -> str:
        """The frame at whose origin ``linear`` is measured."""
        return self.frame

    def __repr__(self) -> str:
        when = "" if self.stamp is None else f" at {stamp_text(self.stamp)}"
        return (
            f"<twist of {self.frame} in {self.reference}{when}: linear {_vector_text(self.linear)} m/s, "
            f"angular {_vector_text(self.angular)} rad/s>"
        )


def _vector_text(vector: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{round(value, 4) + 0.0:.4f}" for value in vector.tolist()) + "]"
