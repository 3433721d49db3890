"""Pictures of a camera of this computer, or of a video file, by PyAV."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from zstate._util.closeable import Closeable
from zstate.cameras.codecs import Pixels, pyav
from zstate.errors import InvalidInput

_SILENT_S = 5.0
_WITH_JPEG = {"input_format": "mjpeg"}


class SourcePicture(NamedTuple):
    """A picture: a JPEG as it was, or the pixels of another; ``at_s`` [s] after the first one of its file."""

    at_s: float
    picture: bytes | Pixels


class VideoSource(Closeable):
    """The pictures of ``path``, a device of v4l2 if ``is_device``, else a video file.

    The JPEGs of a camera or of a file are passed on as they are; other pictures are decoded. ``size`` is
    their width and height [px], and ``codec`` what they are, "mjpeg" or FFmpeg's name of another.

    Raises InvalidInput if there is no such file or device, or no video in it, and LibraryMissing.
    """

    def __init__(self, path: str, *, is_device: bool = False) -> None:
        self.path = path
        self.is_device = is_device
        self._av = pyav()
        self._container = self._open()
        if not self._container.streams.video:
            self._container.close()
            raise InvalidInput(f"{path} has no video, only {self._container.format.long_name}")
        self._stream: Any = self._container.streams.video[0]
        context = self._stream.codec_context
        self.size: tuple[int, int] = context.width, context.height
        self.codec: str = context.name

    def _open(self) -> Any:
        if not self.is_device:
            return self._opened()
        try:  # compressed, if the camera can: decoding and encoding cost most of a core
            return self._opened(format="v4l2", options=_WITH_JPEG, timeout=_SILENT_S)
        except InvalidInput:
            return self._opened(format="v4l2", timeout=_SILENT_S)

    def _opened(self, **options: Any) -> Any:
        try:
            return self._av.open(self.path, **options)
        except (OSError, ValueError) as error:  # FFmpeg's errors are these
            raise InvalidInput(self._cannot_open(error)) from None

    def _cannot_open(self, error: Exception) -> str:
        code = getattr(error, "errno", None)
        if code == errno.ENOENT and self.is_device:
            devices = ", ".join(sorted(map(str, Path("/dev").glob("video*")))) or "none"
            return f"there is no {self.path}; cameras of this computer: {devices}"
        reasons = {
            errno.ENOENT: "there is no such file",
            errno.EACCES: "this user may not read it; for a camera join the group 'video'",
            errno.EBUSY: "another program uses it",
        }
        kind = "a camera of v4l2" if self.is_device else "a video"
        return f"{self.path} cannot be opened as {kind}: {reasons.get(code or 0, str(error))}"

    def pictures(self) -> Iterator[SourcePicture]:
        """Its pictures, to the end of a file; one that is cut off ends with its last whole picture.

        Raises OSError if a camera sends no more: it was unplugged, or is silent.
        """
        is_jpeg = self.codec == "mjpeg"
        first: float | None = None
        try:
            for packet in self._container.demux(self._stream):
                if is_jpeg and packet.size:
                    found = [(packet.pts, bytes(packet))]
                elif is_jpeg:
                    continue  # the end
                else:
                    found = [(frame.pts, frame.to_ndarray(format="rgb24")) for frame in packet.decode()]
                for pts, picture in found:
                    at_s = float((pts or 0) * self._stream.time_base)
                    first = at_s if first is None else first
                    yield SourcePicture(at_s - first, picture)
        except (OSError, ValueError) as error:
            if self.is_device:
                raise OSError(f"{self.path} sends no more pictures ({error}): is it plugged in?") from None
        if self.is_device:
            raise OSError(f"{self.path} sends no more pictures: is it plugged in?")

    def rewind(self) -> None:
        """Begin a file again."""
        self._container.seek(0)

    def close(self) -> None:
        """Close the file or the device. A second call does nothing."""
        self._container.close()
