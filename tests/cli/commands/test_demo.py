from __future__ import annotations

import os
import re
import signal
import subprocess
import sys

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, interrupted, started, zstate
from helpers.processes import DEADLINE_S, Child, until

pytestmark = pytest.mark.processes


def publisher_of(demo: Child) -> int:
    match = re.search(r"process (\d+) publishes it", demo.line())
    assert match
    return int(match[1])


def is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_it_shows_transforms_and_ends_with_a_summary():
    output = zstate("demo", RRBOT, "--seconds", "1.5", "--rate", "50").stdout.decode()
    first, *lines, summary = output.splitlines()
    assert first.startswith("rrbot (2 joints, 7 links): process ")
    assert "lower in world: xyz [" in lines[0]
    summary_match = re.fullmatch(
        r"(?P<count>\d+) samples received in (?P<seconds>\d+\.\d\d) s: (?P<rate>[\d.]+) Hz, \d+ missed, "
        r"median latency [\d.]+ [mu]s from stamp to lookup",
        summary,
    )
    assert summary_match
    assert float(summary_match["seconds"]) >= 1.5  # and not before, but a busy machine may come to it later
    # The three numbers agree to the last digit shown.
    rounded = 0.05 * float(summary_match["seconds"]) + 0.005 * float(summary_match["rate"])
    assert float(summary_match["rate"]) * float(summary_match["seconds"]) == pytest.approx(
        int(summary_match["count"]), abs=rounded + 1e-6
    )
    assert "\x1b" not in output


def test_without_panda_demo_shows_rrbot_and_prints_how_to_install_more():
    code = (
        "from zstate.model import catalog\n"
        "catalog._COLLECTIONS.pop('example-robot-data')\n"
        "from zstate.cli.main import main; main()"
    )
    command = [sys.executable, "-c", code, "demo", "--seconds", "0.5"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "'panda' is not installed (pip install 'zstate[robots]'), so this shows 'rrbot'" in ended.stderr
    assert "samples received" in ended.stdout


def test_ctrl_c_ends_both_processes_with_the_summary(spawn: Spawn):
    demo = started(spawn, "demo", "--robot", RRBOT)
    publisher = publisher_of(demo)
    demo.line()
    interrupted(demo)
    assert "received in" in demo.line()
    until(lambda: is_gone(publisher))


def test_a_publisher_that_dies_ends_the_demo(spawn: Spawn):
    demo = started(spawn, "demo", RRBOT)
    publisher = publisher_of(demo)
    demo.line()
    os.kill(publisher, signal.SIGKILL)
    assert demo.wait() == 1
    assert "the publisher ended with exit code -9" in demo.stderr


def test_a_publisher_does_not_outlive_a_demo_that_is_killed(spawn: Spawn):
    demo = started(spawn, "demo", RRBOT)
    publisher = publisher_of(demo)
    demo.line()
    demo.kill()
    until(lambda: is_gone(publisher))


def test_demo_is_isolated_with_its_publisher_in_any_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZENOH_CONFIG", "/nowhere.json5")
    monkeypatch.setenv("ZSTATE_MODE", "client")
    assert zstate("demo", RRBOT, "--seconds", "0.5").returncode == 0


def test_unknown_robot_error_names_one_that_always_works():
    assert "`zstate demo rrbot`" in failure("demo", "no_such_robot")
