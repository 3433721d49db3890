"""What a user states of the noise of a source; it takes precedence over messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np

from zstate._util.format import did_you_mean
from zstate.checks import Floats
from zstate.errors import InvalidInput
from zstate.odometry.geodesy import check_geodetic
from zstate.odometry.health import GATE_PROBABILITY, check_gate

Sigma: TypeAlias = float | tuple[float, float, float]
"""Standard deviations of x, y and z; one number is that of each."""

FixSigma: TypeAlias = float | tuple[float, float]
"""Standard deviations of a fix, horizontal and vertical; of one number the vertical one is ten times."""

VELOCITY_AXES, POSE_AXES = ("x", "y", "z"), ("x", "y", "z", "roll", "pitch", "yaw")
"""The numbers of a velocity and of a pose; roll, pitch and yaw are a rotation about x, y and z."""

CovarianceKind: TypeAlias = Literal["stated", "dependent", "independent"]
"""What covariances of poses of another odometry are: of no use, of dead reckoning, or of each pose alone."""

HEIGHT_FACTOR = 10.0
"""How much less sure a height by satellites is than the position: all of them are above."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceNoise:
    """What may be stated of any source; ``VelocityNoise`` describes it.

    Raises InvalidInput for a delay of more than a minute, and for a gate that is not above 0.5 and below 1.
    """

    delay_s: float = 0.0
    gate: float = GATE_PROBABILITY

    def __post_init__(self) -> None:
        if not abs(self.delay_s) <= _LONGEST_DELAY_S:
            raise InvalidInput(
                f"delay_s is by how much stamps are late [s], at most {_LONGEST_DELAY_S:g}; got "
                f"{self.delay_s!r}"
            )
        check_gate(self.gate)

    @property
    def delay_ns(self) -> int:
        """By how much stamps are late [ns]."""
        return round(self.delay_s * 1e9)


_LONGEST_DELAY_S = 60.0


def axis_rows(kind: str, axes: Sequence[str], known: Sequence[str]) -> tuple[int, ...]:
    """The places of ``axes`` in ``known``, in its order. Raises InvalidInput, with near misses."""
    listed = ", ".join(known)
    for one in axes:
        if one not in known:
            raise InvalidInput(f"axes of a {kind} are {listed}, not {one!r}{did_you_mean(one, known)}")
    if not axes or len(set(axes)) < len(axes):
        given = ", ".join(axes) or "none"
        raise InvalidInput(f"axes of a {kind} are some of {listed}, each once; got {given}")
    return tuple(row for row, one in enumerate(known) if one in axes)


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityNoise(SourceNoise):
    """The noise of measured velocities; one setting for a sensor.

    ``sigma`` [m/s] are standard deviations in the axes of the measured frame; None if messages have them, as
    covariances. ``scale`` is the standard deviation of a constant relative error, as of a radius of wheels.
    ``axes`` are the numbers that are used, some of x, y and z of the measured frame.

    ``delay_s`` [s] is by how much its stamps are later than the IMU's, of one instant; it is subtracted.
    ``gate`` is the part of readings that pass if noise and estimate are as stated: one that contradicts the
    estimate by more is rejected. Raises InvalidInput unless all are finite, and sigmas above zero.
    """

    sigma: Sigma | None = None
    scale: float = 0.02
    axes: tuple[str, ...] = VELOCITY_AXES

    def __post_init__(self) -> None:
        SourceNoise.__post_init__(self)
        axis_rows("velocity", self.axes, VELOCITY_AXES)
        _check_sigma("sigma", self.sigma)
        if not 0.0 <= self.scale < math.inf:
            raise InvalidInput(f"the scale of a velocity is a part of it, 0 or more; got {self.scale!r}")

    @property
    def sigmas(self) -> tuple[float, ...] | None:
        """x y z [m/s]; None if messages have them."""
        return None if self.sigma is None else _three(self.sigma)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseNoise(SourceNoise):
    """The noise of measured poses; one setting for a sensor.

    ``sigma`` [m] are standard deviations of the position, ``sigma_deg`` [degrees] of the rotation about the
    axes of the frame in which poses are measured; both are None if messages have them, as covariances.
    ``axes`` are the numbers that are used, some of x, y, z, roll, pitch and yaw, along and about the same
    axes. ``delay_s`` and ``gate`` as of ``VelocityNoise``. Raises InvalidInput for one sigma without the
    other, and unless all are finite and above zero.
    """

    sigma: Sigma | None = None
    sigma_deg: Sigma | None = None
    axes: tuple[str, ...] = POSE_AXES

    def __post_init__(self) -> None:
        SourceNoise.__post_init__(self)
        axis_rows("pose", self.axes, POSE_AXES)
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
class HeadingNoise(SourceNoise):
    """The noise of headings, as of the orientation of an IMU with a compass; one setting for a sensor.

    ``sigma_deg`` [degrees] is that of errors that do not average out; None if messages have it, as a
    covariance. Raises InvalidInput unless it is finite and above zero.
    """

    sigma_deg: float | None = None

    def __post_init__(self) -> None:
        SourceNoise.__post_init__(self)
        _check_sigma("sigma_deg", self.sigma_deg)


_Three: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MagnetometerNoise(SourceNoise):
    """The noise and the calibration of a magnetometer.

    ``sigma_deg`` [degrees] is that of the yaw, by errors that do not average out. The field is ``soft_iron``
    (3, 3) times the measured one less ``bias`` [T], both in the axes of the sensor. ``place`` is a latitude
    and a longitude [degrees]: fields are then compared with that of the Earth there, not with the first ones.
    ``delay_s`` and ``gate`` as of ``VelocityNoise``. Raises InvalidInput unless the sigma is above zero, all
    are finite, and it is a place.
    """

    sigma_deg: float = 5.0
    bias: _Three = (0.0, 0.0, 0.0)
    soft_iron: tuple[_Three, _Three, _Three] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    place: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        SourceNoise.__post_init__(self)
        _check_sigma("sigma_deg", self.sigma_deg)
        for name, numbers in (("bias", self.bias), ("soft_iron", sum(self.soft_iron, ()))):
            if not all(map(math.isfinite, numbers)):
                raise InvalidInput(f"{name} of a magnetometer is finite; got {numbers!r}")
        if self.place is not None:
            check_geodetic(*self.place, 0.0)

    def calibrated(self, field: Floats) -> Floats:
        """The field of a measured one [T], (3,)."""
        return np.array(self.soft_iron).dot(field - np.array(self.bias))


@dataclass(frozen=True, slots=True, kw_only=True)
class FixNoise(SourceNoise):
    """The noise of the fixes of a satellite receiver.

    ``sigma`` [m] are standard deviations of a position; None if messages have them, as covariances. ``floor``
    [m] are the least that is believed: receivers with corrections (RTK) state millimetres. ``correlated_s``
    [s] is for how long the errors of fixes wander before they are others. ``delay_s`` and ``gate`` as of
    ``VelocityNoise``. Raises InvalidInput unless all are finite and above zero.
    """

    sigma: FixSigma | None = None
    floor: FixSigma = (0.02, 0.05)
    correlated_s: float = 20.0

    def __post_init__(self) -> None:
        SourceNoise.__post_init__(self)
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
class RelativeNoise(SourceNoise):
    """The noise of another odometry, of which only the motion between two poses counts; one for a source.

    Of a displacement, ``sigma`` [m per square root of a metre] and ``sigma_deg`` [degrees, likewise] are the
    standard deviations by its way; ``floor`` [m] and ``floor_deg`` [degrees] are those of each pose, also at
    rest.
    ``scale`` is that of the logarithm of a constant factor of its translations: 0.05 for stereo cameras, 0.5
    for an unknown device, 3 for one camera.

    ``covariance`` says what the covariances of its poses are: "stated", of no use, as those of most drivers,
    which send zeros or constants; "dependent", of dead reckoning, which only grow; "independent", of poses
    that are each measured, as by matching scans with a map. What they say is added to the floor, in place of
    the sigmas. ``delay_s`` and ``gate`` as of ``VelocityNoise``. Raises InvalidInput for anything else.
    """

    sigma: float = 0.05
    sigma_deg: float = 0.5
    floor: float = 0.005
    floor_deg: float = 0.1
    scale: float = 0.05
    covariance: CovarianceKind = "stated"

    def __post_init__(self) -> None:
        SourceNoise.__post_init__(self)
        for name in ("sigma", "sigma_deg", "floor", "floor_deg", "scale"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise InvalidInput(f"{name} of a relative source is above zero and finite; got {value!r}")
        if self.covariance not in get_args(CovarianceKind):
            raise InvalidInput(
                f"the covariance of a relative source is one of {', '.join(get_args(CovarianceKind))}; got "
                f"{self.covariance!r}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class BarometerNoise(SourceNoise):
    """The noise of the heights of a barometer, in air.

    ``sigma`` [m] is the standard deviation of each height; None if messages have it, as the variance of their
    pressures. ``wander`` [m] is that of an error that changes over ``correlated_s`` [s], by wind, doors and
    weather: raise it where hours of weather count. ``temperature_c`` is that of the air [degrees Celsius],
    which makes it denser: 3 degrees are 1 % of a height. ``delay_s`` and ``gate`` as of ``VelocityNoise``.
    Raises InvalidInput unless all are finite, sigmas and the time above zero, and the air above -100 degrees.
    """

    sigma: float | None = None
    wander: float = 4.0
    correlated_s: float = 300.0
    temperature_c: float = 15.0

    def __post_init__(self) -> None:
        SourceNoise.__post_init__(self)
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


SensorNoise: TypeAlias = (
    VelocityNoise | PoseNoise | RelativeNoise | HeadingNoise | MagnetometerNoise | FixNoise | BarometerNoise
)
"""What is stated of a sensor: the class says of which kind it is."""
