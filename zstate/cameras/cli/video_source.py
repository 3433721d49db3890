"""Pictures of a video file, or of a webcam by v4l2: PyAV reads both."""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from zstate._util.closeable import Closeable
from zstate.cameras.codecs import Pixels, pyav
from zstate.cameras.publishers import StampedPicture
from zstate.cli.processes import BackgroundCall
from zstate.clock import SystemClock
from zstate.errors import InvalidInput

T = TypeVar("T")

_SILENT_S = 5.0
_LAST_PICTURE_WITHIN_S = 0.3
_OLDEST_S = 1.0
"""Pictures that seem older, or from the future, have times of another clock than the monotonic one."""


class VideoSource(Closeable):
    """A video, whose JPEGs are passed on as they are; other pictures are decoded.

    ``size`` is its width and height [px], and ``codec`` "mjpeg" or FFmpeg's name of another.
    """

    def __init__(self, path: str, container: Any) -> None:
        self.path = path
        self._container = container
        if not container.streams.video:
            container.close()
            raise InvalidInput(f"{path} has no video, only {container.format.long_name}")
        self._stream: Any = container.streams.video[0]
        context = self._stream.codec_context
        self.size: tuple[int, int] = context.width, context.height
        self.codec: str = context.name

    def _read(self) -> Iterator[tuple[float, bytes | Pixels]]:
        """Its pictures, each with its time [s]. Raises OSError and ValueError, as FFmpeg's errors are."""
        is_jpeg = self.codec == "mjpeg"
        for packet in self._container.demux(self._stream):
            if not packet.size and (is_jpeg or packet.pts is not None):
                continue  # the end, or a picture that a webcam's driver knows to be broken
            if is_jpeg:
                found = [(packet.pts, bytes(packet))]
            else:
                found = [(frame.pts, frame.to_ndarray(format="rgb24")) for frame in packet.decode()]
            for pts, picture in found:
                yield float((pts or 0) * self._stream.time_base), picture

    def close(self) -> None:
        """Close the file or the device. A second call does nothing."""
        self._container.close()


class VideoFile(VideoSource):
    """The video in a file. Raises InvalidInput if there is none, and LibraryMissing."""

    def __init__(self, path: str) -> None:
        super().__init__(path, _opened(path))

    def pictures(self) -> Iterator[tuple[float, bytes | Pixels]]:
        """Its pictures, each with its time after the first [s]; a file that is cut off has its whole ones."""
        first: float | None = None
        with suppress(OSError, ValueError):
            for at_s, picture in self._read():
                first = at_s if first is None else first
                yield at_s - first, picture

    def rewind(self) -> None:
        """Begin again."""
        self._container.seek(0)


class Webcam(VideoSource):
    """A camera of this computer, ``path`` its device. It sends JPEGs if it can.

    FFmpeg waits for a picture without an end, and whatever signal comes: it does so in other threads.

    Raises InvalidInput if there is no camera, a silent one, or one that does not have pictures of ``size``
    [px] or ``rate_hz`` of them a second, and LibraryMissing.
    """

    def __init__(self, path: str, size: tuple[int, int] | None = None, rate_hz: float | None = None) -> None:
        wanted = {} if size is None else {"video_size": f"{size[0]}x{size[1]}"}
        wanted |= {} if rate_hz is None else {"framerate": f"{rate_hz:g}"}
        try:
            container = self._wait_for(partial(_opened_webcam, path, wanted))
        except TimeoutError as error:
            raise InvalidInput(f"{path} cannot be opened as a camera of v4l2: it has sent {error}") from None
        super().__init__(path, container)
        own_hz = float(self._stream.average_rate or 0)
        is_of_size = size in (None, self.size)
        if not is_of_size or not math.isclose(rate_hz or own_hz, own_hz, rel_tol=0.01):
            super().close()
            width, height = self.size
            raise InvalidInput(
                f"{path} has no such pictures, but {width} x {height} at {own_hz:g} Hz; its driver has sizes "
                "and rates of its own (v4l2-ctl --list-formats-ext, of Debian's v4l-utils, prints them)"
            )

    def pictures(self) -> Iterator[StampedPicture]:
        """Its pictures, with the stamps of its driver, or of their arrival if it has another clock.

        Raises OSError if it sends no more: it was unplugged, or is silent.
        """
        pictures, clock = self._read(), SystemClock()
        while True:
            try:
                found = self._wait_for(partial(next, pictures, None))
            except (OSError, ValueError) as error:
                raise OSError(f"{self.path} sends no more pictures ({error}): is it plugged in?") from None
            if found is None:
                raise OSError(f"{self.path} sends no more pictures: is it plugged in?")
            at_s, picture = found
            age_s = time.monotonic() - at_s
            age_ns = round(age_s * 1e9) if 0.0 <= age_s < _OLDEST_S else 0
            yield StampedPicture(clock.now() - age_ns, picture)

    def _wait_for(self, work: Callable[[], T]) -> T:
        """What ``work`` returns or raises; TimeoutError if the camera is silent."""
        self._last_call = BackgroundCall("zstate camera", work)
        if not self._last_call.wait(_SILENT_S):
            raise TimeoutError(f"nothing for {_SILENT_S:g} s")
        return self._last_call.result()

    def close(self) -> None:
        """Close the device; one that is silent is left to the end of the process, as FFmpeg waits for it."""
        if self._last_call.wait(_LAST_PICTURE_WITHIN_S):
            super().close()


def _opened_webcam(path: str, wanted: dict[str, str]) -> Any:
    try:  # compressed, if the camera can: decoding and encoding cost most of a core
        return _opened(path, format="v4l2", container_options=wanted | {"input_format": "mjpeg"})
    except InvalidInput:
        return _opened(path, format="v4l2", container_options=wanted)


def _opened(path: str, **options: Any) -> Any:
    try:
        return pyav().open(path, **options)
    except (OSError, ValueError) as error:  # FFmpeg's errors are these
        raise InvalidInput(_cannot_open(path, error, is_device="format" in options)) from None


def _cannot_open(path: str, error: Exception, *, is_device: bool) -> str:
    code = getattr(error, "errno", None)
    if code == errno.ENOENT and is_device:
        devices = ", ".join(sorted(map(str, Path("/dev").glob("video*")))) or "none"
        return f"there is no {path}; cameras of this computer: {devices}"
    reasons = {
        errno.ENOENT: "there is no such file",
        errno.EACCES: "this user may not read it; for a camera join the group 'video'",
        errno.EBUSY: "another program uses it",
    }
    kind = "a camera of v4l2" if is_device else "a video"
    return f"{path} cannot be opened as {kind}: {reasons.get(code or 0, str(error))}"
