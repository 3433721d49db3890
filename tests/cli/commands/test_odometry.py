"""zstate odometry, of a simulated rover in another process, and from its recording."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.cli_runner import ROVER, Spawn, failure, interrupted, started, zstate
from helpers.processes import DEADLINE_S, until

from zstate import TransformListener, connect

pytestmark = pytest.mark.processes

SETTINGS = str(Path(__file__).parents[3] / "models" / "rover.toml")


def test_live_odometry_drives_the_rover_and_its_recording_gives_a_report_and_a_plot(
    spawn: Spawn, tmp_path: Path
):
    assert spawn(ROVER).line() == "ready"
    live = started(spawn, "odometry", "rover", "--file", SETTINGS, "--rate", "50")
    first = (
        "publishing the odometry of 'rover', odom -> base_footprint, as 'odometry', from its IMU 'imu', its "
    )
    assert live.line() == f"{first}wheels"
    file, plot = tmp_path / "run.mcap", tmp_path / "run.png"
    with connect() as session, TransformListener(session, "rover") as listener:
        listener.buffer.wait("odom", "base_footprint", timeout_s=DEADLINE_S)
        assert zstate("record", str(file), "rover", "--duration", "4").returncode == 0
        # It drives its square as soon as it has an odometry.
        until(lambda: listener.buffer.lookup("odom", "base_footprint").translation[0] > 0.1)
    replayed = zstate("odometry", "rover", "--file", SETTINGS, "--replay", str(file), "--plot", str(plot))
    assert replayed.returncode == 0, replayed.stderr
    path, *sources, wrote = replayed.stdout.decode().splitlines()
    number = r"-?\d+\.\d+"
    assert re.fullmatch(
        rf"{number} m in {number} s; base_footprint ends at x {number} m \(sigma .* deg .*", path
    )
    assert any(
        re.match(rf"wheels: {number} Hz, NIS {number} for 3 numbers \(expected", one) for one in sources
    )
    assert wrote == f"wrote {plot}"
    assert plot.read_bytes().startswith(b"\x89PNG")
    interrupted(live)
    assert re.fullmatch(r"\d+ samples published", live.line())


def test_what_is_missing_is_printed_while_it_waits(spawn: Spawn):
    waiting = started(spawn, "odometry", "rover", "--file", SETTINGS)
    until(lambda: "waiting: 'rover' has no reading of the IMU 'imu'" in waiting.stderr)
    interrupted(waiting)


def test_unusable_options_are_explained(tmp_path: Path):
    wheels = "left=l,right=r,radius=0.1,track=0.5"
    for arguments, error in (
        ((), "an IMU alone drifts by metres in seconds; give --diff-drive, --velocity or --file"),
        (("--diff-drive", "left=l"), "right, radius, track missing"),
        (("--diff-drive", wheels, "--plot", "a.png"), "--plot needs --replay RECORDING"),
    ):
        assert error in failure("odometry", "rover", *arguments, code=2)
    settings = tmp_path / "rover.toml"
    settings.write_text("imus = 'a'\n")
    assert "rover.toml:1: imus: unknown key; did you mean 'imu'?" in failure(
        "odometry", "rover", "--file", str(settings)
    )
