"""CameraPublisher and CameraListener over the network."""

from __future__ import annotations

import asyncio
import sys
import threading

import numpy as np
import pytest
from helpers.pictures import jpeg, pixels, png, video
from helpers.processes import until
from helpers.tokens import current_tokens

from zstate.cameras import Camera, CameraInfoPublisher, CameraListener, CameraPublisher, Picture
from zstate.clock import ManualClock
from zstate.errors import Closed, InvalidInput, LibraryMissing, MessageError, SecondWriter
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.streams import MEGABYTE
from zstate.wire.keys import WRITER_TOKEN
from zstate.wire.native import encoding_of

MS = 1_000_000
SIZE = (64, 48)
K = (60.0, 60.0, 31.5, 23.5)


def camera(width: int = 64, height: int = 48, frame: str = "lens") -> Camera:
    return Camera(width, height, K, frame=frame)


def publish_one(publisher: CameraPublisher, listener: CameraListener, *args, **options) -> Picture:
    """Publishes until the listener has a picture: none is kept for late readers."""
    until(lambda: publisher.publish(*args, **options) or len(listener) > 0)
    return next(iter(listener))


def test_the_bytes_of_a_jpeg_arrive_as_they_were(sessions):
    writer, reader = sessions
    data = jpeg()
    with CameraListener(reader, "r1") as listener, CameraPublisher(writer, "r1", "wrist") as publisher:
        picture = publish_one(publisher, listener, data, 7 * MS)
    assert (picture.data, picture.format, picture.size) == (data, "jpeg", SIZE)
    assert (picture.name, picture.stamp, picture.frame, picture.camera) == ("wrist", 7 * MS, "r1/wrist", None)
    assert picture.decode().shape == (48, 64, 3)


@pytest.mark.parametrize("gray", [False, True])
def test_an_array_is_sent_as_a_jpeg(sessions, gray: bool):
    writer, reader = sessions
    array = pixels()[..., 0] if gray else pixels()
    with CameraListener(reader, "r1") as listener, CameraPublisher(writer, "r1", "wrist") as publisher:
        decoded = publish_one(publisher, listener, array).decode()
    expected = np.repeat(array[..., np.newaxis], 3, axis=2) if gray else array
    assert np.abs(decoded.astype(int) - expected).max() < 20


def test_a_png_is_decoded_exactly(sessions):
    writer, reader = sessions
    with CameraListener(reader, "r1") as listener, CameraPublisher(writer, "r1", "wrist") as publisher:
        picture = publish_one(publisher, listener, png())
    assert picture.format == "png"
    assert np.array_equal(picture.decode(), pixels())


def test_the_calibration_comes_with_the_pictures_also_to_late_listeners(sessions):
    writer, reader = sessions
    with CameraPublisher(writer, "r1", "wrist", camera()) as publisher, CameraListener(reader, "r1") as late:
        until(lambda: "wrist" in late.cameras)
        picture = publish_one(publisher, late, jpeg())
        assert picture.camera is not None
        assert (picture.frame, picture.camera.frame) == ("r1/lens", "r1/lens")
        assert np.array_equal(picture.camera.k, K)
        publisher.close()
        until(lambda: not late.cameras)


def test_a_calibration_for_pictures_of_another_size_is_not_used(sessions):
    writer, reader = sessions
    with (
        CameraInfoPublisher(writer, "r1", "wrist", camera(640, 480)),
        CameraPublisher(writer, "r1", "wrist") as publisher,
        CameraListener(reader, "r1") as listener,
    ):
        until(lambda: "wrist" in listener.cameras)
        assert publish_one(publisher, listener, jpeg()).camera is None
    assert set(listener.refused) == {"calibration of another size"}


def test_a_calibration_can_be_replaced(sessions):
    writer, reader = sessions
    with (
        CameraInfoPublisher(writer, "r1", "wrist", camera()) as info,
        CameraListener(reader, "r1") as listener,
    ):
        until(lambda: "wrist" in listener.cameras)
        info.set(camera(640, 480))
        until(lambda: listener.cameras["wrist"].width == 640)


def test_a_slow_reader_gets_the_newest_picture_of_each_camera_and_the_others_are_counted(sessions):
    writer, reader = sessions
    with (
        CameraListener(reader, "r1") as listener,
        CameraPublisher(writer, "r1", "left") as left,
        CameraPublisher(writer, "r1", "right") as right,
    ):
        publish_one(left, listener, jpeg())
        publish_one(right, listener, jpeg())
        for number in range(1, 6):
            left.publish(jpeg(brightness=number), number * MS)
        right.publish(jpeg(), 9 * MS)
        until(lambda: listener.latest.stamp == 9 * MS and listener.pictures["left"].stamp == 5 * MS)
        until(lambda: listener.skipped >= 4)
        read = [next(iter(listener)) for _ in range(2)]
        assert {(one.name, one.stamp) for one in read} == {("left", 5 * MS), ("right", 9 * MS)}
        assert len(listener) == 0


def test_tasks_read_pictures_as_well(sessions):
    writer, reader = sessions

    async def first() -> Picture:
        async for picture in listener:
            return picture
        raise AssertionError

    with CameraListener(reader, "r1") as listener, CameraPublisher(writer, "r1", "wrist") as publisher:
        until(lambda: publisher.publish(jpeg(), MS) or len(listener) > 0)
        assert asyncio.run(first()).stamp == MS


def test_iterations_end_with_the_listener(sessions):
    listener = CameraListener(sessions[1], "r1")
    read: list[Picture] = []
    thread = threading.Thread(target=lambda: read.extend(listener))
    thread.start()
    listener.close()
    thread.join(10.0)
    assert not thread.is_alive()
    assert read == []


def test_one_camera_can_be_selected(sessions):
    writer, reader = sessions
    with (
        CameraListener(reader, "r1", "left") as listener,
        CameraListener(reader, "r1") as everything,
        CameraPublisher(writer, "r1", "left") as left,
        CameraPublisher(writer, "r1", "right") as right,
    ):
        publish_one(right, everything, jpeg())
        publish_one(left, listener, jpeg())
        assert set(listener.pictures) == {"left"}


def test_the_age_is_the_time_since_the_stamp_by_the_clock_of_the_listener(sessions):
    writer, reader = sessions
    clock = ManualClock(5_000 * MS)
    with (
        CameraListener(reader, "r1", clock=clock) as listener,
        CameraPublisher(writer, "r1", "wrist") as publisher,
    ):
        assert listener.age_s is None
        publish_one(publisher, listener, jpeg(), 4_750 * MS)
        assert listener.age_s == 0.25
        clock.advance(1.0)
        assert listener.age_s == 1.25


@pytest.fixture
def raw_image(sessions):
    """Sends bytes as those of the message of a picture of the camera "wrist"."""
    from msgspec import msgpack

    from zstate.cameras.messages import CompressedImage

    key = KeyPublisher(sessions[0], "zstate/r1/image/wrist", encoding_of(CompressedImage))

    def send(data: bytes, form: str = "jpeg") -> None:
        key.put(msgpack.encode([MS, 0, 1, "wrist", form, data]))

    with key:
        yield send


def test_a_truncated_picture_leaves_the_last_one_which_is_outdated_until_the_next(sessions, raw_image):
    with CameraListener(sessions[1], "r1") as listener:
        until(lambda: raw_image(jpeg()) or listener.pictures)
        good = listener.pictures["wrist"]
        assert listener.outdated == set()
        raw_image(jpeg()[:-200])
        until(lambda: listener.outdated)
        assert (listener.refused, listener.outdated) == ({"truncated": 1}, {"wrist"})
        assert listener.latest.data == good.data
        raw_image(jpeg())
        until(lambda: not listener.outdated)


def test_bombs_and_other_formats_are_counted_by_their_reason(sessions, raw_image):
    header = bytearray(png())
    header[16:24] = (30_000).to_bytes(4) * 2
    with CameraListener(sessions[1], "r1") as listener:
        until(lambda: raw_image(jpeg()) or listener.pictures)
        raw_image(bytes(header), "png")
        raw_image(b"GIF89a" + bytes(100))
        raw_image(jpeg(), "webp")
        until(lambda: sum(listener.refused.values()) == 3)
    assert listener.refused == {"too large": 1, "foreign": 1, "malformed": 1}


def test_a_jpeg_with_broken_pixels_is_refused_when_it_is_decoded(sessions, raw_image):
    data = bytearray(jpeg())
    data[-60:-2] = bytes(range(100, 158))
    with CameraListener(sessions[1], "r1") as listener:
        until(lambda: raw_image(bytes(data)) or listener.pictures)
    with pytest.raises(MessageError) as caught:
        listener.pictures["wrist"].decode()
    assert caught.value.reason == "broken"


@pytest.mark.parametrize("form", ["h264", "h265"])
def test_a_video_is_decoded_from_its_first_key_frame_on(sessions, form: str):
    writer, reader = sessions
    packets = video(7, form, key_every=4)
    with CameraListener(reader, "r1") as listener, CameraPublisher(writer, "r1", "wrist") as publisher:
        until(lambda: publisher.publish(packets[1], 0, format=form) or listener.refused)
        assert set(listener.refused) == {"no key frame"}
        assert not listener.pictures
        for number, packet in enumerate(packets):
            publisher.publish(packet, number * MS, format=form)
        until(lambda: listener.latest and listener.latest.stamp == 6 * MS)
        newest = listener.latest
        assert (newest.format, newest.size, newest.data) == (form, SIZE, packets[6])
        assert np.abs(newest.decode().astype(int) - pixels(brightness=120)).max() < 30
        assert not listener.outdated


def test_after_a_lost_packet_a_video_waits_for_the_next_key_frame(sessions, raw_image):
    from msgspec import msgpack

    from zstate.cameras.messages import CompressedImage

    packets = video(6, key_every=4)
    with (
        CameraListener(sessions[1], "r1") as listener,
        KeyPublisher(sessions[0], "zstate/r1/image/wrist", encoding_of(CompressedImage)) as key,
    ):

        def send(number: int) -> None:
            key.put(msgpack.encode([number * MS, number, 1, "wrist", "h264", packets[number]]))

        until(lambda: send(0) or listener.pictures)
        before = listener.refused.get("no key frame", 0)
        send(1)
        until(lambda: listener.latest.stamp == MS)
        send(3)  # after the loss of 2
        until(lambda: listener.refused.get("no key frame", 0) == before + 1)
        assert (listener.latest.stamp, listener.outdated) == (MS, {"wrist"})
        send(4)
        send(5)
        until(lambda: listener.latest.stamp == 5 * MS)
        assert listener.outdated == set()


def test_what_is_no_picture_is_not_published(sessions):
    writer, _ = sessions
    with CameraPublisher(writer, "r1", "wrist", camera()) as publisher:
        for wrong, text in (
            (np.zeros((48, 64, 4), np.uint8), "uint8 of shape"),
            (pixels().astype(float), "float64 of shape"),
            (np.zeros((0, 64), np.uint8), "1 to 64000000 pixels"),
            (np.broadcast_to(np.uint8(0), (30_000, 30_000)), "30000 x 30000"),
            (b"GIF89a", "neither JPEG nor PNG"),
            (jpeg()[:-2], "cut off"),
            (jpeg(32, 32), "32 x 32, but the calibration is for 64 x 48"),
            (jpeg() + bytes(16 * MEGABYTE), "bytes, where"),
        ):
            with pytest.raises(InvalidInput, match=text):
                publisher.publish(wrong)
        assert (publisher.stats.sent, publisher.stats.refused) == (0, 8)


def test_a_camera_has_one_writer(sessions):
    with CameraPublisher(sessions[0], "r1", "wrist", camera()):
        until(lambda: len(current_tokens(sessions[1], WRITER_TOKEN.expression("r1"), 1.0)) == 2)
        with pytest.raises(SecondWriter):
            CameraPublisher(sessions[1], "r1", "wrist")
        with pytest.raises(SecondWriter):
            CameraInfoPublisher(sessions[1], "r1", "wrist", camera())
        CameraPublisher(sessions[1], "r1", "front", camera()).close()


def test_a_publisher_whose_calibration_belongs_to_another_leaves_nothing_open(sessions):
    with CameraInfoPublisher(sessions[0], "r1", "wrist", camera()):
        until(lambda: current_tokens(sessions[1], WRITER_TOKEN.expression("r1"), 1.0))
        with pytest.raises(SecondWriter):
            CameraPublisher(sessions[1], "r1", "wrist", camera())
        CameraPublisher(sessions[0], "r1", "wrist").close()


def test_a_closed_publisher_raises_closed(sessions):
    publisher = CameraPublisher(sessions[0], "r1", "wrist")
    publisher.close()
    with pytest.raises(Closed):
        publisher.publish(jpeg())


def test_two_frames_or_no_quality_are_refused_where_the_mistake_is_made(sessions: tuple[Session, Session]):
    with pytest.raises(InvalidInput, match="'lens'"):
        CameraPublisher(sessions[0], "r1", "wrist", camera(), frame="other")
    with pytest.raises(InvalidInput, match="1 to 100, not 0"):
        CameraPublisher(sessions[0], "r1", "wrist", quality=0)


def test_without_the_libraries_the_call_that_needs_them_names_the_extra(sessions, monkeypatch):
    monkeypatch.setitem(sys.modules, "simplejpeg", None)
    monkeypatch.setitem(sys.modules, "av", None)
    writer, reader = sessions
    (packet,) = VIDEO_OF_ONE
    with CameraListener(reader, "r1") as listener, CameraPublisher(writer, "r1", "wrist") as publisher:
        with pytest.raises(LibraryMissing, match=r"pip install 'zstate\[cameras\]'"):
            publisher.publish(pixels())
        picture = publish_one(publisher, listener, JPEG)
        with pytest.raises(LibraryMissing, match="simplejpeg"):
            picture.decode()
        until(lambda: publisher.publish(packet, format="h264") or listener.refused)
        assert set(listener.refused) == {"no decoder"}


JPEG, VIDEO_OF_ONE = jpeg(), video(1)
