"""zstate cloud, and what the other commands show of clouds."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import Spawn, failure, interrupted, run_cli, run_until, started
from helpers.processes import repeated

from zstate import StaticPublisher, Transform, connect
from zstate.clouds import CloudListener, CloudPublisher, PlacedCloud
from zstate.net.session import Session

DRIVERS = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("timestamp", "f8")])


def test_a_simulated_cloud_measures_the_room_from_the_frame_of_the_lidar():
    with (
        connect() as session,
        StaticPublisher(session, "r1", "mount") as statics,
        CloudListener(session, "r1", "base") as clouds,
    ):
        statics.set(Transform.from_rpy("r1/base", "r1/lidar", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))

        def received() -> PlacedCloud | None:
            return next(iter(clouds)) if len(clouds) else None

        options = ("--frame", "lidar", "--simulate", "--compression", "zstd", "--resolution", "0.001")
        ended, cloud = run_until(received, "cloud", "r1", *options)
    assert "simulating a lidar in lidar; the room stands in r1/base" in ended.stderr
    assert "r1: clouds in lidar, 10 Hz, on zstate/r1/cloud/lidar" in ended.stdout.replace("\n", " ")
    assert len(cloud.cloud) == 128 * 1016
    assert cloud.valid.all()
    # A room of 12 x 8 x 3 m around the base, with noise of 1 cm.
    assert np.allclose([cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)], [[-6, -4, 0], [6, 4, 3]], atol=0.06)


def test_a_cloud_waits_for_the_robot():
    text = failure("cloud", "r9", "--frame", "lidar", "--simulate", "--seconds", "1")
    assert "no cloud in 1 s: robot 'r9' is not announced" in text


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ((), "give --simulate"),
        (("--simulate", "--resolution", "0.01"), "give --compression with --resolution"),
    ],
)
def test_wrong_usage_is_refused_at_once(options: tuple[str, ...], text: str):
    ended = run_cli("cloud", "r1", "--frame", "lidar", *options)
    assert ended.code == 2
    assert text in ended.stderr.replace("\n", " ")


def published(session: Session) -> CloudPublisher:
    return CloudPublisher(session, "r1", "front", frame="lidar")


def points_at(seconds: float) -> np.ndarray:
    """Four points measured in 0.1 s from ``seconds`` on, one of them NaN."""
    points = np.zeros(4, DRIVERS)
    points["x"], points["y"], points["z"] = [1.0, -2.0, 3.0, np.nan], 0.5, [0.0, 1.0, 2.0, np.nan]
    points["timestamp"] = seconds + np.linspace(0.0, 0.1, 4)
    return points


def test_echo_prints_the_shape_the_fields_and_the_box_without_nan():
    with (
        connect() as session,
        published(session) as publisher,
        repeated(lambda: publisher.publish(points_at(time.time())), every_s=0.05),
    ):
        shown = json.loads(run_cli("echo", "r1", "--stream", "cloud", "--once", "--json").stdout)
        text = run_cli("echo", "r1", "--stream", "cloud", "--once", "--field", "max").stdout
    assert (shown["width"], shown["height"], shown["nan"]) == (4, 1, 1)
    assert shown["fields"] == ["x", "y", "z", "timestamp"]
    assert (shown["min"], shown["max"]) == ([-2.0, 0.5, 0.0], [3.0, 0.5, 2.0])
    assert (shown["frame"], shown["is_dense"], shown["compression"]) == ("r1/lidar", False, None)
    assert shown["end_stamp"] - shown["stamp"] == pytest.approx(1e8, abs=5e7)
    assert json.loads(text) == [3.0, 0.5, 2.0]


@pytest.mark.parametrize("is_own", [False, True])
def test_doctor_names_a_sensor_whose_points_are_stamped_by_a_clock_of_its_own(is_own: bool):
    """A driver that is not synchronised stamps by the time since the sensor was switched on."""
    with connect() as session, published(session) as publisher:
        start = (lambda: 1000.0) if is_own else time.time
        with repeated(lambda: publisher.publish(points_at(start())), every_s=0.05):
            ended = run_cli("doctor", "r1", "--json")
    found = [one for one in json.loads(ended.stdout)["checks"] if one["name"] == "cloud"]
    is_named = [one["state"] for one in found if "the sensor has a clock of its own" in one["text"]]
    assert is_named == (["warning"] if is_own else []), found


def test_clouds_have_a_rate_and_are_recorded_and_played_again(tmp_path: Path):
    file = str(tmp_path / "run.mcap")
    with connect() as session, published(session) as publisher:
        sent: list[float] = []

        def publish() -> None:
            publisher.publish(points_at(time.time()))
            sent.append(time.monotonic())

        with repeated(publish, every_s=0.05):
            begin = time.monotonic()
            rate = json.loads(run_cli("hz", "r1", "--stream", "cloud", "--once", "--json").stdout)
            during = [at for at in sent if at > begin]
            sent_hz = (len(during) - 1) / (during[-1] - during[0])
            assert rate["rate_hz"] == pytest.approx(sent_hz, rel=0.3)
            assert re.search(r"cloud/front +[\d.]+ Hz", run_cli("ls").stdout)
            assert run_cli("record", file, "r1", "--seconds", "1").code == 0
        info = run_cli("info", file).stdout
        assert "/front" in info
    with connect() as session, CloudListener(session, "r1") as clouds:
        assert run_cli("replay", file, "--rate", "5").code == 0
        placed = next(iter(clouds))
    assert placed.sensor == "front"
    assert placed.xyz[:3].tolist() == [[1.0, 0.5, 0.0], [-2.0, 0.5, 1.0], [3.0, 0.5, 2.0]]


@pytest.mark.processes
def test_a_cloud_ends_with_a_report(spawn: Spawn):
    with (
        connect() as session,
        StaticPublisher(session, "r1", "mount") as statics,
        CloudListener(session, "r1") as clouds,
    ):
        statics.set(Transform.from_rpy("r1/base", "r1/lidar", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
        child = started(spawn, "cloud", "r1", "--frame", "lidar", "--simulate", "--sensor", "top")
        assert child.line() == "r1: clouds in lidar, 10 Hz, on zstate/r1/cloud/top"
        next(iter(clouds))
        interrupted(child)
        assert "commanded 10 Hz" in child.line()
