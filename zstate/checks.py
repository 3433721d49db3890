"""Checks of arguments: frame names and arrays of real numbers, also of values that are copied.

numpy converts silently: it parses a string of digits, and drops the imaginary part of a complex number and
the mask of a masked array. A silent conversion of a pose is a wrong pose.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.errors import InvalidInput

Floats: TypeAlias = NDArray[np.float64]
Points: TypeAlias = NDArray[np.float32 | np.float64]
"""Points as rows x y z [m]: (N, 3)."""

QUATERNION_TOLERANCE = 1e-3
"""Quaternions whose length is this close to 1 are normalised, others refused; in _kernel/history.h, too."""

_FLOAT64 = np.dtype(np.float64)

_KINDS = {
    "b": "bool",
    "c": "complex numbers",
    "S": "text",
    "U": "text",
    "O": "objects",
    "M": "dates",
    "m": "durations",
}


def name_problem(name: object) -> str:
    """The reason why ``name`` cannot be a frame name; empty if it can."""
    if not isinstance(name, str):
        return f"a frame name is text; got {name!r} of type {type(name).__name__}"
    if not name:
        return "a frame name is empty"
    if name.startswith("/"):
        return f"the frame name {name!r} begins with a slash; write {name.lstrip('/')!r}"
    return ""


def check_names(*names: object) -> None:
    """Raises InvalidInput unless each name is a non-empty str without a leading slash."""
    for name in names:
        if problem := name_problem(name):
            raise InvalidInput(problem)


def real_numbers(values: ArrayLike, what: str) -> NDArray[np.float64]:
    """``values`` as an array of float64, of any shape.

    Raises InvalidInput for ragged lists and for arrays of anything but integers and floats: complex numbers,
    bool, text, objects, and masked arrays.
    """
    array: Any = values
    if type(array) is np.ndarray and array.dtype is _FLOAT64:
        return array  # in a quarter of the time: control loops check several vectors in each tick
    return np.asarray(_real_array(values, what), dtype=np.float64)


def _real_array(values: ArrayLike, what: str) -> NDArray[Any]:
    try:
        array: NDArray[Any] = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"{what} must be numbers: {error}") from None
    kind = array.dtype.kind
    if kind not in "fiu":
        raise InvalidInput(f"{what} must be real numbers, not {_KINDS.get(kind, str(array.dtype))}")
    if is_masked(values):
        raise InvalidInput(f"{what} must be a plain array; fill or leave out what this one masks")
    return array


def check_points(points: ArrayLike) -> Points:
    """Points as an array (N, 3), without a copy of one of float32 or float64; integers become float64.

    Raises InvalidInput for other shapes and types, and masked arrays.
    """
    array = _real_array(points, "points")
    if array.dtype.kind in "iu":
        array = array.astype(np.float64)
    if array.dtype.itemsize not in (4, 8):
        raise InvalidInput(
            f"points are float32 or float64, as is the result; got {array.dtype}: convert them with "
            ".astype(np.float32)"
        )
    if array.ndim != 2 or array.shape[1] != 3:
        raise InvalidInput(
            f"points have shape (N, 3), a row x y z [m] for each; got {array.shape}. One point is [point]; "
            "of more columns pass points[:, :3], of an image of points points.reshape(-1, 3)"
        )
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def reduced_to_fields(self: Any) -> tuple[Any, ...]:
    """``__reduce__`` of a dataclass whose constructor checks its fields and makes its arrays read-only."""
    return self.__class__, tuple(getattr(self, field.name) for field in fields(self))


def is_masked(values: object) -> bool:
    """Whether ``values`` is a masked array of numpy."""
    # Without importing numpy.ma, which takes 10 ms.
    return hasattr(values, "mask") and isinstance(values, np.ndarray)
