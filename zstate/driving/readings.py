"""Readings of joints, and which of them a setpoint may start from: one that is wrong would be a jump.

A setpoint starts at measured joints when they are enabled, and while they are in mode "velocity" or "effort".
There a reading that disagrees with those before it is a failure of the driver: it is counted, and neither
published nor used. Joints in mode "position" move from their last setpoint; a wrong reading stops them if it
is further from that than ``following_error``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from zstate.checks import Floats
from zstate.driving.limits import FARTHEST, Limits
from zstate.errors import InvalidInput, format_duration

MOST_OUTSIDE = 0.35
"""[rad] or [m]; a joint that is further outside its limits, or by more than its range, is not moved.

20 degrees are more than hands, gravity and a tolerance of the URDF explain: the zero of its encoder is wrong.
"""


class Readings:
    """Compares each reading of the joints of ``limits`` with those before it; instants are monotonic [ns].

    Two readings agree if no joint has moved further than its velocity limit allows in the time between, and
    half of ``following_error`` [rad] or [m]. A reading is confirmed if it agrees with the last confirmed one,
    or with the one right before it; readings more than ``oldest_ns`` apart are not compared.
    """

    def __init__(self, limits: Limits, following_error: float, oldest_ns: int) -> None:
        self._limits = limits
        self._slack = 0.5 * following_error
        self._oldest_ns = oldest_ns
        self._confirmed: tuple[Floats, int] | None = None
        self._doubtful: tuple[Floats, int] | None = None
        """The last reading, if it is not confirmed."""
        widths = limits.upper - limits.lower
        self._most_outside = np.where(widths > 0.0, np.minimum(widths, MOST_OUTSIDE), MOST_OUTSIDE)

    def vector(self, values: ArrayLike) -> Floats:
        """The positions of a reading as a vector (n,). Raises InvalidInput unless all are within 1e9."""
        positions = self._limits.vector(values, "measured positions")
        if np.abs(positions).max() > FARTHEST:
            row = int(np.abs(positions).argmax())
            name, unit = self._limits.joint_names[row], self._limits.units[row]
            raise InvalidInput(f"{name!r} is measured at {positions[row]:g} {unit}, beyond {FARTHEST:g}")
        return positions

    @property
    def is_confirmed(self) -> bool:
        """Whether the last reading is confirmed."""
        return self._confirmed is not None and self._doubtful is None

    def add(self, positions: Floats, now: int) -> str:
        """Take the reading ``positions`` (n,) of ``now``; returns which joint it disagrees about, if any."""
        recent = [
            before
            for before in (self._confirmed, self._doubtful)
            if before is not None and now - before[1] <= self._oldest_ns
        ]
        for before, at in recent:
            if self._agree(positions, before, now - at):
                self._confirmed, self._doubtful = (positions, now), None
                return ""
        self._doubtful = positions, now
        return self._difference_text(positions, *recent[0], now) if recent else ""

    def outside_text(self, positions: Floats) -> str:
        """Which joints are too far outside their limits at ``positions`` (n,) to be moved; empty if none."""
        limits = self._limits
        excess = np.maximum(limits.lower - positions, positions - limits.upper)
        if not (excess > self._most_outside).any():
            return ""
        texts = [
            f"{limits.joint_names[row]!r} is measured at {positions[row]:.4g} {limits.units[row]}, "
            f"{excess[row]:.3g} {limits.units[row]} outside {limits.range_text(row)}"
            for row in np.flatnonzero(excess > self._most_outside).tolist()
        ]
        return (
            f"{'; '.join(texts)}: too far to be moved (more than {MOST_OUTSIDE:g}, or than its range); is "
            "the zero of its encoder right, or are the limits in the URDF wrong?"
        )

    def _agree(self, positions: Floats, before: Floats, elapsed_ns: int) -> bool:
        ways = positions - before
        # Where the norm is within the slack, so is each joint; in a third of the time.
        if ways @ ways <= self._slack**2:
            return True
        return bool((np.abs(ways) <= self._slack + self._limits.velocity * (elapsed_ns * 1e-9)).all())

    def _difference_text(self, positions: Floats, before: Floats, at: int, now: int) -> str:
        ways = np.abs(positions - before)
        row = int((ways - self._limits.velocity * ((now - at) * 1e-9)).argmax())
        unit = self._limits.units[row]
        return (
            f"two readings disagree: {self._limits.joint_names[row]!r} at {positions[row]:.4g} {unit}, "
            f"{format_duration(now - at)} after {before[row]:.4g} {unit}, which its velocity limit "
            f"({self._limits.velocity[row]:g} {unit}/s) and half of following_error ({self._slack:g}) exclude"
        )
