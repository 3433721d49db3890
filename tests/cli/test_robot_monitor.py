from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.cli_runner import (
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_watched,
    started,
)
from helpers.processes import DEADLINE_S, repeated, until
from helpers.programs import moving_edge
from helpers.prometheus_text import row, scraped

from zstate import Transform
from zstate.driving import Commander, DriverHost
from zstate.net.session import Session
from zstate.odometry import OdometryPublisher


def test_each_robot_has_a_line_a_second():
    def watch(command: Command) -> None:
        robots: set[str] = set()
        with published_robot("left"), published_robot("right"):
            until(lambda: robots.add(command.line().split()[0]) or robots == {"left", "right"})
        assert "following zstate/left/joint_states" in command.stderr

    run_watched(watch, "monitor", "--robots")


def test_json_has_rate_age_latency_and_every_count():
    def watch(command: Command) -> None:
        with published_robot():
            command.line()
            command.line()

    ended = run_watched(watch, "monitor", "--robots", "--robot", "rrbot", "--json")
    facts = json.loads(ended.stdout.splitlines()[1])
    assert facts["robot"] == "rrbot"
    assert 10.0 < facts["rate_hz"] < 110.0
    assert facts["received"] > 0
    assert 0.0 < facts["latency_s"] < 1.0
    assert facts["latency_s"] <= facts["age_s"] + 1.0
    assert (facts["dropped"], facts["missed"], facts["late"], facts["refused"]) == (0, 0, 0, {})


def test_robot_that_publishes_only_transforms_is_monitored():
    def watch(command: Command) -> None:
        with published_robot(streams=("tf", "tf_static", "robot_description")):
            until(lambda: json.loads(command.line())["received"] > 0)
        assert "following zstate/rrbot/tf" in command.stderr

    run_watched(watch, "monitor", "--robots", "--json")


def test_joint_states_transforms_and_odometry_have_separate_rates(sessions: tuple[Session, Session]):
    """Also if the transforms were there first: then the joint states are followed when they appear."""

    def watch(command: Command) -> None:
        with ExitStack() as robot:
            with moving_edge("rrbot", "odom", "world", (1.0, 0.0, 0.0)):
                until(lambda: json.loads(command.line())["received"] > 0)
                assert "following zstate/rrbot/transforms" in command.stderr
                robot.enter_context(published_robot())
                until(lambda: "following zstate/rrbot/{joint_states,transforms}" in command.stderr)
                until(lambda: json.loads(command.line())["transforms_hz"])
                with OdometryPublisher(sessions[0], "rrbot", program="odometry") as wheels:
                    base = Transform("world", "cart", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
                    with repeated(lambda: wheels.publish(base, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])):
                        until(lambda: json.loads(command.line())["odometry_hz"])
                    until(lambda: json.loads(command.line())["odometry_hz"] == 0.0)
                    assert json.loads(command.line())["transforms_hz"] > 0.0
            until(lambda: json.loads(command.line())["transforms_hz"] == 0.0)
            assert json.loads(command.line())["rate_hz"] > 0.0

    run_watched(watch, "monitor", "--robots", "--json")


def test_line_of_a_robot_has_the_rate_of_its_transforms_after_that_of_its_joint_states():
    with published_robot(), moving_edge("rrbot", "odom", "world"):
        line = run_cli("monitor", "--robots", "--once").stdout
    assert re.match(r"rrbot  [\d.]+ Hz  transforms [\d.]+ Hz  age ", line)


def test_the_missing_robot_is_reported():
    def watch(command: Command) -> None:
        until(lambda: "waiting: robot 'rrbot' is not announced" in command.stderr)
        with published_robot():
            assert command.line().startswith("rrbot  ")

    run_watched(watch, "monitor", "--robots", "--robot", "rrbot")


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


def test_a_robot_that_stops_is_silent():
    def watch(command: Command) -> None:
        with published_robot():
            until(lambda: " Hz  " in command.line())
        until(lambda: command.line().startswith("rrbot  silent  age "))

    run_watched(watch, "monitor", "--robots")


def test_warning_of_a_writer_has_a_line_until_it_is_withdrawn(sessions: tuple[Session, Session]):
    def watch(command: Command) -> None:
        until(lambda: [fault["text"] for fault in json.loads(command.line())["faults"]] == [text])
        odometry.warning = ""
        until(lambda: json.loads(command.line())["faults"] == [])

    text = "wheels: NIS 14.2 for 3 numbers, expected 0.2 to 9.3: its sigmas are about 2 times too small"
    with OdometryPublisher(sessions[0], "cart", program="odometry") as odometry:
        odometry.warning = text
        base = Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        with repeated(lambda: odometry.publish(base, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0])):
            rates, line = run_cli("monitor", "--robots", "--once").stdout.splitlines()
            assert re.match(r"cart  [\d.]+ Hz  odometry [\d.]+ Hz  age ", rates)
            assert re.fullmatch(rf"cart  warn  odometry@\S+ pid {os.getpid()}: {re.escape(text)}", line)
            run_watched(watch, "monitor", "--robots", "--json")


def test_robots_and_frames_exclude_each_other():
    assert "--robots takes no frames" in failure("monitor", "--robots", "base", "tool", code=2)
    assert "--metrics needs --robots" in failure("monitor", "--metrics", "0", code=2)


def test_a_driver_has_a_line_of_its_own_and_is_in_the_metrics(
    sessions: tuple[Session, Session], host_driver: Callable[..., DriverHost]
):
    def scrape(command: Command) -> None:
        until(lambda: (json.loads(command.line())["driver"] or {}).get("state") == "active")
        url = re.search(r"metrics at (\S+)", command.stderr)
        assert url is not None
        rows = scraped(url.group(1))
        assert rows[row("zstate_driver_state", robot="arm", state="active")] == 1.0
        assert rows[row("zstate_driver_faults_total", robot="arm")] == 0.0

    host = host_driver()
    with Commander(sessions[1], "arm", program="teleop") as teleop:
        teleop.wait_for_driver(DEADLINE_S)
        with repeated(lambda: teleop.send({"elbow": 0.1})):
            until(lambda: host.state == "active")
            line, driver = run_cli("monitor", "--robots", "--once").stdout.splitlines()
            run_watched(scrape, "monitor", "--robots", "--json", "--metrics", "0")
    assert line.startswith("arm  ")
    assert re.match(
        r"arm  driver active, commanded by teleop@\S+ pid \d+  loop [\d.]+ Hz  skipped \d+  faults 0  "
        r"command age [\d.]+ ms, waited [\d.]+ [mu]s  refused 0",
        driver,
    )
