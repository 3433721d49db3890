from __future__ import annotations

import json
import re

import pytest
from helpers.cli_runner import Spawn, failure, interrupted, published_robot, run_cli, started
from helpers.processes import until
from helpers.programs import moving_edge


@pytest.mark.processes
def test_hz_prints_rostopic_style_figures_once_a_second(spawn: Spawn):
    command = started(spawn, "hz", "rrbot")
    with published_robot():
        assert re.fullmatch(r"average rate: \d+\.\d{3}", command.line())
        assert re.fullmatch(
            r"\tmin: \d+\.\d{3}s max: \d+\.\d{3}s std dev: \d+\.\d{5}s window: \d+", command.line()
        )
        assert command.line().startswith("average rate: ")
    until(lambda: "robot 'rrbot' is not announced" in command.stderr)
    interrupted(command)


def test_hz_ends_after_the_seconds_that_are_given():
    with published_robot():
        ended = run_cli("hz", "rrbot", "--seconds", "1.5", "--json")
    assert ended.code == 0
    assert len(ended.stdout.splitlines()) == 2  # each of a second, the second one to its end


@pytest.mark.parametrize("stream", ["joint_states", "tf"])
def test_json_has_the_numbers_of_either_stream(stream: str):
    with published_robot():
        measured = json.loads(run_cli("hz", "rrbot", "--stream", stream, "--once", "--json").stdout)
    # The publisher waits a hundredth of a second between samples; it may be slower, never faster.
    assert 10.0 < measured["rate_hz"] < 110.0
    assert measured["min_s"] <= 1.0 / measured["rate_hz"] <= measured["max_s"]
    assert measured["missed"] == 0


def test_transforms_of_several_writers_are_measured_together():
    with moving_edge("r1", "odom", "base_link"), moving_edge("r1", "odom", "ball"):
        measured = json.loads(run_cli("hz", "r1", "--stream", "transforms", "--once", "--json").stdout)
    # Two writers of 50 Hz each.
    assert measured["rate_hz"] == pytest.approx(100.0, rel=0.2)
    assert measured["missed"] == 0
    message = failure("hz", "r2", "--stream", "transforms", "--once", "--timeout", "1")
    assert "robot 'r2' is not announced" in message


def test_the_window_limits_what_is_measured():
    with published_robot():
        measured = json.loads(run_cli("hz", "rrbot", "--window", "5", "--once", "--json").stdout)
    assert measured["window"] == 5


def test_once_gives_up_with_the_reason():
    message = failure("hz", "rrbot", "--once", "--timeout", "1")
    assert "zstate: gave up after 1 s: robot 'rrbot' is not announced" in message


def test_stream_without_writer_is_named_with_a_command_that_publishes_it():
    with published_robot(streams=("robot_description",)):
        message = failure("hz", "rrbot", "--once", "--timeout", "1")
    assert "joint_states of 'rrbot' has no writer; start one: `zstate joints rrbot`" in message


def test_a_window_of_one_is_wrong_usage():
    assert "--window" in failure("hz", "rrbot", "--window", "1", code=2)


def test_without_samples_it_fails_after_the_seconds_with_the_reason():
    assert "gave up after 0.5 s" in failure("hz", "rrbot", "--seconds", "0.5")
