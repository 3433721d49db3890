"""What cameras bring: the streams of pictures and of calibrations."""

from zstate.plugins import Plugin
from zstate.streams import MEGABYTE, Stream

_MESSAGES = "zstate.cameras.messages"

IMAGE = Stream(
    "image",
    f"{_MESSAGES}:CompressedImage",
    summary="pictures of a camera, compressed",
    named=True,
    bulk=True,
    max_bytes=16 * MEGABYTE,
    start="start the program of the camera, with its zstate.cameras.CameraPublisher",
    ros="zstate.cameras.ros2:IMAGE_STREAM",
    document="zstate.cameras.documents:image_document",
)
CAMERA_INFO = Stream(
    "camera_info",
    f"{_MESSAGES}:CameraInfo",
    summary="the calibration of a camera",
    named=True,
    latched=True,
    start="start the program of the camera, with its zstate.cameras.CameraPublisher",
    ros="zstate.cameras.ros2:CAMERA_INFO_STREAM",
    document="zstate.cameras.documents:camera_info_document",
)

PLUGIN = Plugin("cameras", streams=(IMAGE, CAMERA_INFO))
