"""Pictures of video files, which PyAV has written, and webcams that are not there."""

from __future__ import annotations

import wave
from pathlib import Path

import av
import numpy as np
import pytest
from helpers.pictures import pixels, video_file

from zstate.cameras.cli.video_source import VideoFile, Webcam
from zstate.errors import InvalidInput


def packets_of(path: str) -> list[bytes]:
    with av.open(path) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def test_the_jpegs_of_a_file_are_passed_on_as_they_are(tmp_path: Path):
    path = video_file(tmp_path / "walk.avi")
    with VideoFile(path) as source:
        found = list(source.pictures())
        assert (source.size, source.codec) == ((64, 48), "mjpeg")
    assert [picture for _, picture in found] == packets_of(path)
    assert [at_s for at_s, _ in found] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08])


@pytest.mark.parametrize("name", ["walk.mp4", "walk.mkv"])
def test_the_pictures_of_other_videos_are_decoded_in_their_order(tmp_path: Path, name: str):
    with VideoFile(video_file(tmp_path / name, codec="libx264")) as source:
        found = list(source.pictures())
        assert source.codec == "h264"
    assert [at_s for at_s, _ in found] == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08], abs=1e-3)
    for number, (_, picture) in enumerate(found):
        assert np.abs(picture.astype(int) - pixels(brightness=20 * number)).mean() < 10


@pytest.mark.parametrize(("name", "codec"), [("walk.avi", "mjpeg"), ("walk.mp4", "libx264")])
def test_a_file_can_begin_again(tmp_path: Path, name: str, codec: str):
    with VideoFile(video_file(tmp_path / name, codec=codec)) as source:
        first = [at_s for at_s, _ in source.pictures()]
        source.rewind()
        assert [at_s for at_s, _ in source.pictures()] == first


def test_a_file_that_is_cut_off_ends_with_its_last_whole_picture(tmp_path: Path):
    path = Path(video_file(tmp_path / "walk.mkv", count=20, codec="mjpeg"))
    path.write_bytes(path.read_bytes()[:-3000])
    with VideoFile(str(path)) as source:
        assert 0 < len(list(source.pictures())) < 20


def test_what_is_no_video_is_named(tmp_path: Path):
    text = tmp_path / "notes.txt"
    text.write_text("no video")
    with pytest.raises(InvalidInput, match=r"notes\.txt cannot be opened as a video"):
        VideoFile(str(text))
    with pytest.raises(InvalidInput, match=r"none\.mp4 cannot be opened as a video: there is no such file"):
        VideoFile(str(tmp_path / "none.mp4"))


def test_a_file_with_sound_alone_has_no_video(tmp_path: Path):
    path = str(tmp_path / "song.wav")
    with wave.open(path, "wb") as song:
        song.setnchannels(1)
        song.setsampwidth(2)
        song.setframerate(8000)
        song.writeframes(bytes(1600))
    with pytest.raises(InvalidInput, match=r"song\.wav has no video"):
        VideoFile(path)


def test_a_camera_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(InvalidInput, match=r"there is no /dev/video99; cameras of this computer: "):
        Webcam("/dev/video99")


def test_what_is_no_camera_is_named(tmp_path: Path):
    with pytest.raises(InvalidInput, match=r"walk\.avi cannot be opened as a camera of v4l2"):
        Webcam(video_file(tmp_path / "walk.avi"))
