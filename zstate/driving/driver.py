"""The interface of a driver, which owns the hardware of some joints, and the calibration of its numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.checks import real_numbers
from zstate.driving.messages import Mode
from zstate.errors import InvalidInput
from zstate.sources import JointReading

StopMode: TypeAlias = Literal["hold", "relax"]
"""How a driver stops: it holds its joints where they are, or switches their torque off."""


@dataclass(frozen=True, eq=False, slots=True)
class Setpoint:
    """What a driver writes to its joints at one tick, in the order of its ``joint_names``.

    ``modes`` has the mode of each joint, of those that the driver takes; "position" for all if left out.

    - "position": ``positions`` [rad] or [m], (n,), are at most one tick's motion from those before, and
      ``velocities`` per second, (n,), are the rates at which they move, for devices that take them as
      feed-forward.
    - "velocity": ``velocities`` are to be kept until the next setpoint, or for a watchdog's time.
    - "effort": ``efforts`` [Nm] or [N], (n,), are to be applied; zero for other joints.

    A joint in another mode than "position" is expected at its ``positions``, which are not to be written.
    ``stamp`` [ns] is the present instant of the system clock.
    """

    stamp: int
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    efforts: NDArray[np.float64] | None = None
    modes: tuple[Mode, ...] = ()

    def __post_init__(self) -> None:
        if not self.modes:
            object.__setattr__(self, "modes", ("position",) * len(self.positions))


class Driver(Protocol):
    """Interface of programs that own hardware; a ``DriverHost`` calls all methods from one thread.

    ``joint_names`` are the joints that the driver owns, all or a part of those of its robot, and the order of
    all numbers. ``modes`` are those of the setpoints that it takes: with one, all setpoints have that mode;
    with several, each joint may be in any of them, and changes it between two setpoints. A device in mode
    "velocity" or "effort" moves on when its program has died: let it stop by a watchdog of its own.
    """

    @property
    def joint_names(self) -> tuple[str, ...]: ...

    @property
    def modes(self) -> frozenset[Mode]: ...

    def open(self) -> None:
        """Connect to the hardware, which must not move by that."""
        ...

    def enable(self, on: bool) -> None:
        """Switch power and brakes: on before the first ``write``, off before ``close``."""
        ...

    def read(self, stamp: int) -> JointReading | None:
        """The joints at ``stamp`` [ns], the present instant; None when there is nothing new.

        A reading with the stamp of the last one counts as nothing new, too.
        Blocks until the device has a new reading if the device sets the pace of its host (``rate_hz=None``),
        or until some milliseconds have passed without one. Raises any exception for a reading that cannot be
        used, which the host counts.
        """
        ...

    def write(self, setpoint: Setpoint) -> None:
        """Send a setpoint to the hardware. Raises any exception if that fails, which the host counts."""
        ...

    def stop(self, how: StopMode) -> None:
        """Stop now. May be called at any time after ``open``, and more than once.

        Raises any exception if the joints may still move: the host calls it again until it succeeds.
        """
        ...

    def close(self) -> None:
        """Disconnect from the hardware. A second call does nothing."""
        ...


class Calibration:
    """The affine map between the counts of encoders and the positions of joints.

    ``position = sign * 2 pi * (counts - zero) / (counts_per_revolution * ratio)`` [rad], where the encoder is
    on the motor's side of a gear: ``ratio`` revolutions of the motor are one of the joint. ``zero`` are the
    counts at position 0, ``sign`` is 1, or -1 where the counts fall as the position rises. For a linear joint
    give ``travel`` instead of 2 pi: the way [m] of one revolution at the output of the gear. Each is one
    number for all joints or one for each. Raises InvalidInput for any that no encoder can have.
    """

    def __init__(
        self,
        counts_per_revolution: ArrayLike,
        zero: ArrayLike = 0.0,
        sign: ArrayLike = 1.0,
        ratio: ArrayLike = 1.0,
        *,
        travel: ArrayLike = math.tau,
    ) -> None:
        resolution = _factors(counts_per_revolution, "counts_per_revolution")
        gear, way = _factors(ratio, "ratio"), _factors(travel, "travel")
        signs = real_numbers(sign, "sign")
        if not np.isin(signs, (-1.0, 1.0)).all():
            raise InvalidInput(f"sign is 1 or -1 for each joint, not {sign!r}")
        self._zero = real_numbers(zero, "zero")
        if not np.isfinite(self._zero).all():
            raise InvalidInput(f"zero is a finite number of counts for each joint, not {zero!r}")
        try:
            shape = np.broadcast_shapes(*(part.shape for part in (resolution, gear, way, signs, self._zero)))
        except ValueError:
            shape = (0, 0)
        if len(shape) > 1:
            raise InvalidInput(
                "a calibration has one number for all joints, or one for each; got shapes "
                f"{resolution.shape}, {self._zero.shape}, {signs.shape}, {gear.shape}, {way.shape} of "
                "counts_per_revolution, zero, sign, ratio, travel"
            )
        self._scale: NDArray[np.float64] = signs * way / (resolution * gear)
        """Position per count, signed."""

    def to_positions(self, counts: Sequence[int] | ArrayLike) -> NDArray[np.float64]:
        """The positions [rad] or [m] at ``counts``: (n,)."""
        return (np.asarray(counts, dtype=np.float64) - self._zero) * self._scale

    def to_velocities(self, rates: ArrayLike) -> NDArray[np.float64]:
        """The velocities, per second, at ``rates`` [counts per second]: (n,)."""
        return np.asarray(rates, dtype=np.float64) * self._scale

    def to_counts(self, positions: ArrayLike) -> NDArray[np.int64]:
        """The nearest counts at ``positions`` [rad] or [m]: (n,). Raises InvalidInput unless finite."""
        counts = np.asarray(positions, dtype=np.float64) / self._scale + self._zero
        if not np.isfinite(counts).all():
            raise InvalidInput(f"positions to convert to counts must be finite, not {positions!r}")
        return np.rint(counts).astype(np.int64)


def _factors(values: ArrayLike, what: str) -> NDArray[np.float64]:
    factors = real_numbers(values, what)
    if not (np.isfinite(factors) & (factors > 0.0)).all():
        raise InvalidInput(f"{what} is positive and finite for each joint, not {values!r}")
    return factors
