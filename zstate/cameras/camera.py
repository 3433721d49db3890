"""Camera: pixels of points, and rays of pixels, as OpenCV defines them.

A point x, y, z [m] in the frame of the camera (z forward, x right, y down) has the pixel::

    u = fx a + cx,  v = fy b + cy          the center of the first pixel is 0, 0

where a, b follow from the direction of the point by the model of the lens. With x' = x/z, y' = y/z and r^2 =
x'^2 + y'^2, ``plumb_bob`` (k1 k2 p1 p2 k3) and ``rational_polynomial`` (and k4 k5 k6) are::

    a = x' q + 2 p1 x' y' + p2 (r^2 + 2 x'^2)      q = (1 + k1 r^2 + k2 r^4 + k3 r^6)
    b = y' q + p1 (r^2 + 2 y'^2) + 2 p2 x' y'          / (1 + k4 r^2 + k5 r^4 + k6 r^6)

and ``equidistant`` (k1 k2 k3 k4), by the angle t between the point and the axis::

    (a, b) = (x, y) / sqrt(x^2 + y^2) * (t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9)

A polynomial is right as far as it was fitted. Where it stops growing with the angle it folds the picture: a
point beyond would get the pixel of another one, so it has none here.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any, get_args

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from zstate.cameras.messages import CameraInfo, CameraModel
from zstate.checks import check_names, check_points, real_numbers, reduced_to_fields
from zstate.errors import InvalidInput
from zstate.wire.keys import full_name
from zstate.wire.messages import from_block, to_block

import_module("zstate.buffer.projection")  # before a loop calls ``TransformBuffer.project``

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_TABLE_ANGLES = 512
_ITERATIONS = 20
_CONVERGED, _LEADS_BACK = 1e-12, 1e-10
"""Of a, b; with a focal length of 10,000 px that is 1e-8 and 1e-6 px."""
_NO_COEFFICIENT = 1e-40
_WIDEST_PINHOLE = math.radians(89.9)
_WIDEST_FISHEYE = math.pi


@dataclass(frozen=True, init=False, eq=False)
class Camera:
    """The calibration of a camera whose pictures have ``width`` x ``height`` [px].

    ``k`` is fx, fy, cx, cy [px], or the matrix (3, 3) that ROS and OpenCV have; ``d`` the numbers of the
    distortion ``model`` in the order of OpenCV, none without distortion. ``frame`` is that of the lens: z
    looks forward, x to the right and y down. A bare name is the robot's own. ``line_time_ns`` is the time
    between two rows of a rolling shutter, which are read from the first one on; 0 for a global shutter.
    ``r`` (3, 3) and ``p`` (3, 4), of a stereo camera, rectify its pictures; they are carried only.

    Raises InvalidInput if the values are no calibration.
    """

    width: int
    height: int
    k: Floats
    d: Floats
    model: CameraModel
    frame: str
    line_time_ns: int
    r: Floats | None
    p: Floats | None

    def __init__(  # noqa: PLR0917 - the order is that of its fields, for copies
        self,
        width: int,
        height: int,
        k: ArrayLike,
        d: ArrayLike = (),
        model: CameraModel = "plumb_bob",
        frame: str = "camera",
        line_time_ns: int = 0,
        r: ArrayLike | None = None,
        p: ArrayLike | None = None,
    ) -> None:
        check_names(frame)
        if model not in get_args(CameraModel):
            raise InvalidInput(f"the models of cameras are {', '.join(get_args(CameraModel))}, not {model!r}")
        fields = self.__dict__  # a frozen dataclass; only the constructor sets its fields
        fields["width"], fields["height"] = _size(width, "width"), _size(height, "height")
        fields["k"] = _intrinsics(k)
        fields["d"] = _read_only(real_numbers(d, "d").reshape(-1))
        fields["model"] = model
        fields["frame"] = frame
        fields["line_time_ns"] = _size(line_time_ns, "line_time_ns")
        fields["r"] = None if r is None else _matrix(r, "r", (3, 3))
        fields["p"] = None if p is None else _matrix(p, "p", (3, 4))
        camera_to_message(self, 0)  # which has the limits of all numbers
        if not self.k.any():
            raise InvalidInput("a camera has focal lengths above 0; all of k is zero: calibrate it first")

    __reduce__ = reduced_to_fields

    @property
    def matrix(self) -> Floats:
        """The matrix K of OpenCV and ROS: (3, 3)."""
        fx, fy, cx, cy = self.k
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, points: ArrayLike) -> tuple[Floats, Flags]:
        """The pixels u, v of ``points`` in its frame, (N, 3) x y z [m]: (N, 2), and which are valid: (N,).

        The pixels of points that the lens does not see are NaN and not valid: those behind it, beyond the
        angle at which its model folds, and rows that are not finite. Valid pixels may lie outside of the
        picture, see ``contains``. Raises InvalidInput for other shapes.
        """
        directions = check_points(points).astype(np.float64, copy=False)
        bent, valid = self._lens.distorted(directions)
        valid &= np.isfinite(directions).all(axis=1)
        pixels = bent * self.k[:2] + self.k[2:]
        pixels[~valid] = np.nan
        return pixels, valid

    def ray(self, pixels: ArrayLike) -> Floats:
        """The directions of ``pixels`` u, v: unit vectors in its frame, (N, 3), or (3,) for one pixel (2,).

        Those of pixels that no direction has are NaN. Raises InvalidInput for other shapes.
        """
        numbers = real_numbers(pixels, "pixels")
        if numbers.shape[-1:] != (2,) or numbers.ndim > 2:
            raise InvalidInput(f"pixels are rows u v: (N, 2), or one (2,); got shape {numbers.shape}")
        bent = (numbers.reshape(-1, 2) - self.k[2:]) / self.k[:2]
        rays = self._lens.rays(bent)
        return rays[0] if numbers.ndim == 1 else rays

    def contains(self, pixels: ArrayLike) -> Flags:
        """Which of ``pixels`` (N, 2) lie in the picture: (N,)."""
        u, v = np.moveaxis(real_numbers(pixels, "pixels"), -1, 0)
        return (u >= -0.5) & (u < self.width - 0.5) & (v >= -0.5) & (v < self.height - 0.5)

    @cached_property
    def _lens(self) -> _Pinhole | _Fisheye:
        return (_Fisheye if self.model == "equidistant" else _Pinhole)(self.d)


def camera_to_message(camera: Camera, stamp: int) -> CameraInfo:
    """The message of a calibration, not numbered yet; ``stamp`` [ns] is when it began to hold."""
    return CameraInfo(
        stamp,
        0,
        0,
        camera.frame,
        camera.width,
        camera.height,
        camera.model,
        to_block(camera.k),
        to_block(camera.d),
        camera.line_time_ns,
        None if camera.r is None else to_block(camera.r),
        None if camera.p is None else to_block(camera.p),
    )


def camera_from_message(message: CameraInfo, robot: str) -> Camera:
    """The camera of ``robot`` in ``message``; its frame has the full name.

    Raises InvalidInput if it is not calibrated.
    """
    return Camera(
        message.width,
        message.height,
        from_block(message.k),
        from_block(message.d),
        message.model,
        full_name(robot, message.frame),
        message.line_time_ns,
        None if message.r is None else from_block(message.r).reshape(3, 3),
        None if message.p is None else from_block(message.p).reshape(3, 4),
    )


class _Pinhole:
    """``plumb_bob`` and ``rational_polynomial``, on x', y' of points before the camera."""

    def __init__(self, d: Floats) -> None:
        k1, k2, p1, p2, k3, k4, k5, k6 = [*d.tolist(), *[0.0] * (8 - len(d))]
        self._tangential = p1, p2
        # Of s = r^2; ``radius`` is r q, and grows while the numerator of its derivative is positive.
        self._above, self._below = Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])
        s = Polynomial([0.0, 1.0])
        slope = (self._above + 2 * s * self._above.deriv()) * self._below
        slope = slope - 2 * s * self._above * self._below.deriv()
        limit = min(_first_root(slope), _first_root(self._below))
        self._limit = min(limit, math.tan(_WIDEST_PINHOLE) ** 2)
        radii = np.tan(np.linspace(0.0, math.atan(math.sqrt(self._limit)), _TABLE_ANGLES))
        self._table = radii, radii * self._factor(radii**2)

    def _factor(self, s: Floats) -> Floats:
        return _values(self._above, s) / _values(self._below, s)

    def distorted(self, directions: Floats) -> tuple[Floats, Flags]:
        with np.errstate(all="ignore"):  # rows that are not valid
            flat = directions[:, :2] / directions[:, 2:]
            s = (flat * flat).sum(axis=1)
            bent = self._bent(flat, s)
        return bent, (directions[:, 2] > 0.0) & (s <= self._limit)

    def _bent(self, flat: Floats, s: Floats) -> Floats:
        p1, p2 = self._tangential
        x, y = flat.T
        q, cross = self._factor(s), 2.0 * x * y
        a = x * q + p1 * cross + p2 * (s + 2.0 * x * x)
        b = y * q + p1 * (s + 2.0 * y * y) + p2 * cross
        return np.stack((a, b), axis=1)

    def _jacobian(self, flat: Floats, s: Floats) -> Floats:
        """d(a, b) / d(x', y'): (N, 2, 2)."""
        p1, p2 = self._tangential
        x, y = flat.T
        above, below = _values(self._above, s), _values(self._below, s)
        slope_above, slope_below = _values(self._above.deriv(), s), _values(self._below.deriv(), s)
        q = above / below
        slope = (slope_above * below - above * slope_below) / below**2  # dq / ds
        mixed = 2.0 * x * y * slope + 2.0 * (p1 * x + p2 * y)
        aa = q + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        bb = q + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        return np.stack((aa, mixed, mixed, bb), axis=1).reshape(-1, 2, 2)

    def rays(self, bent: Floats) -> Floats:
        """Unit vectors: Newton's method, from the radius without the tangential part."""
        with np.errstate(all="ignore"):  # pixels without a ray diverge
            radius: Floats = np.hypot(bent[:, 0], bent[:, 1])
            start: Floats = np.interp(radius, self._table[1], self._table[0])
            flat: Floats = bent * (start / np.where(radius > 0.0, radius, 1.0))[:, np.newaxis]
            for _ in range(_ITERATIONS):
                s: Floats = np.sum(flat * flat, axis=1)
                error = self._bent(flat, s) - bent
                if not (np.abs(error) >= _CONVERGED).any():  # NaN has no ray, and does not delay others
                    break
                (aa, ab), (ba, bb) = np.moveaxis(self._jacobian(flat, s), 0, -1)
                step = np.stack((bb * error[:, 0] - ab * error[:, 1], aa * error[:, 1] - ba * error[:, 0]))
                flat = flat - (step / (aa * bb - ab * ba)).T
            rays = np.column_stack((flat, np.ones(len(flat))))
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            return _rays_of(self.distorted(rays), bent, rays)


class _Fisheye:
    """``equidistant``, on the angle from the axis, which may be more than a right one."""

    def __init__(self, d: Floats) -> None:
        k1, k2, k3, k4 = d.tolist() or [0.0] * 4
        self._radius = Polynomial([0.0, 1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4])
        self._slope = self._radius.deriv()
        self._limit = min(_first_root(self._slope), _WIDEST_FISHEYE)
        angles = np.linspace(0.0, self._limit, _TABLE_ANGLES)
        self._table = angles, _values(self._radius, angles)

    def distorted(self, directions: Floats) -> tuple[Floats, Flags]:
        across = np.hypot(directions[:, 0], directions[:, 1])
        angles = np.arctan2(across, directions[:, 2])
        valid = (angles <= self._limit) & directions.any(axis=1)
        valid &= (across > 0.0) | (directions[:, 2] > 0.0)  # right behind, each way is the shortest
        with np.errstate(all="ignore"):
            scale = np.where(across > 0.0, _values(self._radius, angles) / across, 0.0)
            bent = directions[:, :2] * scale[:, np.newaxis]
        return bent, valid

    def rays(self, bent: Floats) -> Floats:
        radius = np.hypot(bent[:, 0], bent[:, 1])
        angles = np.interp(radius, self._table[1], self._table[0])
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                error = _values(self._radius, angles) - radius
                if not (np.abs(error) >= _CONVERGED).any():
                    break
                angles = angles - error / _values(self._slope, angles)
            across = bent * (np.sin(angles) / np.where(radius > 0.0, radius, 1.0))[:, np.newaxis]
            rays = np.column_stack((across, np.cos(angles)))
        return _rays_of(self.distorted(rays), bent, rays)


def _rays_of(projected: tuple[Floats, Flags], bent: Floats, rays: Floats) -> Floats:
    """``rays``, NaN where they do not lead back to ``bent``."""
    again, valid = projected
    with np.errstate(invalid="ignore"):
        found = valid & (np.abs(again - bent).max(axis=1, initial=0.0) < _LEADS_BACK)
    rays[~found] = np.nan
    return rays


def _values(polynomial: Polynomial, at: Floats) -> Floats:
    return np.asarray(polynomial(at), np.float64)


def _first_root(polynomial: Polynomial) -> float:
    """The smallest positive real root; infinity if there is none."""
    roots: Any = polynomial.trim(_NO_COEFFICIENT).roots()  # which divides by the last one
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1.0)].real
    return float(min(real[real > 0.0], default=math.inf))


def _size(value: Any, name: str) -> int:
    try:
        return operator.index(value)
    except TypeError:
        raise InvalidInput(f"{name} of a camera is an integer; got {value!r}") from None


def _intrinsics(k: ArrayLike) -> Floats:
    numbers = real_numbers(k, "k")
    if numbers.shape == (3, 3):
        (fx, skew, cx), (zero, fy, cy), last = numbers
        if skew or zero or last.tolist() != [0.0, 0.0, 1.0]:
            raise InvalidInput(f"k is [fx 0 cx; 0 fy cy; 0 0 1] as in OpenCV; got {numbers.tolist()}")
        numbers = np.array([fx, fy, cx, cy])
    return _matrix(numbers, "k", (4,))


def _matrix(values: ArrayLike, name: str, shape: tuple[int, ...]) -> Floats:
    numbers = real_numbers(values, name)
    if numbers.shape != shape:
        raise InvalidInput(f"{name} of a camera has the shape {shape}; got {numbers.shape}")
    return _read_only(numbers)


def _read_only(numbers: Floats) -> Floats:
    copy = numbers.copy()
    copy.flags.writeable = False
    return copy
