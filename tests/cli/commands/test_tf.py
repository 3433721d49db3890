from __future__ import annotations

import json
import math
import re
import time

import pytest
from helpers.cli_runner import (
    ELBOW,
    SHOULDER,
    Command,
    Ended,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_watched,
    started,
)
from helpers.processes import until

from zstate import StaticPublisher, Transform, connect
from zstate.cli.commands.tf import transform_text

# From the model: the shoulder stands 1.05 m above the base, the elbow 0.7 m further along the upper
# link, each a little to the side; both turn about y, which is pitch.
BASE_FROM_LOWER = (0.7 * math.sin(SHOULDER), 0.1 + 0.07, 1.05 + 0.7 * math.cos(SHOULDER))
PITCH = SHOULDER + ELBOW


def test_output_has_the_format_of_tf2_echo():
    with published_robot():
        lines = run_cli("tf", "base", "lower", "--once").stdout.splitlines()
    c, s = math.cos(PITCH), math.sin(PITCH)
    x, y, z = BASE_FROM_LOWER
    qy, qw = math.sin(PITCH / 2), math.cos(PITCH / 2)
    assert lines[0] == "pose of lower in base"
    seconds, _, nanoseconds = lines[1].removeprefix("At time ").partition(".")
    assert seconds.isdigit()
    assert nanoseconds.isdigit()
    assert len(nanoseconds) == 9
    assert lines[2:] == [
        f"- Translation: [{x:.3f}, {y:.3f}, {z:.3f}]",
        f"- Rotation: in Quaternion (xyzw) [0.000, {qy:.3f}, 0.000, {qw:.3f}]",
        f"- Rotation: in RPY (radian) [0.000, {PITCH:.3f}, 0.000]",
        f"- Rotation: in RPY (degree) [0.000, {math.degrees(PITCH):.3f}, 0.000]",
        "- Matrix:",
        f"  {c:.3f}  0.000  {s:.3f}  {x:.3f}",
        f"  0.000  1.000  0.000  {y:.3f}",
        f" {-s:.3f}  0.000  {c:.3f}  {z:.3f}",
        "  0.000  0.000  0.000  1.000",
    ]


def test_the_twist_is_that_of_the_published_velocities():
    shoulder_rate, elbow_rate = 0.5, 0.25
    with published_robot(velocities=(shoulder_rate, elbow_rate)):
        lines = run_cli("tf", "base", "lower", "--once", "--twist").stdout.splitlines()
        facts = json.loads(run_cli("tf", "base", "lower", "--once", "--twist", "--json").stdout)
    linear = [0.7 * math.cos(SHOULDER) * shoulder_rate, 0.0, -0.7 * math.sin(SHOULDER) * shoulder_rate]
    angular = [0.0, shoulder_rate + elbow_rate, 0.0]
    assert lines[-2] == f"- Twist: linear [{linear[0]:.3f}, 0.000, {linear[2]:.3f}] m/s"
    assert lines[-1] == "- Twist: angular [0.000, 0.750, 0.000] rad/s"
    assert facts["linear"] == pytest.approx(linear, abs=1e-12)
    assert facts["angular"] == pytest.approx(angular, abs=1e-12)


def test_twist_of_a_static_edge_is_zero():
    with published_robot():
        lines = run_cli("tf", "world", "base", "--once", "--twist").stdout.splitlines()
    assert lines[-2:] == [
        "- Twist: linear [0.000, 0.000, 0.000] m/s",
        "- Twist: angular [0.000, 0.000, 0.000] rad/s",
    ]


def test_precision_applies_to_every_number():
    lines = transform_text(Transform("a", "b", (1 / 3, 0.0, -2.0), (0.0, 0.0, 0.0, 1.0), 5), 5).splitlines()
    assert lines[1] == "- Translation: [0.33333, 0.00000, -2.00000]"
    assert lines[6] == "  1.00000  0.00000  0.00000  0.33333"
    assert transform_text(Transform("a", "b", (0.6, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 5), 0).splitlines()[
        1
    ] == ("- Translation: [1, 0, 0]")


def test_stamps_have_nine_digits_and_zeros_no_sign():
    lines = transform_text(Transform("a", "b", (-1e-9, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 5)).splitlines()
    assert lines[:2] == ["At time 0.000000005", "- Translation: [0.000, 0.000, 0.000]"]


def test_json_is_one_object_for_a_program():
    with published_robot():
        answer = json.loads(run_cli("tf", "base", "lower", "--once", "--json").stdout)
    assert (answer["target"], answer["source"]) == ("base", "lower")
    assert answer["translation"] == pytest.approx(BASE_FROM_LOWER, abs=1e-12)
    assert answer["rpy"] == pytest.approx([0.0, PITCH, 0.0], abs=1e-12)
    assert 0.0 <= answer["age_s"] < 10.0


def test_fixed_frames_are_found_without_moving_joints():
    with connect() as session, StaticPublisher(session, "cell") as statics:
        statics.set(Transform("floor", "table", (0.0, 0.0, 0.8), (0.0, 0.0, 0.0, 1.0)))
        lines = run_cli("tf", "floor", "table", "--once").stdout.splitlines()
    assert lines[1:3] == ["At any time (static)", "- Translation: [0.000, 0.000, 0.800]"]


@pytest.mark.processes
def test_tf_prints_the_reason_while_it_waits_and_the_end_of_the_wait(spawn: Spawn):
    command = started(spawn, "tf", "base", "lower", "--rate", "20")
    assert command.line() == "pose of lower in base"
    until(lambda: "waiting: no robot is announced" in command.stderr)
    with published_robot(streams=("joint_states",)):
        until(lambda: "waiting: robot_description of 'rrbot' has no writer" in command.stderr)
    with published_robot():
        assert command.line().startswith("At time ")
    assert "receiving rrbot: 7 frames, 2 joints" in command.stderr
    interrupted(command)


def test_tf_reports_when_samples_stop():
    def watch(command: Command) -> None:
        with published_robot():
            command.line()
            assert command.line().startswith("At time ")
        until(lambda: "no new sample of 'rrbot/base' -> 'rrbot/upper'" in command.stderr)

    run_watched(watch, "tf", "base", "lower", "--rate", "20")


def test_once_gives_up_with_the_reason():
    message = failure("tf", "base", "lower", "--once", "--timeout", "1")
    assert "zstate: gave up after 1 s: no robot is announced" in message
    with published_robot():
        message = failure("tf", "base", "lowr", "--once", "--timeout", "1")
    assert "zstate: gave up after 1 s: the frame 'lowr' is unknown; did you mean 'lower'" in message


def test_missing_robot_is_reported_with_the_announced_ones():
    with published_robot():
        message = failure("tf", "base", "lower", "--once", "--timeout", "1", "--robot", "rrbt")
    assert "'rrbt'" in message
    assert "did you mean 'rrbot'?" in message


def test_future_instant_is_waited_for_and_past_one_is_refused():
    with published_robot():
        soon = time.time_ns() + 2_000_000_000
        as_printed = f"{soon // 10**9}.{soon % 10**9:09d}"
        answer = json.loads(
            run_cli("tf", "base", "lower", "--at", as_printed, "--timeout", "20", "--json").stdout
        )
        assert answer["stamp"] == soon
        message = failure("tf", "base", "lower", "--at", str(soon - 3_600 * 10**9))
        other = failure("tf", "base", "lower", "--at", "250.655")
        late = failure("tf", "base", "lower", "--at", str(soon + 3_600 * 10**9), "--timeout", "1")
        seconds = failure("tf", "base", "lower", "--at", str(soon // 10**9))
    assert re.search("before the (oldest|only) sample of 'rrbot/base' -> 'rrbot/upper'", message)
    assert "leave --at out for the newest pose, or give a later instant" in message
    assert (
        "the requested stamp, 250.655 s, is simulated time or time since a machine was switched on, but"
        in other
    )
    assert "the samples have wall-clock stamps" in other
    assert re.search("after the (newest|only) sample of 'rrbot/base' -> 'rrbot/upper'", late)
    assert "wait longer (--timeout), or leave --at out" in late
    assert "looks like seconds, but stamps are nanoseconds" in seconds
    assert not any(word in message + other + late + seconds for word in ("timeout_s", "at=None", "history_s"))


@pytest.mark.parametrize("stamp", ["noon", "1.0000000001", "nan", "1e40"])
def test_invalid_stamp_is_wrong_usage(stamp: str):
    assert f"{stamp!r} is not a stamp" in failure("tf", "a", "b", "--at", stamp, code=2)


@pytest.mark.parametrize(("option", "value"), [("--rate", "0"), ("--rate", "nan"), ("--timeout", "-1")])
def test_invalid_numbers_are_wrong_usage(option: str, value: str):
    assert option in failure("tf", "a", "b", option, value, code=2)


def test_a_bare_name_of_two_robots_lists_both():
    tried: list[Ended] = []

    def is_ambiguous() -> bool:
        """With the first of the two alone, which may arrive before the other, the name is clear."""
        tried.append(run_cli("tf", "world", "tool", "--once", "--timeout", "5"))
        return tried[-1].code == 1

    with published_robot("r1"), published_robot("r2"):
        until(is_ambiguous)
        named = run_cli("tf", "r1/world", "r1/tool", "--once")
    assert "'r1/world'" in tried[-1].stderr
    assert "'r2/world'" in tried[-1].stderr
    assert named.code == 0


def test_it_ends_after_the_seconds_that_are_given():
    with published_robot():
        ended = run_cli("tf", "base", "lower", "--rate", "10", "--seconds", "0.5", "--json")
    poses = [json.loads(line) for line in ended.stdout.splitlines()]
    assert 1 <= len(poses) <= 5
    assert {pose["source"] for pose in poses} == {"lower"}


def test_without_a_pose_it_fails_after_the_seconds_with_the_reason():
    assert "gave up after 0.5 s" in failure("tf", "base", "lower", "--seconds", "0.5")


@pytest.mark.parametrize("single", [("--once",), ("--at", "5")])
def test_seconds_are_refused_where_one_pose_is_printed(single: tuple[str, ...]):
    assert "--timeout limits the wait" in failure("tf", "base", "lower", "--seconds", "1", *single, code=2)
