"""Odometry against a reference, such as motion capture or RTK: ATE, the error at the end, and NEES.

The frame of the reference is not that of the odometry. For the absolute trajectory error (ATE) the path is
shifted and turned in the plane so that its mean square error is least (Umeyama, PAMI 13 (1991), without
scale). For errors in sigmas, shift and turn are those that are most likely by the covariances of both: the
normalised estimation error squared (NEES) of x and y then has a mean of 2 if they are right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate._util.format import did_you_mean
from zstate.checks import Floats
from zstate.errors import InvalidInput
from zstate.odometry.messages import Odometry, Pose
from zstate.odometry.source_noise import PoseNoise
from zstate.wire.keys import check_writer
from zstate.wire.measurements import covariance_matrix
from zstate.wire.messages import from_block

_LEAST_READINGS = 3
_ITERATIONS = 20
REFERENCE_STREAMS = ("pose", "odometry")


@dataclass(frozen=True, slots=True)
class ReferenceName:
    """A stream of a recording, and the standard deviation of its x and y [m]; None if messages have it."""

    stream: str
    sensor: str
    sigma: float | None = None

    def __str__(self) -> str:
        return f"{self.stream}/{self.sensor}"


def parse_reference(text: str) -> ReferenceName:
    """``pose/SENSOR[:sigma=M]`` or ``odometry/WRITER[:sigma=M]``. Raises InvalidInput."""
    name, colon, stated = text.partition(":")
    stream, slash, sensor = name.partition("/")
    if stream not in REFERENCE_STREAMS or not slash:
        raise InvalidInput(
            f"a reference is pose/SENSOR or odometry/WRITER, not {name!r}; `zstate info RECORDING` lists both"
            f"{did_you_mean(stream, REFERENCE_STREAMS)}"
        )
    key, _, value = stated.partition("=")
    if not colon:
        return ReferenceName(stream, check_writer(sensor))
    try:
        sigma = float(value)
    except ValueError:
        sigma = math.nan
    if key != "sigma" or math.isnan(sigma):
        raise InvalidInput(f"{stated!r} is not sigma=METRES; write {name}:sigma=0.02")
    PoseNoise(sigma=sigma, sigma_deg=1.0)  # checks it
    return ReferenceName(stream, check_writer(sensor), sigma)


class PlanarTrajectory(NamedTuple):
    """Positions in a plane: stamps [ns] (n,), x y [m] (n, 2), and covariances (n, 2, 2), None if unknown."""

    stamps: NDArray[np.int64]
    positions: Floats
    covariances: Floats | None


def reference_trajectory(name: ReferenceName, messages: Sequence[Pose | Odometry]) -> PlanarTrajectory:
    """The positions of a reference; without covariances if some are zero or not known, and no sigma is."""
    noise = np.array([_covariance(one) for one in messages])
    if name.sigma is not None:
        noise[:] = np.eye(2) * name.sigma**2
    is_known = bool((np.diagonal(noise, axis1=1, axis2=2) > 0.0).all())
    blocks = [one.pose if isinstance(one, Pose) else one.poses for one in messages]
    return PlanarTrajectory(
        np.array([one.stamp for one in messages], dtype=np.int64),
        np.array([from_block(block)[:2] for block in blocks]),
        noise if is_known else None,
    )


def _covariance(message: Pose | Odometry) -> Floats:
    """That of x and y, (2, 2); NaN if it is not known."""
    triangle = message.covariance if isinstance(message, Pose) else message.covariances
    return np.full((2, 2), math.nan) if triangle is None else covariance_matrix(triangle)[:2, :2]


@dataclass(frozen=True)
class Comparison:
    """Odometry against the ``count`` readings of a reference.

    ``positions`` are those of the reference, x y [m], moved into the frame of the odometry: (n, 2). ``ate_m``
    is the root of the mean square error, ``end_m`` the error at the last reading; ``end_sigmas`` and ``nees``
    are None if the noise of the reference is not known.
    """

    name: str
    positions: Floats
    ate_m: float
    end_m: float
    end_sigmas: float | None
    nees: float | None

    @property
    def count(self) -> int:
        """How many readings were compared."""
        return len(self.positions)


def compared(name: str, odometry: PlanarTrajectory, reference: PlanarTrajectory) -> Comparison:
    """The comparison at the readings of the reference while there is odometry.

    Raises InvalidInput for less than three of them.
    """
    stamps, truth, noise = reference
    inside = (stamps >= odometry.stamps[0]) & (stamps <= odometry.stamps[-1])
    if np.count_nonzero(inside) < _LEAST_READINGS:
        raise InvalidInput(
            f"{name} has {np.count_nonzero(inside)} readings while there is odometry; 3 or more are needed"
        )
    stamps, truth = stamps[inside], truth[inside]
    origin = odometry.stamps[0]
    seconds: Floats = (stamps - origin) * 1e-9
    known_s: Floats = (odometry.stamps - origin) * 1e-9
    path = np.empty_like(truth)
    for axis in (0, 1):
        path[:, axis] = np.interp(seconds, known_s, odometry.positions[:, axis])
    x, y, yaw = _aligned(path, truth)
    errors = truth - _moved(path, x, y, yaw)
    end_sigmas = nees = None
    if noise is not None:
        assert odometry.covariances is not None
        places = np.searchsorted(odometry.stamps, stamps)
        likely, squares = _most_likely(path, truth, odometry.covariances[places], noise[inside], (x, y, yaw))
        end_m = float(np.hypot(*(truth - _moved(path, *likely))[-1]))
        end_sigmas, nees = math.sqrt(squares[-1]), float(squares.mean())
    else:
        end_m = float(np.hypot(*errors[-1]))
    in_odom = (truth - (x, y)) @ _rotation(yaw)
    return Comparison(name, in_odom, math.sqrt(float((errors**2).sum(1).mean())), end_m, end_sigmas, nees)


def _aligned(path: Floats, truth: Floats) -> tuple[float, float, float]:
    """x, y and yaw of the frame of ``path`` in that of ``truth`` by least squares."""
    middle, other = path.mean(0), truth.mean(0)
    a, b = path - middle, truth - other
    yaw = math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
    shift: Floats = other - _rotation(yaw) @ middle
    return float(shift[0]), float(shift[1]), yaw


def _most_likely(
    path: Floats, truth: Floats, claimed: Floats, noise: Floats, start: tuple[float, float, float]
) -> tuple[tuple[float, float, float], Floats]:
    """The most likely x, y and yaw by Gauss and Newton, and the squared error in sigmas of each reading."""
    x, y, yaw = start
    squares = np.zeros(len(path))
    for _ in range(_ITERATIONS):
        turn = _rotation(yaw)
        errors = truth - _moved(path, x, y, yaw)
        weights = np.linalg.inv(turn @ claimed @ turn.T + noise)
        squares = np.einsum("ni,nij,nj->n", errors, weights, errors)
        turned = path @ turn.T
        jacobian = np.zeros((len(path), 2, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -turned[:, 1], turned[:, 0]
        weighted = np.swapaxes(jacobian, 1, 2) @ weights
        # A robot that stood still has no yaw: the pseudo-inverse leaves it.
        information: Floats = (weighted @ jacobian).sum(0)
        gradient: Floats = (weighted @ errors[:, :, None]).sum(0)[:, 0]
        by_x, by_y, by_yaw = np.linalg.pinv(information).dot(gradient).tolist()
        x, y, yaw = x + by_x, y + by_y, yaw + by_yaw
        if max(abs(by_x), abs(by_y), abs(by_yaw)) < 1e-9:
            break
    return (x, y, yaw), squares


def _rotation(yaw: float) -> Floats:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array(((cosine, -sine), (sine, cosine)))


def _moved(path: Floats, x: float, y: float, yaw: float) -> Floats:
    return path @ _rotation(yaw).T + (x, y)
