"""The yaw rate of wheels compared with that of the gyro: what each says about the other.

Wheels slip, and their radii differ, so that they are no measure of a turn. But a gyro that is mirrored, or
frozen, or mounted about another axis, a track that is wrong, and a bias that has changed all show in the
rates of both over some seconds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

_WHEEL_TURN = 0.03
"""[rad/s] The yaw rates of wheels and gyro are on a line but for so much, or the wheels slip."""
_STRAIGHT = 0.004
"""[rad/s] And by so much for ever: radii differ."""
COMPARED_S, _COMPARED_RATE, COMPARED_SCALE = 10.0, 0.08, 1.6
"""The yaw rates of wheels and gyro are compared for so long, if above it [rad/s], up to this factor."""
_SCALE = 0.5 * (COMPARED_SCALE - 1.0)
"""The standard deviation of that factor, as long as no turn shows it."""
LEAST_S = 5.0
"""They are compared from so many seconds on."""


class Turning(NamedTuple):
    """The yaw rates by wheels and by the gyro less its bias, in motion: means of the last 10 s.

    They are those of both, of their squares, and of their product. ``time_s`` is how long there was motion.
    ``noise`` [rad^2/s^2] is the variance of the gyro's noise in a comparison, and ``density`` [rad^2/s] its
    squared density.
    """

    time_s: float = 0.0
    wheels: float = 0.0
    gyro: float = 0.0
    wheels_square: float = 0.0
    gyro_square: float = 0.0
    product: float = 0.0
    noise: float = 0.0
    density: float = 0.0


class Difference(NamedTuple):
    """By what constant the yaw rate of wheels exceeds that of the gyro: ``apart``, with ``sigma`` [rad/s].

    ``noise`` is the part of that standard deviation that a longer drive, or another one, lessens.
    """

    apart: float
    sigma: float
    noise: float


def turned(before: Turning, rate: float, gyro: float, noise: float, dt_s: float) -> Turning:
    """The comparison with one reading more: the mean rates by wheels and gyro [rad/s] of the last ``dt_s``.

    ``noise`` is the variance of that of the gyro.
    """
    time_s = before.time_s + dt_s
    share = dt_s / min(time_s, COMPARED_S)
    now = (rate, gyro, rate * rate, gyro * gyro - noise, rate * gyro, noise, noise * dt_s)
    return Turning(time_s, *(old + share * (new - old) for old, new in zip(before[1:], now, strict=True)))


def constant_difference(turning: Turning) -> Difference | None:
    """By what constant the yaw rate of wheels exceeds that of the gyro.

    That is the regression of one on the other, with a scale if they turn enough to show it. Rates that do not
    follow a line, as those of wheels that slip, or that have another scale, say nothing: None.

    In a steady turn a constant and a scale look alike, so the difference is as uncertain as the scale. The
    noise of the gyro is as large as stated if it is white; that of vibration, whose integral is bounded, is
    smaller. The scale is between those by both.
    """
    if turning.time_s < LEAST_S:
        return None
    spread = turning.gyro_square - turning.gyro**2
    both = turning.product - turning.gyro * turning.wheels
    shows_scale = spread > _WHEEL_TURN**2
    scale = both / spread if shows_scale else 1.0
    rest = turning.wheels_square - turning.wheels**2 - scale * (2.0 * both - scale * spread)
    if not 1.0 / COMPARED_SCALE < scale < COMPARED_SCALE or rest > _WHEEL_TURN**2:
        return None
    # A straight drive shows the constant whatever the scale is; one of both rates is then that constant.
    lever, unsure = 0.0, _SCALE * min(abs(turning.wheels), abs(turning.gyro))
    if shows_scale:
        lever = turning.gyro**2 / spread
        unsure = scale * turning.noise / (spread + turning.noise) * turning.gyro
    variance = (max(0.0, rest) + scale * scale * turning.density) * (1.0 + lever)
    variance = variance / min(turning.time_s, COMPARED_S) + unsure * unsure
    sigma = math.sqrt(variance + _STRAIGHT**2)
    return Difference(turning.wheels - scale * turning.gyro, sigma, math.sqrt(variance))


def disagreement(turning: Turning) -> str:
    """A sentence on the yaw rates of wheels and gyro if they contradict each other; else empty."""
    wheels, gyro = math.sqrt(turning.wheels_square), math.sqrt(max(0.0, turning.gyro_square))
    if turning.time_s < LEAST_S or max(wheels, gyro) < _COMPARED_RATE:
        return ""
    alike = turning.product / max(wheels * gyro, _COMPARED_RATE**2)
    if alike < -0.5:
        cause = "in opposite directions: the mount of the IMU is mirrored, or left and right are swapped"
    elif gyro < 0.2 * wheels:
        cause = (
            "so the gyro does not turn with the base (frozen, or mounted about another axis), or wheels slip"
        )
    elif alike < 0.5 and max(wheels, gyro) > 2.0 * _COMPARED_RATE:
        cause = "at different times: one of them is wrong"
    elif alike > 0.5 and not 1.0 / COMPARED_SCALE < wheels / gyro < COMPARED_SCALE:
        cause = f"so the track is about {wheels / gyro:.2g} times as wide, or the wheels slip"
    else:
        return ""
    return f"the wheels turn the base by {wheels:.2g} rad/s and the gyro by {gyro:.2g} (rms of 10 s), {cause}"
