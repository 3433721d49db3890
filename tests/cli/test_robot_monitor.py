from __future__ import annotations

import json
import os
import re
from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, failure, interrupted, published_robot, run_cli, started
from helpers.processes import DEADLINE_S, repeated, until
from helpers.prometheus_text import row, scraped

from zstate import Transform
from zstate.driving import Commander
from zstate.odometry import OdometryPublisher


@pytest.mark.processes
def test_each_robot_has_a_line_a_second(spawn: Spawn):
    command = started(spawn, "monitor", "--robots")
    robots: set[str] = set()
    with published_robot("left"), published_robot("right"):
        until(lambda: robots.add(command.line().split()[0]) or robots == {"left", "right"})
    assert "following zstate/left/joint_states" in command.stderr
    interrupted(command)


@pytest.mark.processes
def test_json_has_rate_age_latency_and_every_count(spawn: Spawn):
    command = started(spawn, "monitor", "--robots", "--robot", "rrbot", "--json")
    with published_robot():
        command.line()
        facts = json.loads(command.line())
    assert facts["robot"] == "rrbot"
    assert 10.0 < facts["rate_hz"] < 110.0
    assert facts["received"] > 0
    assert 0.0 < facts["latency_s"] < 1.0
    assert facts["latency_s"] <= facts["age_s"] + 1.0
    assert (facts["dropped"], facts["missed"], facts["late"], facts["refused"]) == (0, 0, 0, {})
    interrupted(command)


@pytest.mark.processes
def test_robot_that_publishes_only_transforms_is_monitored(spawn: Spawn):
    command = started(spawn, "monitor", "--robots", "--json")
    with published_robot(streams=("tf", "tf_static", "robot_description")):
        until(lambda: json.loads(command.line())["received"] > 0)
    assert "following zstate/rrbot/tf" in command.stderr


@pytest.mark.processes
def test_joint_states_transforms_and_odometry_have_separate_rates(sessions, spawn: Spawn):
    """Also if the transforms were there first: then the joint states are followed when they appear."""
    command = started(spawn, "monitor", "--robots", "--json")
    odometry = started(spawn, "transform", "odom", "world", "--xyz", "1", "0", "0", "--robot", "rrbot")
    until(lambda: json.loads(command.line())["received"] > 0)
    assert "following zstate/rrbot/transforms" in command.stderr
    with published_robot():
        until(lambda: "following zstate/rrbot/{joint_states,transforms}" in command.stderr)
        until(lambda: json.loads(command.line())["transforms_hz"])
        with OdometryPublisher(sessions[0], "rrbot", program="odometry") as wheels:
            base = Transform("world", "cart", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            with repeated(lambda: wheels.publish(base, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])):
                until(lambda: json.loads(command.line())["odometry_hz"])
            until(lambda: json.loads(command.line())["odometry_hz"] == 0.0)
            assert json.loads(command.line())["transforms_hz"] > 0.0
        line = run_cli("monitor", "--robots", "--once").stdout
        assert re.match(r"rrbot  [\d.]+ Hz  transforms [\d.]+ Hz  age ", line)
        interrupted(odometry)
        until(lambda: json.loads(command.line())["transforms_hz"] == 0.0)
        assert json.loads(command.line())["rate_hz"] > 0.0
    interrupted(command)


@pytest.mark.processes
def test_the_missing_robot_is_reported(spawn: Spawn):
    command = started(spawn, "monitor", "--robots", "--robot", "rrbot")
    until(lambda: "waiting: robot 'rrbot' is not announced" in command.stderr)
    with published_robot():
        assert command.line().startswith("rrbot  ")
    interrupted(command)


def test_a_name_that_no_robot_can_have_is_refused():
    assert "'a/b'" in failure("monitor", "--robots", "--robot", "a/b")


@pytest.mark.processes
def test_many_robots_share_one_listener(spawn: Spawn):
    def threads() -> int:
        return len(list(Path(f"/proc/{command.process.pid}/task").iterdir()))

    robots: set[str] = set()
    with ExitStack() as opened:
        opened.enter_context(published_robot("bot0"))
        command = started(spawn, "monitor", "--robots", "--json")
        until(lambda: json.loads(command.line())["received"] > 0)
        before = threads()
        for number in range(1, 6):
            opened.enter_context(published_robot(f"bot{number}"))
        until(lambda: robots.add(json.loads(command.line())["robot"]) or len(robots) == 6)
        # Links of Zenoh's come to six processes' sessions, but no listeners.
        assert threads() < before + 4 * 5
    interrupted(command)


def test_once_prints_one_line_for_each_robot():
    with published_robot("left"), published_robot("right"):
        lines = run_cli("monitor", "--robots", "--once").stdout.splitlines()
    assert [line.split()[0] for line in lines if " Hz  age " in line] == ["left", "right"]


def test_once_gives_up_with_the_reason():
    message = failure("monitor", "--robots", "--once", "--timeout", "0.5")
    assert "gave up after 0.5 s: no robot is announced" in message


@pytest.mark.processes
def test_a_robot_that_stops_is_silent(spawn: Spawn):
    command = started(spawn, "monitor", "--robots")
    with published_robot():
        until(lambda: " Hz  " in command.line())
    until(lambda: command.line().startswith("rrbot  silent  age "))
    interrupted(command)


@pytest.mark.processes
def test_warning_of_a_writer_has_a_line_until_it_is_withdrawn(sessions, spawn: Spawn):
    text = "wheels: NIS 14.2 for 3 numbers, expected 0.2 to 9.3: its sigmas are about 2 times too small"
    with OdometryPublisher(sessions[0], "cart", program="odometry") as odometry:
        odometry.warning = text
        base = Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        with repeated(lambda: odometry.publish(base, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])):
            rates, line = run_cli("monitor", "--robots", "--once").stdout.splitlines()
            assert re.match(r"cart  [\d.]+ Hz  odometry [\d.]+ Hz  age ", rates)
            assert re.fullmatch(rf"cart  warn  odometry@\S+ pid {os.getpid()}: {re.escape(text)}", line)
            command = started(spawn, "monitor", "--robots", "--json")
            until(lambda: [fault["text"] for fault in json.loads(command.line())["faults"]] == [text])
            odometry.warning = ""
            until(lambda: json.loads(command.line())["faults"] == [])
    interrupted(command)


def test_robots_and_frames_exclude_each_other():
    assert "--robots takes no frames" in failure("monitor", "--robots", "base", "tool", code=2)
    assert "--metrics needs --robots" in failure("monitor", "--metrics", "0", code=2)


@pytest.mark.processes
def test_a_driver_has_a_line_of_its_own_and_is_in_the_metrics(sessions, host_driver, spawn: Spawn):
    host = host_driver()
    with Commander(sessions[1], "arm", program="teleop") as teleop:
        teleop.wait_for_driver(DEADLINE_S)
        with repeated(lambda: teleop.send({"elbow": 0.1})):
            until(lambda: host.state == "active")
            line, driver = run_cli("monitor", "--robots", "--once").stdout.splitlines()
            command = started(spawn, "monitor", "--robots", "--json", "--metrics", "0")
            until(lambda: (json.loads(command.line())["driver"] or {}).get("state") == "active")
            url = re.search(r"metrics at (\S+)", command.stderr)
            assert url is not None
            rows = scraped(url.group(1))
    assert line.startswith("arm  ")
    assert re.match(
        r"arm  driver active, commanded by teleop@\S+ pid \d+  loop [\d.]+ Hz  skipped \d+  faults 0  "
        r"command age [\d.]+ ms, waited [\d.]+ [mu]s  refused 0",
        driver,
    )
    assert rows[row("zstate_driver_state", robot="arm", state="active")] == 1.0
    assert rows[row("zstate_driver_faults_total", robot="arm")] == 0.0
    interrupted(command)
