"""PictureReader: still pictures as they came, and those of videos, decoded once each."""

from __future__ import annotations

import io

import numpy as np
import pytest
from helpers.pictures import jpeg, png, video
from PIL import Image

from zstate.cameras.codecs import VideoDecoder
from zstate.view.pictures import Packet, PictureReader


def packets(datas: list[bytes], form, first: int = 0) -> list[Packet]:
    return [Packet(1000 * n, "r1/lens", form, data, (7, n)) for n, data in enumerate(datas, first)]


def brightness(picture) -> float:
    """Of the blue channel, which tells the pictures of a video apart."""
    return float(np.asarray(Image.open(io.BytesIO(picture.data)))[..., 2].mean())


@pytest.mark.parametrize("form, data", [("jpeg", jpeg(80, 40)), ("png", png(80, 40))])
def test_still_picture_is_shown_with_the_bytes_that_came(form, data):
    picture = PictureReader().read(packets([jpeg(), data], form))
    assert picture is not None
    assert (picture.format, picture.data is data, picture.size) == (form, True, (80, 40))


def test_picture_is_the_same_object_until_there_is_a_newer_one():
    reader, all_packets = PictureReader(), packets([jpeg(), jpeg()], "jpeg")
    first = reader.read(all_packets[:1])
    assert reader.read(all_packets[:1]) is first
    assert reader.read(all_packets) is not first


def test_packets_of_a_video_are_decoded_once_each(monkeypatch):
    decoded: list[bytes] = []
    decode = VideoDecoder.decode

    def counted_decode(decoder: VideoDecoder, packet: bytes, number: tuple[int, int]):
        decoded.append(packet)
        return decode(decoder, packet, number)

    monkeypatch.setattr(VideoDecoder, "decode", counted_decode)
    datas = video(10, key_every=5)
    reader, every = PictureReader(), packets(datas, "h264")
    for end in (3, 4, 4, 10):
        picture = reader.read(every[:end])
        assert picture is not None
        assert brightness(picture) == pytest.approx(20 * (end - 1), abs=6)
        assert reader.problem is None
    assert decoded == [*datas[:4], *datas[5:]]  # from the key frames on


def test_earlier_picture_of_a_video_is_decoded_from_its_key_frame():
    reader, every = PictureReader(), packets(video(10, key_every=5), "h264")
    reader.read(every)
    picture = reader.read(every[:3])
    assert picture is not None
    assert brightness(picture) == pytest.approx(40, abs=6)


def test_video_with_a_gap_keeps_its_last_picture_until_a_key_frame():
    reader, every = PictureReader(), packets(video(10, key_every=5), "h264")
    first = reader.read(every[:2])
    assert reader.read([*every[:2], every[3]]) is first
    assert reader.problem is not None
    assert "key frame" in reader.problem
    picture = reader.read([*every[:2], *every[3:7]])
    assert picture is not None
    assert brightness(picture) == pytest.approx(120, abs=6)
    assert reader.problem is None


def test_video_that_begins_without_a_key_frame_has_no_picture():
    reader = PictureReader()
    assert reader.read(packets(video(4), "h264")[1:]) is None
    assert reader.problem is not None
    assert reader.read([]) is None
