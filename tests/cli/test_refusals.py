"""Commands that keep trying after a refusal print the reason on one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, started
from helpers.processes import find_free_port, until

pytestmark = pytest.mark.processes


@pytest.mark.parametrize("command", [("router",), ("publish", RRBOT, "--source", "sine")])
def test_wrong_user_gets_the_settings_to_check(
    spawn: Spawn, free_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
):
    users = tmp_path / "users.txt"
    users.touch(0o600)
    users.write_text("alice:wonder\n")
    fleet = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--listen", fleet, "--users", str(users)).line()
    monkeypatch.setenv("ZSTATE_PASSWORD", "wander")
    who = ("--user", "alice", "--users", str(users)) if command == ("router",) else ("--user", "alice")
    here = f"tcp/127.0.0.1:{find_free_port()}"
    child = started(spawn, *command, "--connect", fleet, "--listen", here, *who)
    child.line()
    until(lambda: "does not let this session in" in child.stderr)
    (line,) = [line for line in child.stderr.splitlines() if "does not let this session in" in line]
    assert line.startswith(f"zstate: '{fleet}' answers and ")
    assert "the user 'alice' or the password" in line
    assert "--users file" in line
