"""zstate move and zstate stop, of drivers in other processes."""

from __future__ import annotations

import json

import pytest
from helpers.cli_runner import Spawn, failure, started, zstate
from helpers.processes import DEADLINE_S, Child

from zstate import connect
from zstate.driving import Commander

pytestmark = pytest.mark.processes


def driven(spawn: Spawn, name: str = "rrbot") -> Child:
    """A simulated driver of ``name`` that is ready."""
    child = started(spawn, "drive", "sim", "rrbot", "--name", name)
    assert child.line().startswith(f"driving {name!r}")
    assert child.line() == "ready"
    return child


def printed(*arguments: str) -> str:
    ended = zstate(*arguments)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.decode()


def test_stop_is_latched_over_a_restart_of_the_driver_until_the_release(spawn: Spawn):
    host = driven(spawn)
    assert printed("stop", "rrbot", "--reason", "door open").startswith("rrbot: stopped by zstate-stop@")
    stopped = host.line()
    assert stopped.startswith("stopped by zstate-stop@")
    assert stopped.endswith(": door open")
    host.kill()
    again = started(spawn, "drive", "sim", "rrbot")
    again.line()
    assert again.line() == stopped
    assert printed("stop", "rrbot", "--release").startswith("rrbot: ready: released by zstate-stop@")
    assert again.line().startswith("ready: released by zstate-stop@")


def test_all_drivers_are_stopped_and_reported_as_json(spawn: Spawn):
    for name in ("left", "right"):
        driven(spawn, name)
    documents = [json.loads(line) for line in printed("stop", "--all", "--json").splitlines()]
    assert [document["robot"] for document in documents] == ["left", "right"]
    for document in documents:
        assert (document["state"], document["is_stopped"], document["error"]) == ("stopped", True, None)


def test_release_while_another_program_commands_is_refused_with_its_name(spawn: Spawn):
    driven(spawn)
    with connect() as session, Commander(session, "rrbot", program="teleop") as commander:
        commander.wait_for_driver(DEADLINE_S)
        assert "teleop@" in failure("stop", "rrbot", "--release")


def test_stops_that_no_driver_confirms_fail():
    message = failure("stop", "rrbot", "--timeout", "0.3")
    assert "rrbot: no driver has confirmed the stop within 0.3 s" in message
    assert "no robot has a driver" in failure("stop", "--all")
    assert "name the robots to stop, or give --all" in failure("stop", code=2)
    assert "leave out --relax" in failure("stop", "rrbot", "--release", "--relax", code=2)
