"""A webcam whose driver is tests/cameras/cli/v4l2_camera.c, below the library that reads it."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import MAIN, Spawn, interrupted
from helpers.pictures import jpeg
from helpers.processes import Child, until

from zstate import connect
from zstate.cameras import CameraListener
from zstate.cameras.listener import Picture

pytestmark = [pytest.mark.gcc, pytest.mark.processes]

DEVICE = "/dev/video0"
GREY = np.full(64 * 48 * 2, 128, np.uint8).tobytes()
"""YUYV."""
AGE_NS = 300_000_000
DAY_NS = 86_400_000_000_000


class Plug:
    """The picture that the camera sends again and again, in a file."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "picture"

    def send(self, picture: bytes) -> None:
        other = self.path.with_suffix(".next")
        other.write_bytes(picture)
        other.replace(self.path)

    def silence(self) -> None:
        """Wait until the camera has sent its last picture."""
        self.send(b"")
        until(self.path.with_suffix(".silent").exists)

    def pull(self) -> None:
        self.path.unlink()


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> str:
    built = tmp_path_factory.mktemp("driver") / "v4l2_camera.so"
    source = Path(__file__).with_name("v4l2_camera.c")
    subprocess.run(
        ["gcc", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", source, "-o", built], check=True
    )
    return str(built)


@pytest.fixture
def plug(tmp_path: Path) -> Plug:
    return Plug(tmp_path)


@pytest.fixture
def camera(driver: str, plug: Plug, spawn: Spawn) -> Callable[..., Child]:
    """``camera()`` runs `zstate camera r1 --device /dev/video0` with the driver."""

    def start(*options: str, form: str = "MJPG", age_ns: int = 0, group: int = 1000) -> Child:
        settings = {
            "DEVICE": DEVICE,
            "PICTURE": str(plug.path),
            "FORMAT": form,
            "AGE": age_ns,
            "GROUP": group,
        }
        with pytest.MonkeyPatch.context() as environment:
            environment.setenv("LD_PRELOAD", driver)
            for name, value in settings.items():
                environment.setenv(f"CAMERA_{name}", str(value))
            return spawn(MAIN, "camera", "r1", "--device", DEVICE, *options, is_forked=False)

    return start


@pytest.fixture
def pictures() -> Iterator[Iterator[Picture]]:
    with connect() as session, CameraListener(session, "r1") as listener:
        yield iter(listener)


def test_jpegs_of_a_webcam_are_sent_as_they_are_until_it_is_unplugged(
    camera: Callable[..., Child], plug: Plug, pictures: Iterator[Picture]
):
    plug.send(jpeg())
    child = camera()
    line = f"r1: 64 x 48 of {DEVICE}, JPEG as it comes, in camera, on zstate/r1/image/camera"
    assert child.line() == line
    assert next(pictures).data == jpeg()
    plug.send(jpeg(brightness=100))
    while next(pictures).data == jpeg():
        pass
    plug.pull()
    assert child.wait() == 1
    assert f"{DEVICE} sends no more pictures ([Errno 19] No such device" in child.stderr
    assert "is it plugged in?" in child.stderr


def test_other_pictures_of_a_webcam_are_encoded_and_broken_ones_are_left_out(
    camera: Callable[..., Child], plug: Plug, pictures: Iterator[Picture]
):
    plug.send(GREY)
    child = camera(form="YUYV", group=2)
    assert child.line().startswith(f"r1: 64 x 48 of {DEVICE}, rawvideo, encoded as JPEG, in camera")
    for _, picture in zip(range(5), pictures, strict=False):
        assert np.abs(picture.decode().astype(int) - 128).max() <= 3
    interrupted(child)
    assert "refused" not in child.stderr


def test_a_picture_of_a_webcam_has_the_stamp_of_its_driver(
    camera: Callable[..., Child], plug: Plug, pictures: Iterator[Picture]
):
    plug.send(jpeg())
    camera(age_ns=AGE_NS)
    for _, picture in zip(range(5), pictures, strict=False):
        assert picture.stamp <= time.time_ns() - AGE_NS


@pytest.mark.parametrize("age_ns", [DAY_NS, -DAY_NS])
def test_a_picture_whose_driver_has_another_clock_is_stamped_at_its_arrival(
    camera: Callable[..., Child], plug: Plug, pictures: Iterator[Picture], age_ns: int
):
    began = time.time_ns()
    plug.send(jpeg())
    camera(age_ns=age_ns)
    for _, picture in zip(range(5), pictures, strict=False):
        assert began < picture.stamp < time.time_ns()


def test_a_webcam_sends_the_size_and_the_rate_that_are_wanted(
    camera: Callable[..., Child], plug: Plug, pictures: Iterator[Picture]
):
    plug.send(jpeg(32, 24))
    child = camera("--size", "32", "24", "--rate", "50")
    assert child.line().startswith(f"r1: 32 x 24 of {DEVICE}, JPEG as it comes")
    stamps = [picture.stamp for _, picture in zip(range(10), pictures, strict=False)]
    assert min(later - stamp for stamp, later in pairwise(stamps)) >= 20_000_000


@pytest.mark.parametrize("options", [("--size", "1280", "720"), ("--rate", "30")])
def test_a_size_and_a_rate_that_a_webcam_does_not_have_are_refused(
    camera: Callable[..., Child], plug: Plug, options: tuple[str, ...]
):
    plug.send(jpeg())
    child = camera(*options)
    assert child.wait() == 1
    assert f"{DEVICE} has no such pictures, but 64 x 48 at 100 Hz" in child.stderr


def test_a_webcam_that_falls_silent_is_lost(camera: Callable[..., Child], plug: Plug):
    plug.send(jpeg())
    child = camera()
    child.line()
    plug.silence()
    assert child.wait() == 1
    assert f"{DEVICE} sends no more pictures (nothing for 5 s): is it plugged in?" in child.stderr


def test_ctrl_c_ends_the_wait_for_a_silent_webcam(camera: Callable[..., Child], plug: Plug):
    plug.send(jpeg())
    child = camera()
    child.line()
    plug.silence()
    interrupted(child)


def test_a_webcam_that_is_silent_from_the_start_is_named(camera: Callable[..., Child], plug: Plug):
    plug.send(b"")
    child = camera()
    assert child.wait() == 1
    assert f"{DEVICE} cannot be opened as a camera of v4l2: it has sent nothing for 5 s" in child.stderr
