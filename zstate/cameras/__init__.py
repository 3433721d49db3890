"""Cameras: pictures, calibrations, and where a point is in a picture."""

from typing import TYPE_CHECKING

from zstate._util.lazy_names import lazy_names

if TYPE_CHECKING:
    from zstate.cameras.calibration_file import load_camera
    from zstate.cameras.camera import Camera
    from zstate.cameras.listener import CameraListener, Picture
    from zstate.cameras.publishers import (
        CameraInfoPublisher,
        CameraPublisher,
        PictureSource,
        StampedPicture,
    )
    from zstate.cameras.ros_images import RosImage, RosImageListener
    from zstate.cameras.simulated_camera import SimulatedCamera
    from zstate.cameras.surfaces import Surface, floor_surface, robot_surfaces, wall_surface

__all__ = [
    "Camera",
    "CameraInfoPublisher",
    "CameraListener",
    "CameraPublisher",
    "Picture",
    "PictureSource",
    "RosImage",
    "RosImageListener",
    "SimulatedCamera",
    "StampedPicture",
    "Surface",
    "floor_surface",
    "load_camera",
    "robot_surfaces",
    "wall_surface",
]

_HOMES = {
    "Camera": "camera",
    "CameraInfoPublisher": "publishers",
    "CameraListener": "listener",
    "CameraPublisher": "publishers",
    "Picture": "listener",
    "PictureSource": "publishers",
    "RosImage": "ros_images",
    "RosImageListener": "ros_images",
    "SimulatedCamera": "simulated_camera",
    "StampedPicture": "publishers",
    "Surface": "surfaces",
    "floor_surface": "surfaces",
    "load_camera": "calibration_file",
    "robot_surfaces": "surfaces",
    "wall_surface": "surfaces",
}

if not TYPE_CHECKING:  # type checkers would take any name for one of the package
    __getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
