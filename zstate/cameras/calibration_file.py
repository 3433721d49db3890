"""The YAML file of a calibration, as camera_calibration of ROS writes it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, cast

from zstate.cameras.camera import Camera
from zstate.errors import InvalidInput

_MAX_BYTES = 8192  # libyaml's time grows with the square of nested brackets
_SIZE = ("image_width", "image_height")
_MATRICES = {
    "camera_matrix": (3, 3),
    "distortion_coefficients": (),
    "rectification_matrix": (3, 3),
    "projection_matrix": (3, 4),
}


def load_camera(path: str | os.PathLike[str], frame: str = "camera", *, line_time_ns: int = 0) -> Camera:
    """The camera of a YAML file of camera_calibration, with ``frame`` and ``line_time_ns``, which it has not.

    Raises InvalidInput for a file that cannot be read, and with what is missing or is no calibration in it.
    """
    entries = _parsed(Path(path))
    missing = [name for name in (*_SIZE, "camera_matrix", "distortion_model") if name not in entries]
    if missing:
        raise InvalidInput(f"{path} is no calibration of a camera: {', '.join(missing)} missing")
    try:
        matrices = {name: _numbers(name, entries.get(name), shape) for name, shape in _MATRICES.items()}
        k, d, r, p = matrices.values()
        width, height = (entries[name] for name in _SIZE)
        model = entries["distortion_model"]
        return Camera(width, height, k or (), d or (), model, frame, line_time_ns, r, p)
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error}") from None


def _parsed(path: Path) -> dict[str, Any]:
    import yaml  # noqa: PLC0415 - loaded when it is needed

    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
        if len(data) > _MAX_BYTES:
            raise InvalidInput(f"{path} is no calibration of a camera: it has more than {_MAX_BYTES} bytes")
        entries: Any = yaml.safe_load(data)
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InvalidInput(f"{path} is no YAML: {error}") from None
    if not isinstance(entries, dict):
        raise InvalidInput(f"{path} is no calibration of a camera: it has no entries")
    return cast("dict[str, Any]", entries)


def _numbers(name: str, entry: Any, shape: tuple[int, ...]) -> list[Any] | None:
    """The rows of a matrix, the numbers of a vector with the shape (); None without an entry."""
    if entry is None:
        return None
    data: Any = cast("dict[str, Any]", entry).get("data") if isinstance(entry, dict) else None
    if not isinstance(data, list):
        raise InvalidInput(f"{name} has a list 'data'; got {entry!r}")
    numbers = cast("list[Any]", data)
    if not shape:
        return numbers
    rows, columns = shape
    if len(numbers) != rows * columns:
        raise InvalidInput(f"{name} has {rows * columns} numbers, not {len(numbers)}")
    return [numbers[row * columns : (row + 1) * columns] for row in range(rows)]
