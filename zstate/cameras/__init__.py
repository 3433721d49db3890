"""Cameras: pictures, calibrations, and where a point is in a picture."""

from typing import TYPE_CHECKING

from zstate._util.lazy_names import lazy_names

if TYPE_CHECKING:
    from zstate.cameras.calibration_file import load_camera
    from zstate.cameras.camera import Camera
    from zstate.cameras.listener import CameraListener, Picture
    from zstate.cameras.publishers import CameraInfoPublisher, CameraPublisher

__all__ = [
    "Camera",
    "CameraInfoPublisher",
    "CameraListener",
    "CameraPublisher",
    "Picture",
    "load_camera",
]

_HOMES = {
    "Camera": "camera",
    "CameraInfoPublisher": "publishers",
    "CameraListener": "listener",
    "CameraPublisher": "publishers",
    "Picture": "listener",
    "load_camera": "calibration_file",
}

if not TYPE_CHECKING:  # type checkers would take any name for one of the package
    __getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
