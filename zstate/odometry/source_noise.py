"""What a user states of the noise of a source; it takes precedence over messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

from zstate.errors import InvalidInput

Sigma: TypeAlias = float | tuple[float, float, float]
"""Standard deviations of x, y and z; one number is that of each."""

FixSigma: TypeAlias = float | tuple[float, float]
"""Standard deviations of a fix, horizontal and vertical; of one number the vertical one is ten times."""


HEIGHT_FACTOR = 10.0
"""Of a height by satellites, all of which are above: it is less sure than the position."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityNoise:
    """The noise of measured velocities; one setting for a sensor.

    ``sigma`` [m/s] are standard deviations in the axes of the measured frame; None if messages have them, as
    covariances. ``scale`` is the standard deviation of a constant relative error, as of a radius of wheels.
    Raises InvalidInput unless all are finite, and sigmas above zero.
    """

    sigma: Sigma | None = None
    scale: float = 0.02

    def __post_init__(self) -> None:
        _check_sigma("sigma", self.sigma)
        if not 0.0 <= self.scale < math.inf:
            raise InvalidInput(f"the scale of a velocity is a part of it, 0 or more; got {self.scale!r}")

    @property
    def sigmas(self) -> tuple[float, ...] | None:
        """x y z [m/s]; None if messages have them."""
        return None if self.sigma is None else _three(self.sigma)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseNoise:
    """The noise of measured poses; one setting for a sensor.

    ``sigma`` [m] are standard deviations of the position, ``sigma_deg`` [degrees] of the rotation about the
    axes of the frame in which poses are measured; both are None if messages have them, as covariances. Raises
    InvalidInput for one without the other, and unless all are finite and above zero.
    """

    sigma: Sigma | None = None
    sigma_deg: Sigma | None = None

    def __post_init__(self) -> None:
        _check_sigma("sigma", self.sigma)
        _check_sigma("sigma_deg", self.sigma_deg)
        if (self.sigma is None) != (self.sigma_deg is None):
            raise InvalidInput(
                "a pose has both, sigma [m] and sigma_deg [degrees]; give the other one as well"
            )

    @property
    def sigmas(self) -> tuple[float, ...] | None:
        """x y z [m] and the rotation about them [rad]; None if messages have them."""
        if self.sigma is None or self.sigma_deg is None:
            return None
        return (*_three(self.sigma), *map(math.radians, _three(self.sigma_deg)))


def _three(sigma: Sigma) -> tuple[float, float, float]:
    return sigma if isinstance(sigma, tuple) else (sigma, sigma, sigma)


def _check_sigma(name: str, sigma: Sigma | None) -> None:
    if sigma is not None and not all(0.0 < value < math.inf for value in _three(sigma)):
        raise InvalidInput(
            f"{name} is a standard deviation above zero, or three for x, y and z; got {sigma!r}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadingNoise:
    """The noise of headings, as of the orientation of an IMU with a compass; one setting for a sensor.

    ``sigma_deg`` [degrees] is that of errors that do not average out; None if messages have it, as a
    covariance. Raises InvalidInput unless it is finite and above zero.
    """

    sigma_deg: float | None = None

    def __post_init__(self) -> None:
        _check_sigma("sigma_deg", self.sigma_deg)


@dataclass(frozen=True, slots=True, kw_only=True)
class FixNoise:
    """The noise of the fixes of a satellite receiver.

    ``sigma`` [m] are standard deviations of a position; None if messages have them, as covariances. ``floor``
    [m] are the least that is believed: receivers with corrections (RTK) state millimetres. ``correlated_s``
    [s] is for how long the errors of fixes wander before they are others. Raises InvalidInput unless all are
    finite and above zero.
    """

    sigma: FixSigma | None = None
    floor: FixSigma = (0.02, 0.05)
    correlated_s: float = 20.0

    def __post_init__(self) -> None:
        given = {"sigma": self.sigma, "floor": self.floor, "correlated_s": self.correlated_s}
        for name, values in given.items():
            if values is not None and not all(0.0 < value < math.inf for value in _two(values)):
                raise InvalidInput(f"{name} of a satellite receiver is above zero and finite; got {values!r}")

    @property
    def sigmas(self) -> tuple[float, float] | None:
        """Horizontal and vertical [m]; None if messages have them."""
        return None if self.sigma is None else _two(self.sigma)

    @property
    def floors(self) -> tuple[float, float]:
        """Horizontal and vertical [m]."""
        return _two(self.floor)


def _two(sigma: FixSigma) -> tuple[float, float]:
    return sigma if isinstance(sigma, tuple) else (sigma, HEIGHT_FACTOR * sigma)


@dataclass(frozen=True, slots=True, kw_only=True)
class BarometerNoise:
    """The noise of the heights of a barometer, in air.

    ``sigma`` [m] is the standard deviation of each height; None if messages have it, as the variance of their
    pressures. ``wander`` [m] is that of an error that changes over ``correlated_s`` [s], by wind, doors and
    weather: raise it where hours of weather count. ``temperature_c`` is that of the air [degrees Celsius],
    which makes it denser: 3 degrees are 1 % of a height. Raises InvalidInput unless all are finite, sigmas
    and the time above zero, and the air above -100 degrees.
    """

    sigma: float | None = None
    wander: float = 4.0
    correlated_s: float = 300.0
    temperature_c: float = 15.0

    def __post_init__(self) -> None:
        given = {"sigma": self.sigma, "wander": self.wander, "correlated_s": self.correlated_s}
        for name, value in given.items():
            if value is not None and not 0.0 < value < math.inf:
                raise InvalidInput(f"{name} of a barometer is above zero and finite; got {value!r}")
        if not -100.0 < self.temperature_c < 100.0:
            raise InvalidInput(
                "the temperature of the air at a barometer is above -100 and below 100 degrees Celsius; got "
                f"{self.temperature_c!r}"
            )

    def height(self, pressure: float) -> float:
        """The height [m] of air of ``pressure`` [Pa] above that of 101325 Pa: only differences mean anything.

        The integral of dh = -dp / (rho g), with the density of an ideal gas, rho = p / (R T).
        """
        return -self._scale * math.log(pressure / 101325.0)

    def height_sigma(self, pressure: float, variance: float | None) -> float | None:
        """The standard deviation of a height [m]: the stated one, else by ``variance`` [Pa^2] if known."""
        if self.sigma is not None or not variance:
            return self.sigma
        return self._scale * math.sqrt(variance) / pressure

    @property
    def _scale(self) -> float:
        """R T / g [m], over which the pressure falls to 1 / e."""
        return _DRY_AIR * (self.temperature_c + 273.15) / 9.80665


_DRY_AIR = 287.05
"""[J/kg/K] The gas constant of dry air."""


SensorNoise: TypeAlias = VelocityNoise | PoseNoise | HeadingNoise | FixNoise | BarometerNoise
"""What is stated of a sensor: the class says of which kind it is."""
