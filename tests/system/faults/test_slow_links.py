"""A commander that is killed, frozen or cut off behind a link that is slower than its commands.

The host and its driver run in the process of the test, the commander in another one; between them is a relay
with the rate of the link in both directions.
"""

from __future__ import annotations

from typing import get_args

import pytest
from helpers.slow_links import COMMAND_BYTES, TTL_S, Fault, Result, trial

pytestmark = pytest.mark.processes

_SLACK_S = 1.0
"""For a busy machine. Without an age of commands the joints move for 6 s more."""


@pytest.fixture(autouse=True)
def state_folder(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def late_s(result: Result, bytes_per_s: float) -> float:
    """For how long joints moved after the end of the last command's ttl, a tick, and its way [s]."""
    return result.moved_s - TTL_S - result.tick_s - COMMAND_BYTES / bytes_per_s


@pytest.mark.parametrize("fault", get_args(Fault))
def test_joints_rest_within_the_ttl_after_their_commander_on_a_slow_link(fault: Fault):
    result = trial(10_000.0, 200.0, fault, drive_s=3.0)
    assert result.active > 0.0
    assert late_s(result, 10_000.0) < _SLACK_S


def test_old_commands_do_not_wait_on_a_slow_link_behind_which_the_robot_moves():
    result = trial(5000.0, 200.0, "killed", drive_s=6.0)
    assert result.waited_s < _SLACK_S, "of 24 kB/s that were given, the link has carried what it can"
    assert result.active > 0.1, "commands that queue are in time for a quarter of a second of the six"


def trials_20(bytes_per_s: float, command_hz: float, fault: Fault) -> list[Result]:
    """20 trials, none of which moves the joints for longer than the bound."""
    results = [trial(bytes_per_s, command_hz, fault, 3.0 + 0.37 * (number % 7)) for number in range(20)]
    worst = max(late_s(result, bytes_per_s) for result in results)
    print(f"moved for {max(result.moved_s for result in results):.3f} s at most; {worst:+.3f} s of the bound")
    assert worst <= 0.0
    return results


@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("fault", get_args(Fault))
@pytest.mark.parametrize("command_hz", [100.0, 200.0])
@pytest.mark.parametrize("bytes_per_s", [3000.0, 5000.0, 50000.0])
def test_joints_that_move_rest_within_the_ttl_on_every_link_in_20_of_20_trials(
    bytes_per_s: float, command_hz: float, fault: Fault
):
    results = trials_20(bytes_per_s, command_hz, fault)
    # On a busy machine the slowest link may carry no command in time.
    assert sum(result.active > 0.0 for result in results) > 15


@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("fault", get_args(Fault))
@pytest.mark.parametrize("command_hz", [100.0, 200.0])
def test_a_link_on_which_a_command_and_its_state_take_longer_than_the_ttl_moves_nothing_in_20_of_20_trials(
    command_hz: float, fault: Fault
):
    """At 1 kB/s: every command is refused as late."""
    for result in trials_20(1000.0, command_hz, fault):
        assert result.active == 0.0
        assert result.refused.keys() == {"late"}
