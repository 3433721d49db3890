"""What the header of a picture says; simplejpeg and PyAV make the pictures."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
import simplejpeg
from helpers.pictures import jpeg, png, video
from hypothesis import given
from hypothesis import strategies as st

from zstate.cameras.pictures import check_picture, format_of, is_key_frame, picture_size
from zstate.errors import MessageError


def reason(data: bytes, form: str) -> str:
    with pytest.raises(MessageError) as caught:
        check_picture(data, form)
    return caught.value.reason


def png_of(width: int, height: int, body: bytes = b"") -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", body), (b"IEND", b""))
    parts = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(("form", "make"), [("jpeg", jpeg), ("png", png)])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (64, 48), (301, 7)])
def test_the_size_is_that_of_the_picture(form: str, make, width: int, height: int):
    data = make(width, height)
    assert format_of(data) == form
    check_picture(data, form)
    assert picture_size(data, form) == (width, height)


def test_a_png_of_100_kb_and_30000_x_30000_pixels_is_refused_by_its_header():
    bomb = png_of(30_000, 30_000, bytes(100_000))
    with pytest.raises(MessageError, match=r"30000 x 30000 .* 64000000 pixels") as caught:
        check_picture(bomb, "png")
    assert caught.value.reason == "too large"


def test_a_jpeg_of_65000_x_65000_pixels_is_refused_by_its_header():
    data = bytearray(jpeg(64, 48))
    place = data.index(b"\xff\xc0") + 5
    data[place : place + 4] = struct.pack(">HH", 65_000, 65_000)
    assert reason(bytes(data), "jpeg") == "too large"


def test_a_picture_without_pixels_is_malformed():
    assert reason(png_of(0, 10), "png") == "malformed"


@pytest.mark.parametrize(("form", "make"), [("jpeg", jpeg), ("png", png)])
def test_a_picture_cut_off_at_any_byte_is_refused(form: str, make):
    data = make(64, 48)
    for end in range(8, len(data)):
        assert reason(data[:end], form) == "truncated", end


def test_a_jpeg_with_zeros_behind_it_is_whole_as_those_of_webcams_are():
    data = jpeg(64, 48) + bytes(100)
    check_picture(data, "jpeg")


def test_a_cut_off_jpeg_with_a_whole_one_in_its_header_is_truncated():
    inner, outer = jpeg(8, 8), jpeg(64, 48)
    thumbnail = b"\xff\xe1" + struct.pack(">H", len(inner) + 2) + inner
    data = outer[:2] + thumbnail + outer[2:]
    check_picture(data, "jpeg")
    assert picture_size(data, "jpeg") == (64, 48)
    assert reason(data[:-2], "jpeg") == "truncated"


@pytest.mark.parametrize("form", ["jpeg", "png", "h264", "h265"])
def test_bytes_of_another_format_are_refused(form: str):
    others = {"jpeg": jpeg(8, 8), "png": png(8, 8), "h264": video(1)[0]}
    for kind, data in others.items():
        if kind[0] != form[0]:
            assert reason(data, form) == "foreign"
    assert reason(b"", form) == "foreign"


@given(st.binary(max_size=200), st.sampled_from(["jpeg", "png"]))
def test_any_bytes_are_a_picture_or_refused(data: bytes, form: str):
    for start in (b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"):
        try:
            check_picture(start + data, form)
        except MessageError as error:
            assert error.reason in {"foreign", "truncated", "malformed", "too large"}


@pytest.mark.parametrize("form", ["h264", "h265"])
def test_key_frames_are_those_that_the_encoder_made(form: str):
    packets = video(7, form, key_every=3)
    assert [is_key_frame(packet, form) for packet in packets] == [True, False, False] * 2 + [True]


def test_every_still_picture_is_a_key_frame():
    assert is_key_frame(jpeg(8, 8), "jpeg")


def test_the_size_of_a_gray_jpeg_is_read_as_well():
    data = simplejpeg.encode_jpeg(np.zeros((9, 5, 1), np.uint8), colorspace="GRAY", colorsubsampling="Gray")
    assert picture_size(data, "jpeg") == (5, 9)
