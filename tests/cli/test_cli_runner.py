"""What the tests of commands rest on: commands in the process of a test, and forked ones."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from pathlib import Path

import click
import pytest
from helpers.cli_runner import (
    RRBOT,
    Command,
    Spawn,
    in_terminal,
    missing_library,
    run_cli,
    run_process,
    run_until,
    run_watched,
)
from helpers.processes import DEADLINE_S

from zstate import StatePublisher, connect, load_model
from zstate.cli.main import group
from zstate.cli.output import logs

TABLE = '<robot name="table"><link name="top"/></robot>'


def state() -> list[object]:
    """What commands change in their process."""
    library = logging.getLogger("zstate")
    return [
        *(sys.argv, sys.stdin, sys.stdout, sys.__stdout__, sys.stderr, sys.excepthook, threading.excepthook),
        *(signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)),
        *(library.handlers.copy(), library.level, library.propagate, logs.is_json(), dict(os.environ)),
    ]


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", RRBOT),
        ("ls", "--log-format", "json"),
        ("doctor", "--json"),
        ("check", "no/such.urdf"),
        ("x",),
    ],
)
def test_a_command_in_process_leaves_the_process_as_it_was(arguments: tuple[str, ...]):
    before = state()
    ended = run_cli(*arguments)
    assert ended.stdout + ended.stderr
    assert state() == before


def test_a_command_that_is_interrupted_in_process_leaves_it_as_it_was():
    before = state()
    ended, pid = run_until(os.getpid, "joints", RRBOT, after="on zstate/rrbot/joint_states")
    assert (ended.code, pid) == (130, os.getpid())
    assert ended.stdout.startswith("rrbot: a sine on 2 joints, 100 Hz, on zstate/rrbot/joint_states\n")
    assert state() == before


def test_a_failure_of_what_an_interrupted_command_waits_for_ends_it():
    with pytest.raises(ZeroDivisionError):
        run_until(lambda: 1 / 0, "joints", RRBOT)


def test_a_command_that_is_watched_is_read_line_by_line_and_leaves_the_process_as_it_was():
    before, lines = state(), list[str]()
    ended = run_watched(lambda command: lines.append(command.line()), "joints", RRBOT)
    assert lines == ["rrbot: a sine on 2 joints, 100 Hz, on zstate/rrbot/joint_states"]
    assert ended.code == 130
    assert ended.stdout.startswith(f"{lines[0]}\n")
    assert state() == before


def test_a_command_may_end_by_itself_while_it_is_watched():
    def watch(command: Command) -> None:
        assert command.is_over()
        assert command.line() == "ready: 'r1' (1 frame)"
        with pytest.raises(AssertionError, match="it has ended"):
            command.line()

    with connect() as session, StatePublisher(session, load_model(TABLE), "r1"):
        run_watched(watch, "wait", "robot", "r1", code=0)
        with pytest.raises(AssertionError, match="code=0"):
            run_watched(watch, "wait", "robot", "r1")


def test_a_failure_of_what_watches_a_command_ends_it_and_has_its_output():
    def fail(command: Command) -> None:
        command.line()
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as failed:
        run_watched(fail, "joints", RRBOT)
    (note,) = failed.value.__notes__
    assert note.startswith(f"zstate joints {RRBOT} wrote:\nrrbot: a sine on 2 joints")


@pytest.mark.processes
@pytest.mark.parametrize(
    "arguments",
    [("check", RRBOT), ("check", "no/such.urdf"), ("x",), ("help",), ("config",), ("ls", "--json")],
)
def test_a_command_in_process_ends_and_writes_as_its_process_does(arguments: tuple[str, ...]):
    assert run_cli(*arguments) == run_process(*arguments)


def test_what_a_command_wrote_is_in_the_notes_of_its_crash(monkeypatch: pytest.MonkeyPatch):
    @click.command("crash")
    def crash() -> None:
        click.echo("so far")
        raise ZeroDivisionError

    monkeypatch.setattr(group, "resolve_command", lambda *_: ("crash", crash, []))
    before = state()
    with pytest.raises(ZeroDivisionError) as crashed:
        run_cli("crash", "it")
    assert crashed.value.__notes__ == ["zstate crash it wrote:\nso far\n"]
    assert state() == before


def test_a_library_is_missing_in_the_block_only():
    with missing_library("rich"), pytest.raises(ImportError):
        import rich.live
    import rich.live

    assert rich.live.Live


@pytest.mark.processes
def test_a_forked_process_has_its_own_streams_folder_environment_and_end(
    spawn: Spawn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OF_THIS_TEST", "yes")
    child = spawn(
        """
        import os, sys
        print(os.getcwd(), os.environ["OF_THIS_TEST"], sys.argv[1:], os.getpid())
        print("trouble", file=sys.stderr)
        sys.exit(int(sys.stdin.readline()))
        """,
        *("a", "b"),
    )
    assert child.line() == f"{tmp_path} yes ['a', 'b'] {child.process.pid}"
    assert child.process.poll() is None
    child.send_line("7")
    assert child.wait() == 7
    assert child.stderr == "trouble\n"


@pytest.mark.processes
def test_a_forked_process_ends_by_signals_and_crashes_as_others_do(spawn: Spawn):
    child = spawn("import time; print(1); time.sleep(60)")
    child.line()
    child.kill()
    assert child.wait() == -signal.SIGKILL
    crashed = spawn("1 / 0")
    assert crashed.wait() == 1
    assert crashed.stderr.endswith("ZeroDivisionError: division by zero\n")


@pytest.mark.processes
def test_a_command_in_a_terminal_sees_its_width():
    with in_terminal("check", "--help", columns=50) as (process, terminal):
        received = b""
        try:
            while part := os.read(terminal, 65536):
                received += part
        except OSError:  # Linux reports the closed terminal so
            pass
        assert process.wait(DEADLINE_S) == 0
    assert max(map(len, received.decode().splitlines())) <= 50
