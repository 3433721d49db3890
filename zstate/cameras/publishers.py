"""Publishers of the pictures of a camera, and of its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from numpy.typing import ArrayLike

from zstate.cameras.camera import Camera, camera_to_message
from zstate.cameras.codecs import check_pixels, to_jpeg
from zstate.cameras.messages import CompressedImage
from zstate.cameras.pictures import PictureFormat, format_of
from zstate.clock import Clock, SystemClock, check_stamp
from zstate.errors import InvalidInput, MessageError
from zstate.net.session import Session
from zstate.net.writer import write_all
from zstate.nodes.measurement_publisher import MeasurementPublisher
from zstate.nodes.robot_writer import RobotWriter
from zstate.nodes.static_publisher import ValuePublisher
from zstate.rate import RateReport
from zstate.stream_registry import stream_named
from zstate.wire.keys import check_writer, full_name
from zstate.wire.measurements import renumbered

_ENVELOPE_BYTES = 5_000
"""What a message has beside its picture, at most: names of 1024 characters of 4 bytes."""


class StampedPicture(NamedTuple):
    """A picture as ``CameraPublisher.publish`` takes it; ``stamp`` [ns] is the instant of its first row."""

    stamp: int
    picture: bytes | ArrayLike


class PictureSource(Protocol):
    """Interface of programs that take pictures: drivers of cameras, simulators."""

    def read(self, stamp: int) -> StampedPicture | None:
        """The newest picture at ``stamp`` [ns]; None when there is nothing new."""
        ...


class CameraPublisher(MeasurementPublisher):
    """Publishes the pictures of one camera of a robot and, latched, its calibration.

    ``name`` is the camera's, in ROS that of its namespace: /wrist/image_raw/compressed, /wrist/camera_info.
    ``camera`` is its calibration, if it is known. The frame of the pictures is that of ``camera``, else
    ``frame``, by default a frame of the camera's name; a bare name is the robot's own. Arrays are sent as
    JPEG of ``quality`` 1 to 100, which needs ``pip install 'zstate[cameras]'``.

    Under congestion pictures are dropped, and joining listeners receive none from the past. On the native
    wire each camera has one writer: SecondWriter, which names the first one, is raised if another writer
    publishes it, or by ``publish`` if both opened at once, which closes the later one. ``program`` is the
    script's name by default. A context manager; safe from any thread.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        name: str,
        camera: Camera | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        frame: str | None = None,
        quality: int = 80,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        own = name if camera is None else camera.frame
        self.frame = own if frame is None else frame
        if camera is not None and self.frame != camera.frame:
            raise InvalidInput(f"the camera has the frame {camera.frame!r}, its pictures {frame!r}; give one")
        if not 1 <= quality <= 100:
            raise InvalidInput(f"the quality of a JPEG is 1 to 100, not {quality!r}")
        full_name(robot, self.frame)  # raises here, where the mistake is made
        self.camera = camera
        self._quality = quality
        self._max_bytes = stream_named("image").max_bytes - _ENVELOPE_BYTES
        super().__init__(session, robot, "image", name, wires=wires, clock=clock, program=program)
        if camera is not None:
            with self._out.opening():
                info = CameraInfoPublisher(session, robot, name, camera, wires, program=program)
                self._out.opened.enter_context(info)

    def publish(
        self, picture: bytes | ArrayLike, stamp: int | None = None, *, format: PictureFormat | None = None
    ) -> None:
        """Publish one picture: the bytes of a JPEG or PNG, or an array: uint8, RGB (H, W, 3) or gray (H, W).

        ``stamp`` [ns] is the instant of its first row; default: now. ``format`` is "h264" or "h265" for a
        packet of a video, with exactly one picture, in the byte stream format (Annex B); key frames have
        their parameter sets, and there are no B-frames.

        Raises InvalidInput for what is no whole picture, is too large, or is of another size than the
        calibration; SecondWriter; and Closed. If it raises, nothing was sent.
        """
        with self._refusals:
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            is_encoded = isinstance(picture, bytes)
            data = picture if is_encoded else to_jpeg(check_pixels(picture), self._quality)
            form = format or format_of(data) or "jpeg"
            try:
                message = CompressedImage(stamp, 0, 0, self.frame, form, data)
            except MessageError as error:
                raise InvalidInput(str(error)) from None
            self._check(message)
            self._send(message)

    def run(
        self, source: PictureSource, rate_hz: float = 30.0, *, seconds: float | None = None
    ) -> RateReport:
        """Publish the pictures of ``source`` at exactly ``rate_hz``, for ``seconds`` or until ``close()``.

        Raises as ``publish``; late ticks are those of ``StatePublisher.run``.
        """

        def publish(picture: StampedPicture, _: int) -> None:
            self.publish(picture.picture, picture.stamp)

        return self._publish_at(rate_hz, seconds, source.read, publish)

    def _check(self, message: CompressedImage) -> None:
        if len(message.data) > self._max_bytes:
            raise InvalidInput(
                f"a picture of {len(message.data)} bytes, where {self._max_bytes} are allowed: choose a "
                "lower quality or a smaller size, or publish a video"
            )
        if (size := message.size) and self.camera and size != (self.camera.width, self.camera.height):
            raise InvalidInput(
                f"a picture of {size[0]} x {size[1]}, but the calibration is for {self.camera.width} x "
                f"{self.camera.height}: calibrate the camera at the size that it sends"
            )


class CameraInfoPublisher(ValuePublisher):
    """Publishes the calibration of one camera, latched: listeners that join later receive it as well.

    ``name`` is the camera's. For pictures that another program publishes; a ``CameraPublisher`` has its own.
    ``close()`` withdraws the calibration; the ROS wires cannot express that. SecondWriter is raised as there.
    A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        name: str,
        camera: Camera,
        wires: str | Sequence[str] = ("native",),
        *,
        program: str = "",
    ) -> None:
        full_name(robot, camera.frame)
        out = RobotWriter(session, robot, wires, program)
        out.title = f"the publisher of the camera {name!r}"
        super().__init__(out, "camera_info", check_writer(name))
        with out.opening():
            self.set(camera)

    def set(self, camera: Camera) -> None:
        """Replace the calibration. Raises Closed."""
        out = self._out
        with out.lock:
            out.check_open()
            message = camera_to_message(camera, SystemClock().now())
            write_all(self._latched, renumbered(message, out.seq, out.session_id))
            out.seq += 1
            self.camera = camera
