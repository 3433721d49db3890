"""zstate odometry, of a simulated rover in another process, and from its recording."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest
from helpers.cli_runner import (
    Spawn,
    failure,
    found_pose,
    interrupted,
    run_cli,
    run_until,
    start_rover,
    started,
)
from helpers.processes import DEADLINE_S, repeated, until

from zstate import StatePublisher, TransformListener, connect, load_model
from zstate.net.session import Session
from zstate.odometry import (
    Datum,
    DatumPublisher,
    FixPublisher,
    ImuPublisher,
    PressurePublisher,
    VelocityPublisher,
)

SETTINGS = str(Path(__file__).parents[3] / "models" / "rover.toml")


@pytest.mark.processes
@pytest.mark.long
def test_live_odometry_drives_the_rover_and_its_recording_gives_a_report_and_a_plot(
    spawn: Spawn, tmp_path: Path
):
    start_rover(spawn)
    live = started(spawn, "odometry", "rover", "--file", SETTINGS, "--rate", "50")
    first = (
        "publishing the odometry of 'rover', odom -> base_footprint, as 'odometry', from its IMU 'imu', its "
    )
    assert live.line() == f"{first}wheels"
    file, plot = tmp_path / "run.mcap", tmp_path / "run.png"
    with connect() as session, TransformListener(session, "rover") as listener:
        listener.buffer.wait("odom", "base_footprint", timeout_s=DEADLINE_S)
        assert run_cli("record", str(file), "rover", "--seconds", "4").code == 0
        # It drives its square as soon as it has an odometry.
        until(lambda: listener.buffer.lookup("odom", "base_footprint").translation[0] > 0.1)
    replayed = run_cli("odometry", "rover", "--file", SETTINGS, "--replay", str(file), "--plot", str(plot))
    assert replayed.code == 0, replayed.stderr
    *report, wrote = replayed.stdout.splitlines()
    number = r"-?\d+\.\d+"
    path = rf"{number} m in {number} s; base_footprint ends at x {number} m \(sigma .* deg .*"
    assert any(re.fullmatch(path, line) for line in report)
    assert any(re.match(rf"wheels +{number} +\d+ +\d+ +\d+ +{number} +x {number}", line) for line in report)
    assert wrote == f"wrote {plot}"
    unknown = failure("odometry", "rover", "--velocity", "nosuch", "--replay", str(file))
    assert f"{file} has no message on velocity/nosuch of 'rover'" in unknown
    assert plot.read_bytes().startswith(b"\x89PNG")
    interrupted(live)
    assert re.fullmatch(r"\d+ samples published", live.line())


LEG = """<link name="leg{0}"/><link name="foot{0}"/>
  <joint name="slide{0}" type="prismatic"><parent link="base"/><child link="leg{0}"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="sole{0}" type="fixed"><parent link="leg{0}"/><child link="foot{0}"/>
    <origin xyz="0 {0} -0.4"/></joint>"""
WALKER = f'<robot name="walker"><link name="base"/>{LEG.format(1)}{LEG.format(2)}</robot>'


@contextmanager
def walker(session: Session) -> Generator[threading.Event]:
    """Stands until the event is set; then its feet slide back under it by 0.2 m in 2 s: it moves ahead."""

    def run() -> None:
        slide = 0.0
        while not stop.wait(0.01):
            moves = walks.is_set() and slide > -0.2
            slide -= 0.001 * moves
            stamp = time.time_ns()
            imu.publish([0.0, 0.0, 0.0], [0.0, 0.0, 9.80665], stamp)
            joints.publish([slide, slide], [-0.1 * moves] * 2, stamp=stamp)

    stop, walks = threading.Event(), threading.Event()
    with (
        ImuPublisher(session, "walker", "imu", frame="base") as imu,
        StatePublisher(session, load_model(WALKER), "walker") as joints,
    ):
        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield walks
        finally:
            stop.set()
            thread.join()


@pytest.mark.long
def test_feet_that_slide_back_under_a_walker_move_it_ahead():
    with connect() as session, TransformListener(session, "walker") as listener, walker(session) as walks:

        def is_ahead() -> bool | None:
            pose = found_pose(listener, "odom", "base")
            if pose is not None:
                walks.set()
            return True if pose is not None and pose.translation[0] > 0.19 else None

        ended, _ = run_until(is_ahead, "odometry", "walker", "--feet", "foot1,foot2", after="its feet")
    assert ended.stdout.splitlines()[0].endswith("from its IMU 'imu', its feet")


def test_what_is_missing_is_printed_while_it_waits():
    waiting = "waiting: 'rover' has no message on imu/imu"
    run_until(lambda: True, "odometry", "rover", "--file", SETTINGS, after=waiting)


def test_sensor_that_no_driver_publishes_is_named_with_those_that_there_are():
    command = ("odometry", "walker", "--velocity", "flwo:sigma=0.05", "--base", "base")
    named = "no message on velocity/flwo; there is 'flow'; did you mean 'flow'?"
    with (
        connect() as session,
        walker(session),
        VelocityPublisher(session, "walker", "flow", frame="base") as flow,
        repeated(lambda: flow.publish([0.0, 0.0, 0.0])),
    ):
        run_until(lambda: True, *command, after=named)


def test_velocities_without_noise_end_the_command_with_the_key_that_states_it():
    with (
        connect() as session,
        walker(session),
        VelocityPublisher(session, "walker", "flow", frame="base") as flow,
        repeated(lambda: flow.publish([0.0, 0.0, 0.0])),
    ):
        message = failure("odometry", "walker", "--velocity", "flow", "--base", "base")
    assert "velocities of 'flow' have no covariance: state their noise by `--velocity flow:sigma=" in message


def test_stated_noise_and_initial_pose_place_the_base_where_it_starts():
    start = ("--initial-pose", "2", "1", "90", "--planar")
    with (
        connect() as session,
        TransformListener(session, "walker") as listener,
        walker(session),
        VelocityPublisher(session, "walker", "flow", frame="base") as flow,
        repeated(lambda: flow.publish([0.0, 0.0, 0.0])),
    ):
        _, pose = run_until(
            lambda: found_pose(listener, "odom", "base"),
            *("odometry", "walker", "--velocity", "flow:sigma=0.05", "--base", "base", *start),
        )
    assert [*pose.translation[:2], pose.rpy[2]] == pytest.approx([2.0, 1.0, math.pi / 2], abs=0.05)
    assert [pose.translation[2], *pose.pose7[3:5]] == [0.0, 0.0, 0.0]  # in the plane


def test_another_datum_for_a_map_of_several_robots_ends_the_command_with_both_and_their_distance():
    def publish() -> None:
        flow.publish([0.0, 0.0, 0.0])
        gps.publish(48.2, 11.5, 560.0)
        barometer.publish(95000.0)

    with (
        connect() as session,
        walker(session),
        VelocityPublisher(session, "walker", "flow", frame="base") as flow,
        FixPublisher(session, "walker", "gps", frame="base") as gps,
        PressurePublisher(session, "walker", "bmp", frame="base") as barometer,
        DatumPublisher(session, "first", "site/map") as site,
        repeated(publish),
    ):
        site.set(Datum(48.1, 11.5, 560.0))
        command = ("odometry", "walker", "--base", "base", "--map", "site/map", "--velocity", "flow:sigma=1")
        command = (*command, "--fix", "gps:sigma=1", "--barometer", "bmp:sigma=0.5")
        message = failure(*command, "--datum", "48.2", "11.5", "560")
        started = "as 'odometry', from its IMU 'imu', 'flow', 'gps', 'bmp'"
        run_until(lambda: True, *command, after=started)
    assert "'site/map' is 48.2000000 11.5000000 560.00 here and 48.1000000 11.5000000 560.00" in message
    assert "of 'first', 11120." in message


@pytest.mark.processes
def test_requests_place_the_base_of_a_running_odometry_and_start_it_anew(spawn: Spawn):
    live = started(spawn, "odometry", "walker", "--feet", "foot1,foot2", "--writer", "legs")
    request = ("odometry", "walker", "--writer", "legs")
    with connect() as session, TransformListener(session, "walker") as listener, walker(session):
        assert "as 'legs'" in live.line()
        listener.buffer.wait("odom", "base", timeout_s=DEADLINE_S)

        def place() -> list[float]:
            pose = listener.buffer.lookup("odom", "base")
            return [*pose.translation[:2], pose.rpy[2]]

        for options, done, expected in (
            (("--set-pose", "2", "1", "90"), "placed the base at x 2 m, y 1 m, yaw 90 deg", (2, 1, 1.5708)),
            (
                ("--reset", "--set-pose", "-3", "0.5", "0"),
                "restarted and placed the base at",
                (-3, 0.5, 0),
            ),
        ):
            ended = run_cli(*request, *options)
            assert ended.stdout.startswith(f"the odometry 'legs' of 'walker' {done}"), ended.stderr
            until(lambda: place() == pytest.approx(expected, abs=0.05))  # noqa: B023
        assert run_cli(*request, "--reset").stdout == "the odometry 'legs' of 'walker' restarted\n"
        refused = failure("odometry", "walker", "--reset")
        assert "no reply at 'zstate/walker/@odometry/odometry' within 2 s" in refused
    interrupted(live)


def test_unusable_options_are_explained(tmp_path: Path):
    wheels = "left=l,right=r,radius=0.1,track=0.5"
    for arguments, error in (
        ((), "an IMU alone drifts by metres in seconds; add --diff-drive, --feet, --velocity, --pose, "),
        (("--diff-drive", "left=l"), "right, radius, track missing"),
        (("--diff-drive", wheels, "--plot", "a.png"), "--plot needs --replay RECORDING"),
        (("--diff-drive", wheels, "--reference", "pose/gps"), "--reference needs --replay RECORDING"),
        (("--reference", "poses/gps"), "a reference is pose/SENSOR or odometry/WRITER, not 'poses/gps'"),
        (("--reference", "pose/gps:sgma=1"), "'sgma=1' is not sigma=METRES; write pose/gps:sigma=0.02"),
        (("--reset", "--initial-pose", "1", "2", "3"), "--initial-pose is not for it"),
        (("--set-pose", "1", "2", "3", "--replay", "a.mcap"), "--replay is not for it"),
        (("--velocity", "flow:sigma=0"), "sigma is a standard deviation above zero"),
    ):
        assert error in failure("odometry", "rover", *arguments, code=2)
    settings = tmp_path / "rover.toml"
    settings.write_text("imus = 'a'\n")
    assert "rover.toml:1: imus: unknown key; did you mean 'imu'?" in failure(
        "odometry", "rover", "--file", str(settings)
    )


@pytest.mark.processes
@pytest.mark.parametrize("task", [("--reset",), ("--set-pose", "1", "2", "3"), ("--init", "r1.toml")])
def test_requests_and_first_files_take_the_options_of_the_network(task: tuple[str, ...]):
    network = ("--connect", "tcp/127.0.0.1:1", "--log-format", "text")
    assert "127.0.0.1:1" in failure("odometry", "rover", *task, *network)
