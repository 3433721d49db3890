"""An independent reference: rigid motions in decimals of 50 digits, times as fractions.

Written with matrices and power series, unlike the code under test. Every input is a float, used at its
exact value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Decimal, getcontext
from fractions import Fraction

import numpy as np

getcontext().prec = 50

Matrix = list[list[Decimal]]
ZERO, ONE = Decimal(0), Decimal(1)
TINY = Decimal(10) ** -45


def exact(value: float | Fraction) -> Decimal:
    if isinstance(value, Fraction):
        return Decimal(value.numerator) / Decimal(value.denominator)
    return Decimal(value)


def sin_cos(angle: Decimal) -> tuple[Decimal, Decimal]:
    """Power series of a small fraction of the angle, then angle doubling."""
    doublings = 0
    while abs(angle) > Decimal("0.1"):
        angle /= 2
        doublings += 1
    sine, cosine, term, n = ZERO, ZERO, ONE, 0
    while abs(term) > TINY:
        cosine += term if n % 4 == 0 else -term if n % 4 == 2 else 0
        sine += term if n % 4 == 1 else -term if n % 4 == 3 else 0
        n += 1
        term = term * angle / n
    for _ in range(doublings):
        sine, cosine = 2 * sine * cosine, cosine * cosine - sine * sine
    return sine, cosine


def arc_tangent(value: Decimal) -> Decimal:
    """For values >= 0: halved until the power series is short."""
    factor = 1
    while value > Decimal("0.05"):
        value = value / (1 + (1 + value * value).sqrt())
        factor *= 2
    total, term, n = ZERO, value, 1
    while abs(term) > TINY:
        total += term / n
        term = -term * value * value
        n += 2
    return total * factor


def unit(numbers: Sequence[float]) -> list[Decimal]:
    values = [exact(number) for number in numbers]
    norm = sum(value * value for value in values).sqrt()
    return [value / norm for value in values]


def slerp(first: Sequence[float], second: Sequence[float], ratio: Fraction) -> list[Decimal]:
    a, b = unit(first), unit(second)
    if sum(x * y for x, y in zip(a, b, strict=True)) < 0:
        b = [-y for y in b]
    apart = sum((x - y) ** 2 for x, y in zip(a, b, strict=True)).sqrt()
    together = sum((x + y) ** 2 for x, y in zip(a, b, strict=True)).sqrt()
    angle = 2 * arc_tangent(apart / together)
    if angle < TINY:
        return a
    r = exact(ratio)
    whole, begin, end = (sin_cos(part)[0] for part in (angle, (1 - r) * angle, r * angle))
    return [(begin * x + end * y) / whole for x, y in zip(a, b, strict=True)]


def matrix(translation: Sequence[Decimal], q: Sequence[Decimal]) -> Matrix:
    x, y, z, w = q
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return [[*row, t] for row, t in zip(rows, translation, strict=True)] + [[ZERO, ZERO, ZERO, ONE]]


def pose_matrix(pose7: Sequence[float]) -> Matrix:
    return matrix([exact(value) for value in pose7[:3]], unit(pose7[3:]))


def multiply(a: Matrix, b: Matrix) -> Matrix:
    return [[sum((a[i][k] * b[k][j] for k in range(4)), ZERO) for j in range(4)] for i in range(4)]


def inverse(a: Matrix) -> Matrix:
    turned = [[a[j][i] for j in range(3)] for i in range(3)]
    moved = [-sum((turned[i][k] * a[k][3] for k in range(3)), ZERO) for i in range(3)]
    return [[*row, t] for row, t in zip(turned, moved, strict=True)] + [[ZERO, ZERO, ZERO, ONE]]


def as_floats(a: Matrix) -> np.ndarray:
    return np.array([[float(value) for value in row] for row in a])


def ratio_in(stamps: Sequence[int], stamp: int) -> tuple[int, int, Fraction]:
    """The neighbouring stamps of a covered instant, and its exact ratio between them."""
    before = max(other for other in stamps if other <= stamp)
    after = min(other for other in stamps if other >= stamp)
    return before, after, Fraction(stamp - before, max(1, after - before))


def pose_between(samples: Mapping[int, Sequence[float]], stamp: int) -> Matrix:
    """The pose of an edge at an instant that its samples cover."""
    before, after, ratio = ratio_in(sorted(samples), stamp)
    a, b = samples[before], samples[after]
    moved = [
        exact(Fraction(p) + ratio * (Fraction(q) - Fraction(p))) for p, q in zip(a[:3], b[:3], strict=True)
    ]
    return matrix(moved, slerp(a[3:], b[3:], ratio))


def turned(axis: Sequence[float], angle: Decimal) -> Matrix:
    """A rotation about an axis, by Rodrigues' formula."""
    x, y, z = unit(axis)
    sine, cosine = sin_cos(angle)
    hat = [[ZERO, -z, y], [z, ZERO, -x], [-y, x, ZERO]]
    rows: Matrix = [[ZERO] * 4 for _ in range(3)]
    for i in range(3):
        for j in range(3):
            square = sum((hat[i][k] * hat[k][j] for k in range(3)), ZERO)
            rows[i][j] = (ONE if i == j else ZERO) + sine * hat[i][j] + (1 - cosine) * square
    return [*rows, [ZERO, ZERO, ZERO, ONE]]


def moved(axis: Sequence[float], distance: Decimal) -> Matrix:
    """A translation along an axis."""
    return matrix([value * distance for value in unit(axis)], [ZERO, ZERO, ZERO, ONE])
