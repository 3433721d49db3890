"""Whether joints follow the setpoints that are written to them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zstate.driving.limits import Limits
from zstate.errors import InvalidInput, format_duration


class FollowingCheck:
    """Compares setpoints of the joints of ``limits`` with readings; instants are monotonic [ns].

    A joint may be ``most`` [rad] or [m] from its setpoint, and a reading ``oldest_ns`` old. Raises
    InvalidInput unless ``most`` is above zero.
    """

    def __init__(self, limits: Limits, most: float, oldest_ns: int) -> None:
        if not most > 0.0:
            raise InvalidInput(f"following_error is a distance above zero, not {most!r}")
        self._limits = limits
        self._most = most
        self._oldest_ns = oldest_ns
        self._setpoint: NDArray[np.float64] | None = None
        self._written_at = 0

    def written(self, positions: NDArray[np.float64], now: int) -> None:
        """``positions``, (n,), have been written at ``now``."""
        self._setpoint, self._written_at = positions, now

    def stopped(self) -> None:
        """The joints are not commanded any more."""
        self._setpoint = None

    def deviation(self, measured: NDArray[np.float64], measured_at: int, now: int) -> str:
        """Why the joints, which were ``measured`` last, do not follow; empty if they do."""
        if self._setpoint is None:
            return ""
        if now - measured_at > self._oldest_ns:
            return f"there is no new reading of the joints for {format_duration(now - measured_at)}"
        if measured_at < self._written_at:
            return ""
        errors = np.abs(measured - self._setpoint)
        row = int(errors.argmax())
        if errors[row] <= self._most:
            return ""
        name, unit = self._limits.joint_names[row], self._limits.units[row]
        return (
            f"{name!r} is {errors[row]:.3g} {unit} from its setpoint, more than "
            f"following_error={self._most:g}; has it power, and is it free to move?"
        )
