"""Commands that keep trying after a refusal print the reason on one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, run_until
from helpers.processes import find_free_port
from helpers.programs import router


@pytest.mark.parametrize("command", [("router",), ("publish", RRBOT, "--source", "sine")])
def test_wrong_user_gets_the_settings_to_check(
    free_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
):
    users = tmp_path / "users.txt"
    users.touch(0o600)
    users.write_text("alice:wonder\n")
    monkeypatch.setenv("ZSTATE_PASSWORD", "wander")
    who = ("--user", "alice", "--users", str(users)) if command == ("router",) else ("--user", "alice")
    here = f"tcp/127.0.0.1:{find_free_port()}"
    refusal = "does not let this session in"
    with router(f"tcp/127.0.0.1:{free_port}", users=users) as fleet:
        ended, _ = run_until(
            lambda: True, *command, "--connect", fleet, "--listen", here, *who, after=refusal
        )
    assert ended.stdout
    (line,) = [line for line in ended.stderr.splitlines() if refusal in line]
    assert line.startswith(f"zstate: '{fleet}' answers and ")
    assert "the user 'alice' or the password" in line
    assert "--users file" in line
