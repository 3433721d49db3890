"""Pictures of cameras as they are drawn: still pictures as they came, and those of videos, decoded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, TypeAlias

from zstate.cameras.codecs import Pixels, VideoDecoder, to_jpeg
from zstate.cameras.messages import CompressedImage
from zstate.cameras.pictures import PictureFormat, is_key_frame, picture_size
from zstate.errors import LibraryMissing, MessageError
from zstate.wire.keys import full_name

StillFormat: TypeAlias = Literal["jpeg", "png"]

_QUALITY = 80


@dataclass(frozen=True, eq=False)
class Packet:
    """One picture of a camera, or one packet of its video; ``frame`` has the full name.

    ``number`` is the session of its writer, and the number in it: a packet of a video needs the one before.
    """

    stamp: int
    frame: str
    format: PictureFormat
    data: bytes
    number: tuple[int, int]

    @property
    def end_stamp(self) -> int:
        """That of the picture [ns]: its pose is that of its first row."""
        return self.stamp

    @property
    def nbytes(self) -> int:
        """The bytes of its data."""
        return len(self.data)

    @property
    def is_still(self) -> bool:
        """Whether it is no packet of a video."""
        return self.format in ("jpeg", "png")

    @cached_property
    def is_key(self) -> bool:
        """Whether it needs no packets before it."""
        return is_key_frame(self.data, self.format)


def packet_from_message(message: CompressedImage, robot: str) -> Packet:
    """The picture of ``robot`` in ``message``."""
    number = message.session, message.seq
    return Packet(message.stamp, full_name(robot, message.frame), message.format, message.data, number)


class StillPicture(NamedTuple):
    """A picture as a browser shows it, made of ``packet``; ``size`` is its width and height [px]."""

    packet: Packet
    format: StillFormat
    data: bytes
    size: tuple[int, int]


class PictureReader:
    """The newest picture of one camera, of the last packets of it.

    ``problem`` is why the newest packet is not shown, None if it is. To be used by one thread.
    """

    def __init__(self) -> None:
        self.problem: str | None = None
        self._newest: StillPicture | None = None
        self._decoder: VideoDecoder | None = None
        self._decoded: Packet | None = None

    def read(self, packets: Sequence[Packet]) -> StillPicture | None:
        """The picture of the last of ``packets``, the oldest first; of a video, the last that is whole.

        Each packet is decoded once while they advance, and none of those before the last key frame.
        """
        if packets and (self._newest is None or packets[-1] is not self._newest.packet):
            last = packets[-1]
            if last.is_still:
                self.problem = None
                size = picture_size(last.data, last.format) or (0, 0)
                self._newest = StillPicture(last, "png" if last.format == "png" else "jpeg", last.data, size)
            elif last is not self._decoded:
                self._read_video(packets)
        return self._newest

    def _read_video(self, packets: Sequence[Packet]) -> None:
        pixels: Pixels | None = None
        shown = packets[-1]
        try:
            for packet in self._undecoded(packets):
                try:
                    pixels, shown = self._decode(packet), packet
                    self.problem = None
                except MessageError as error:
                    self.problem = str(error)
            if pixels is not None:
                height, width = pixels.shape[:2]
                self._newest = StillPicture(shown, "jpeg", to_jpeg(pixels, _QUALITY), (width, height))
        except LibraryMissing as error:
            self.problem = str(error)

    def _undecoded(self, packets: Sequence[Packet]) -> Sequence[Packet]:
        """The packets that are needed for the last one, since the last decoded one or a key frame."""
        place = len(packets) - 1
        while place > 0 and not packets[place].is_key and packets[place - 1] is not self._decoded:
            place -= 1
        return packets[place:]

    def _decode(self, packet: Packet) -> Pixels:
        if self._decoder is None or self._decoder.form != packet.format:
            self._decoder = VideoDecoder(packet.format)
        self._decoded = packet
        return self._decoder.decode(packet.data, packet.number)
