"""Lines on standard error: text, JSON, and during a live display."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
import textwrap
import time
from datetime import UTC, datetime

import pytest
from helpers.cli_runner import RRBOT, Command, Spawn, failure, published_robot, run_until, run_watched
from helpers.processes import DEADLINE_S, until

from zstate import connect
from zstate.cli.commands import joints
from zstate.cli.output.logs import text_in
from zstate.net.streams import KeyPublisher
from zstate.wire.messages import JointState
from zstate.wire.native import encoding_of


def entries(stderr: str) -> list[dict[str, object]]:
    return [json.loads(line) for line in stderr.splitlines()]


def instant(text: object) -> float:
    """Seconds since the epoch of an RFC 3339 time in UTC, to the microsecond."""
    match = re.fullmatch(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)\.(\d{9})Z", str(text))
    assert match, text
    whole = datetime.strptime(match[1], "%Y-%m-%dT%H:%M:%S").replace(tzinfo=UTC)
    return whole.timestamp() + int(match[2]) * 1e-9


def test_a_failure_is_a_json_line_with_time_level_event_and_text():
    before = time.time()
    (entry,) = entries(failure("joints", "no_such_robot", "--log-format", "json"))
    assert before - 1e-3 <= instant(entry.pop("time")) <= time.time()
    assert (entry["level"], entry["event"]) == ("error", "failed")
    assert "no robot is called 'no_such_robot'" in str(entry["text"])


def test_format_is_read_from_the_environment_and_the_option_precedes_it(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setenv("ZSTATE_LOG_FORMAT", "json")
    assert "did you mean 'joints'" in str(entries(failure("jonts", code=2))[0]["text"])
    assert failure("joints", "no_such_robot", "--log-format", "text").startswith("zstate: no robot")


def test_unknown_format_is_refused():
    assert "'jason' is not one of 'text', 'json'" in failure("joints", RRBOT, "--log-format", "jason", code=2)


MONITOR = ("monitor", "--robots", "--robot", "rrbot", "--log-format", "json")


def test_every_line_of_a_running_command_is_json():
    def watch(command: Command) -> None:
        until(lambda: "waiting: robot 'rrbot' is not announced" in command.stderr)
        with published_robot() as publisher:
            command.line()
            output = entries(command.stderr)
        assert {entry["level"] for entry in output} == {"info"}
        following = [entry for entry in output if "following" in str(entry["text"])]
        assert {entry.get("robot") for entry in following} == {publisher.robot}

    run_watched(watch, *MONITOR)


@pytest.mark.parametrize(
    ("service", "text"),
    [
        (("router", "--listen", "ENDPOINT"), "listens at"),
        (("publish", RRBOT, "--source", "sine"), "publishing 'rrbot'"),
    ],
    ids=["router", "publish"],
)
def test_standard_output_of_a_service_is_json_too(free_port: int, service: tuple[str, ...], text: str):
    given = [word.replace("ENDPOINT", f"tcp/127.0.0.1:{free_port}") for word in service]
    ended, _ = run_until(lambda: True, *given, "--log-format", "json")
    entry, *_ = entries(ended.stdout)
    assert (entry["level"], entry["event"]) == ("info", "result")
    assert text in str(entry["text"])


def test_library_warning_has_its_event_and_reason():
    def disturb(command: Command) -> None:
        key, encoding = "zstate/rrbot/joint_states", encoding_of(JointState)
        with published_robot(), connect() as session, KeyPublisher(session, key, encoding) as noise:
            command.line()
            until(lambda: noise.has_readers)
            noise.put(b"noise")
            until(lambda: '"level": "warning"' in command.stderr)
        (warning,) = [entry for entry in entries(command.stderr) if entry["level"] == "warning"]
        assert (warning["event"], warning["reason"]) == ("refused", "malformed")

    run_watched(disturb, *MONITOR)


@pytest.mark.processes
def test_unhandled_exception_of_a_thread_is_a_json_line(spawn: Spawn):
    child = spawn(
        "import threading\n"
        "from zstate.cli.output.logs import use_format\n"
        "use_format('json')\n"
        "threading.Thread(target=lambda: 1 / 0).start()"
    )
    assert child.wait() == 0
    (entry,) = entries(child.stderr)
    assert entry["event"] == "crash"
    assert "ZeroDivisionError" in str(entry["text"])


def test_the_text_of_a_line_is_found_in_either_format():
    assert text_in("zstate: it is so") == "zstate: it is so"
    assert text_in('{"level": "error", "text": "it is so"}') == "it is so"
    assert text_in("[1, 2]") == "[1, 2]"


def test_every_command_has_the_option_once():
    from zstate.cli.main import group

    for _ in range(2):
        command = group.get_command(None, "joints")  # type: ignore[arg-type]
        assert command is joints.joints_command
        assert sum("--log-format" in option.opts for option in command.params) == 1


LIVE = """
    import logging
    from rich.live import Live
    from rich.text import Text
    from zstate.cli.output.console import print_status
    from zstate.cli.output.logs import warn_on_standard_error
    warn_on_standard_error()
    with Live(Text("live"), auto_refresh=False) as live:
        live.update(Text("12 messages"), refresh=True)
        print_status("recording panda")
        logging.getLogger("zstate").warning("a gap")
        live.update(Text("13 messages"), refresh=True)
"""


def shown(stream: int) -> list[str]:
    """The lines that a terminal of one live line is left with: what is erased is not there."""
    received = b""
    try:
        while chunk := os.read(stream, 4096):
            received += chunk
    except OSError:  # the end of a terminal
        pass
    text = received.decode().replace("\r\n", "\n")
    lines = (re.split(r"\r\x1b\[2K", line)[-1] for line in text.split("\n"))
    return [re.sub(r"\x1b\[[?\d;]*\w", "", line) for line in lines]


def live_on_a_terminal(errors: int | None) -> tuple[list[str], str]:
    """What the terminal shows, and what standard error got where that is not the terminal."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", textwrap.dedent(LIVE)]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "80"}
    process = subprocess.Popen(command, stdout=theirs, stderr=errors or theirs, env=environment)
    os.close(theirs)
    lines = shown(ours)
    os.close(ours)
    output = process.stderr.read().decode() if process.stderr else ""
    assert process.wait(DEADLINE_S) == 0
    return lines, output


@pytest.mark.processes
def test_status_line_during_a_live_display_stays_above_it():
    lines, _ = live_on_a_terminal(None)
    assert "recording panda" in lines
    assert "zstate: a gap" in lines
    assert "13 messages" in lines
    assert not [line for line in lines if "12 messages" in line]


@pytest.mark.processes
def test_redirected_standard_error_gets_lines_during_a_live_display():
    lines, output = live_on_a_terminal(subprocess.PIPE)
    assert output == "recording panda\nzstate: a gap\n"
    assert not [line for line in lines if "panda" in line or "gap" in line]
