"""CameraListener: the newest picture of each camera of a robot."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack
from dataclasses import dataclass

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.format import SECOND_NS
from zstate._util.inbox import Inbox
from zstate._util.refusals import Refusals
from zstate.cameras.camera import Camera, camera_from_message
from zstate.cameras.codecs import Pixels, VideoDecoder, decode_still
from zstate.cameras.messages import CameraInfo, CompressedImage
from zstate.cameras.pictures import PictureFormat
from zstate.clock import Clock, SystemClock
from zstate.errors import InvalidInput, LibraryMissing, MessageError
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.wire.keys import ANY, check_robot, check_writer, full_name, shortened
from zstate.wire.registry import get_wire

_MAX_CAMERAS = 64


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of the camera ``name``: ``data`` as it was sent, in ``format``.

    ``stamp`` [ns] is the instant of its first row, ``frame`` the full name of the camera's frame, ``camera``
    its calibration, None if that is not known, or is for pictures of another size. ``size`` is its width and
    height [px].
    """

    name: str
    stamp: int
    frame: str
    format: PictureFormat
    data: bytes
    size: tuple[int, int]
    camera: Camera | None
    _pixels: Pixels | None = None

    def decode(self) -> Pixels:
        """Its pixels: uint8, RGB (H, W, 3).

        Raises MessageError for a JPEG or PNG whose pixels are broken, and LibraryMissing.
        """
        return decode_still(self.data, self.format) if self._pixels is None else self._pixels

    def __repr__(self) -> str:
        width, height = self.size
        return f"<Picture of {self.name!r}: {width} x {height} {self.format}>"


class CameraListener(Closeable):
    """Receives the pictures of a robot's cameras. The newest wins: unread older ones are skipped.

    ``latest`` is the newest picture of all cameras, ``pictures`` has that of each by name. ``for picture in
    listener`` and ``async for picture in listener`` return each camera's newest picture once, and end with
    ``close()``; ``skipped`` counts those that a newer one has replaced unread.

    A message that is no whole picture leaves the last one in place; ``outdated`` then has the name of the
    camera, until the next good one. ``refused`` counts such messages by reason ("truncated", "too large",
    "foreign", ...), and the first of each reason is logged. The packets of a video are decoded as they
    arrive, each being needed for the next: "no key frame" counts those before the first key frame, or after
    a loss. That needs ``pip install 'zstate[cameras]'``, as ``Picture.decode`` does.

    ``camera`` selects one camera of the robot, "*": all of them. A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        camera: str = ANY,
        *,
        wire: str = "native",
        clock: Clock | None = None,
    ) -> None:
        self.robot = check_robot(robot)
        self.camera = camera if camera == ANY else check_writer(camera)
        self.pictures: dict[str, Picture] = {}
        self.latest: Picture | None = None
        self.outdated: set[str] = set()
        self.cameras: dict[str, Camera] = {}
        """The calibrations by the names of the cameras."""
        self.skipped = 0
        self._refusals = Refusals("picture")
        self.refused: dict[str, int] = self._refusals.counts
        self._clock: Clock = clock or SystemClock()
        self._videos: dict[str, VideoDecoder] = {}
        self._lock = fork_safe_lock()
        self._unread: set[str] = set()
        self._arrived: Inbox[str] = Inbox(_MAX_CAMERAS, session.check)
        self._wire = get_wire(wire)
        with ExitStack() as opening:
            opening.enter_context(
                subscribe(
                    session,
                    self._wire,
                    robot,
                    "camera_info",
                    self._on_cameras,
                    name=self.camera,
                    on_error=self._refusals.count,
                    on_withdrawn=lambda key: self.cameras.pop(self._name(key), None),
                )
            )
            opening.enter_context(
                subscribe(
                    session,
                    self._wire,
                    robot,
                    "image",
                    self._on_pictures,
                    name=self.camera,
                    on_error=self._refusals.count,
                    on_refused=self._on_refused,
                )
            )
            for announcement in announce_reader(session, self._wire, robot, ("image", "camera_info")):
                opening.enter_context(announcement)
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        return f"<CameraListener of {self.robot!r}: {len(self.pictures)} cameras>"

    def __len__(self) -> int:
        """How many cameras have an unread picture."""
        return len(self._unread)

    @property
    def age_s(self) -> float | None:
        """The time since the stamp of ``latest`` [s], by the clock; None if there is none."""
        return None if self.latest is None else (self._clock.now() - self.latest.stamp) / SECOND_NS

    def _name(self, key: str) -> str:
        return self._wire.edge_writer_name(key) or "image"

    def _on_cameras(self, received: list[Received]) -> None:
        for robot, key, message in received:
            assert isinstance(message, CameraInfo)
            name = self._name(key)
            if not message.is_calibrated:
                self.cameras.pop(name, None)
                continue
            try:
                self.cameras[name] = camera_from_message(message, robot)
            except InvalidInput as error:
                self._refusals.count("malformed", f"{shortened(key)}: {error}")

    def _on_refused(self, key: str) -> None:
        try:
            name = self._name(key)
        except InvalidInput:  # a key without a name
            return
        self.outdated.update({name} & self.pictures.keys())
        if name in self._videos:
            self._videos[name].skip()

    def _on_pictures(self, received: list[Received]) -> None:
        for robot, key, message in received:
            name = self._name(key)
            assert isinstance(message, CompressedImage)
            try:
                self._add(self._picture(robot, name, message))
            except (MessageError, InvalidInput, LibraryMissing) as error:
                self.outdated.update({name} & self.pictures.keys())
                self._refusals.count(_reason(error), f"{shortened(key)}: {error}")

    def _picture(self, robot: str, name: str, message: CompressedImage) -> Picture:
        pixels, size = None, message.size
        if size is None:
            pixels = self._decoded(name, message)
            size = pixels.shape[1], pixels.shape[0]
        camera = self.cameras.get(name)
        if camera is not None and (camera.width, camera.height) != size:
            known = f"a calibration for {camera.width} x {camera.height}"
            text = f"{name!r}: pictures of {size[0]} x {size[1]}, {known}"
            self._refusals.count("calibration of another size", text)
            camera = None
        frame = full_name(robot, message.frame)
        return Picture(name, message.stamp, frame, message.format, message.data, size, camera, pixels)

    def _decoded(self, name: str, message: CompressedImage) -> Pixels:
        video = self._videos.get(name)
        if video is None or video.form != message.format:
            if len(self._videos) >= _MAX_CAMERAS:
                raise InvalidInput(f"the robot {self.robot!r} has more than {_MAX_CAMERAS} videos")
            video = self._videos[name] = VideoDecoder(message.format)
        return video.decode(message.data, (message.session, message.seq))

    def _add(self, picture: Picture) -> None:
        name = picture.name
        if name not in self.pictures and len(self.pictures) >= _MAX_CAMERAS:
            raise InvalidInput(f"the robot {self.robot!r} has more than {_MAX_CAMERAS} cameras")
        with self._lock:
            self.pictures[name] = self.latest = picture
            self.outdated.discard(name)
            is_unread = name in self._unread
            self._unread.add(name)
            self.skipped += is_unread
        if not is_unread:
            self._arrived.add([name])

    def _read(self, name: str) -> Picture:
        with self._lock:
            self._unread.discard(name)
            return self.pictures[name]

    def __iter__(self) -> Iterator[Picture]:
        return map(self._read, self._arrived)

    async def __aiter__(self) -> AsyncIterator[Picture]:
        async for name in self._arrived:
            yield self._read(name)

    def close(self) -> None:
        """Stop listening; iterations end. A second call does nothing."""
        self._opened.close()
        self._arrived.close()


def _reason(error: Exception) -> str:
    if isinstance(error, LibraryMissing):
        return "no decoder"
    return error.reason if isinstance(error, MessageError) else "malformed"
