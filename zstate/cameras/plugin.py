"""What cameras bring: the streams of pictures and of calibrations; and a command."""

from zstate.plugins import Command, Plugin
from zstate.streams import MEGABYTE, Stream

_MESSAGES = "zstate.cameras.messages"

IMAGE = Stream(
    "image",
    f"{_MESSAGES}:CompressedImage",
    summary="pictures of a camera, compressed",
    named=True,
    bulk=True,
    private=True,
    max_bytes=16 * MEGABYTE,
    start="start one: `zstate camera {robot} --device /dev/video0`",
    ros="zstate.cameras.ros2:IMAGE_STREAM",
    document="zstate.cameras.documents:image_document",
)
CAMERA_INFO = Stream(
    "camera_info",
    f"{_MESSAGES}:CameraInfo",
    summary="the calibration of a camera",
    named=True,
    latched=True,
    start="start one: `zstate camera {robot} --device /dev/video0`",
    ros="zstate.cameras.ros2:CAMERA_INFO_STREAM",
    document="zstate.cameras.documents:camera_info_document",
)

PLUGIN = Plugin(
    "cameras",
    streams=(IMAGE, CAMERA_INFO),
    commands={
        "camera": Command(
            "zstate.cameras.cli.camera:camera_command",
            "Write",
            "Publish the pictures of a camera, a video file or a simulated camera.",
        ),
    },
    synonyms={
        "usb_cam": "camera ROBOT --device /dev/video0",
        "v4l2_camera": "camera ROBOT --device /dev/video0",
        "webcam": "camera ROBOT --device /dev/video0",
    },
)
